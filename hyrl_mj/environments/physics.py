"""MuJoCo's state in an environment: read, written, and put back."""

from __future__ import annotations

from functools import cached_property

import mujoco
import numpy as np

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Physics:
    """MuJoCo's state in an environment.

    Args:
        model, data: of MuJoCo.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        self.model, self.data = model, data
        self.size = mujoco.mj_stateSize(model, STATE)
        self._kept: mujoco.MjData | None = None
        self._left = False

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """The places in a state of each of its parts, by name."""
        found, at = {}, 0
        for part in mujoco.mjtState.__members__.values():
            name = part.name.removeprefix("mjSTATE_").lower()
            if part.value.bit_count() == 1 and part.value & STATE:
                size = mujoco.mj_stateSize(self.model, part)
                found[name], at = np.arange(at, at + size), at + size
        return found

    def read(self, into: np.ndarray | None = None) -> np.ndarray:
        """Returns MuJoCo's state (S,), a new array or one that is given."""
        state = np.empty(self.size) if into is None else into
        mujoco.mj_getState(self.model, self.data, state, STATE)
        return state

    def write(self, state: np.ndarray) -> None:
        """Sets MuJoCo's state (S,) and computes what follows from it."""
        self.show(state)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_rnePostConstraint(self.model, self.data)  # forces of contacts on bodies
        self.show(state)

    def show(self, state: np.ndarray) -> None:
        """Sets MuJoCo's state (S,) and leaves what follows from it as it is."""
        mujoco.mj_setState(self.model, self.data, state, STATE)

    def earlier(self, state: np.ndarray) -> np.ndarray:
        """Returns the state (S,) a step of the physics before, as the semi-implicit Euler method has it."""
        found, dt = state.copy(), self.model.opt.timestep
        qpos, qvel = state[self.columns["qpos"]], state[self.columns["qvel"]]
        mujoco.mj_integratePos(self.model, qpos, qvel, -dt)
        found[self.columns["qpos"]], found[self.columns["qvel"]] = qpos, qvel - dt * self.data.qacc
        return found

    def leave(self) -> None:
        """Notes everything, derived quantities included, for `come_back`."""
        self._kept = self._kept or mujoco.MjData(self.model)
        mujoco.mj_copyData(self._kept, self.model, self.data)
        self._left = True

    def come_back(self) -> None:
        """Puts everything back as it was at `leave`, if that was called."""
        if self._left:
            mujoco.mj_copyData(self.data, self.model, self._kept)
            self._left = False
