"""n copies of an environment as a plant: their states are MuJoCo's, their steps the environment's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.environments.copies import Host, Report
from hyrl_mj.environments.layout import Layout
from hyrl_mj.errors import BadInput
from hyrl_mj.plant import MOST, checked, checked_inputs
from hyrl_mj.ranges import Integer
from hyrl_mj.tasks import Outcome


class EnvironmentPlant:
    """n copies of an environment, with the interface of `hyrl_mj.plant.Plant`.

    Args:
        host: the environment.
        layout: what its measurement holds.
        n: number of copies.
    """

    invertible = False

    def __init__(self, host: Host, layout: Layout, n: int):
        self.n = Integer(1, MOST).checked("the number of copies of a robot", n)
        self._host, self._layout = host, layout
        self.model = host.model
        self.low, self.high = layout.low, layout.high
        state, memory = layout.usual
        self._state, self._memory = np.tile(state, (n, 1)), np.tile(memory, (n, 1))
        self._report = np.zeros((n, host.width + 5))
        self._outcome = np.full(n, int(Outcome.RUNNING))
        self._unstable = np.zeros(n, dtype=bool)

    @property
    def measurement(self) -> np.ndarray:
        """The current measurement without noise: (n, p), a copy."""
        return self._layout.measurement(self._state, self._memory, self._report, self._outcome)

    @property
    def unstable(self) -> np.ndarray:
        """The copies (n,) bool whose simulation has diverged since `set_state`."""
        return self._unstable.copy()

    @property
    def warnings(self) -> np.ndarray:
        """How often MuJoCo has warned about each copy: (n,) int; warnings are not told apart here."""
        return np.zeros(self.n, dtype=int)

    @property
    def qpos(self) -> np.ndarray:
        """Generalised positions: (n, nq), a copy."""
        return self._state[:, self._layout.qpos]

    @property
    def qvel(self) -> np.ndarray:
        """Generalised velocities: (n, nv), a copy."""
        return self._state[:, self._layout.qvel]

    @property
    def state(self) -> np.ndarray:
        """MuJoCo's whole state, rows of `mjSTATE_INTEGRATION`: (n, nstate), a copy."""
        return self._state.copy()

    def geom_positions(self, ids: Sequence[int]) -> np.ndarray:
        """Returns the positions of geoms that do not move: (1, k, 3) [m]."""
        return mjcf.geom_positions(self.model, list(ids))[None]

    def set_state(
        self, qpos: np.ndarray, qvel: np.ndarray | None = None, ids: np.ndarray | None = None
    ) -> None:
        """Sets qpos (k, nq) and qvel (k, nv) of the copies `ids` (k,); all else is as after a reset.

        Raises:
            BadInput: a wrong shape or a value that is not finite.
        """
        rows = self._rows(ids)
        qvel = np.zeros((len(rows), self.model.nv)) if qvel is None else qvel
        self._state[rows], self._memory[rows] = self._layout.usual
        for name, columns, values in (
            ("qpos", self._layout.qpos, qpos),
            ("qvel", self._layout.qvel, qvel),
        ):
            self._state[np.ix_(rows, columns)] = checked(name, values, len(columns), rows)
        self._report[rows] = 0.0
        observed, blocked = self._layout.crew.observe(self._state[rows], self._memory[rows])
        self._report[rows, : self._host.width] = observed
        self._outcome[rows] = np.where(blocked, Outcome.CRASHED, Outcome.RUNNING)
        self._unstable[rows] = False

    def step(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Steps the copies `ids` (k,), all by default, with inputs u (k, m).

        Raises:
            BadInput: a wrong shape, a value that is not finite, or one outside the input limits.
        """
        rows = self._rows(ids)
        u = checked_inputs(u, self.low, self.high, rows, self._host.name)
        states, memories, report = self._layout.crew.advance(
            self._state[rows], self._memory[rows], u
        )
        self._keep(rows, states, memories, report)

    def step_backward(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Refuses: an environment cannot be run backward."""
        raise BadInput(f"the environment {self._host.name} cannot be run backward")

    def _keep(
        self, rows: np.ndarray, states: np.ndarray, memories: np.ndarray, report: Report
    ) -> None:
        finite = np.isfinite(states).all(axis=1) & np.isfinite(report.observation).all(axis=1)
        good = rows[finite]
        self._state[good], self._memory[good] = states[finite], memories[finite]
        self._report[good] = report.columns[finite]
        self._outcome[good] = self._layout.success.outcome(report)[finite]
        self._unstable[rows[~finite]] = True

    def _rows(self, ids: np.ndarray | None) -> np.ndarray:
        return np.arange(self.n) if ids is None else np.asarray(ids)
