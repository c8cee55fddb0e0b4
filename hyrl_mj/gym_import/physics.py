"""MuJoCo's state in an environment: read, written, and put back."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, cached_property

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
# Parts of MuJoCo's model that say how it moves, by the first words of their names.
MOVES = (
    "qpos", "body_", "jnt_", "dof_", "geom_", "site_", "tendon_", "wrap_", "actuator_", "sensor_", "eq_",
    "pair_", "exclude_", "numeric_data", "hfield_data", "flex_", "cam_", "key_",
)  # fmt: skip
# What can be pinned.
PINNED = ("qpos", "qvel", "mocap_pos", "userdata")


class Physics:
    """MuJoCo's state in an environment.

    Args:
        model, data: of MuJoCo.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        self.model, self.data = model, data
        self.size = mujoco.mj_stateSize(model, STATE)
        self._kept: mujoco.MjData | None = None

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

    @cached_property
    def parts(self) -> dict[str, np.ndarray]:
        """The parts of the model by name, which show what these hold at any time."""
        return parts_of_model(self.model)

    @cached_property
    def names(self) -> list[str]:
        """The names of the entries of a state, as "qpos[0]"."""
        return [f"{part}[{i}]" for part, at in self.columns.items() for i in range(len(at))]

    def read(self) -> np.ndarray:
        """Returns MuJoCo's state (S,), a new array."""
        state = np.empty(self.size)
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

    def depth(self, robot: np.ndarray) -> float:
        """Returns how deep geoms (ngeom,) bool are inside of others [m], 0 if they touch nothing."""
        if not self.data.ncon:
            return 0.0
        contact = self.data.contact
        touches = robot[contact.geom].sum(axis=1) == 1
        return float(-min(contact.dist[touches].min(initial=0.0), 0.0))

    def touched(self, robot: np.ndarray) -> set[int]:
        """Returns which geoms meet at contacts of some geoms (ngeom,) bool with others."""
        pairs = self.data.contact.geom[: self.data.ncon]
        return {int(g) for pair in pairs if robot[pair].sum() == 1 for g in pair}

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

    def come_back(self) -> None:
        """Puts everything back as it was at `leave`."""
        mujoco.mj_copyData(self.data, self.model, self._kept)


def parts_of_model(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Returns the parts of MuJoCo's model that say how it moves and hold anything, by name, as views."""
    found = {name: getattr(model, name) for name in _moving_parts()}
    return {n: part for n, part in found.items() if isinstance(part, np.ndarray) and part.size}


@cache
def _moving_parts() -> list[str]:
    """Returns the names of the parts of any model that say how it moves, not how it looks."""
    looks = "_rgba", "_matid", "_group"
    return [n for n in dir(mujoco.MjModel) if n.startswith(MOVES) and not n.endswith(looks)]


def set_pins(data: mujoco.MjData, pinned: Mapping[str, float], name: str) -> None:
    """Sets numbers in MuJoCo's data, as "qpos[0]", to pinned values, by name.

    Args:
        data: of MuJoCo.
        pinned: the values.
        name: of the environment, for messages.

    Raises:
        BadInput: there is no such place.
    """
    for place, value in pinned.items():
        kind, _, rest = place.partition("[")
        if kind not in PINNED or not rest.endswith("]"):
            raise BadInput(
                f"pinned {place} of {name} is no number of MuJoCo's data: pin {', '.join(PINNED)}, as "
                "qpos[2], and what attributes hold by options of reset, by a seed, or in its own reset()"
            )
        values, i = getattr(data, kind).reshape(-1), rest[:-1]
        if not i.isdigit() or int(i) >= len(values):
            held = f"{kind}[0] to [{len(values) - 1}]" if len(values) else f"no {kind}"
            raise BadInput(f"{name} has no {place}: there are {held}")
        values[int(i)] = value
