"""n runs of an environment as a plant: each is played by an instance from its start to its end."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.environments.pool import MOST as MOST_PLAYED
from hyrl_mj.environments.pool import Key, Pool
from hyrl_mj.environments.specification import EnvironmentSpec
from hyrl_mj.errors import BadInput
from hyrl_mj.plant import MOST, checked, checked_inputs
from hyrl_mj.ranges import Integer
from hyrl_mj.tasks import Outcome

_NUMBERS = count()


class EnvironmentPlant:
    """n runs of an environment, with the interface of `hyrl_mj.plant.Plant`.

    A run is played from its start: nothing is saved or restored on its way. `observe` gives it the noise of a
    sample before it is stepped; a run that is stepped without has none.

    Args:
        spec: what is known of the environment.
        pool: plays the runs.
        model: of MuJoCo.
        n: number of runs.
    """

    invertible = False

    def __init__(self, spec: EnvironmentSpec, pool: Pool, model: Any, n: int):
        self.n = Integer(1, MOST).checked("the number of copies of a robot", n)
        self.spec, self._pool, self.model = spec, pool, model
        self.low, self.high = spec.low, spec.high
        self._number, processes = next(_NUMBERS), pool.processes(n)
        self.late = spec.wrapped
        self._keys: list[Key] = [(self._number, i, i % processes) for i in range(n)]
        self._state = np.tile(spec.state, (n, 1))
        self._starts = self._state.copy()
        self._seen = np.zeros((n, spec.columns))
        self._report = np.zeros((n, spec.recipe.width))
        self._outcome = np.full(n, int(Outcome.RUNNING))
        self._unstable = np.zeros(n, dtype=bool)
        self._begun = np.zeros(n, dtype=bool)  # whether an instance plays the run
        self._open = np.zeros(n, dtype=bool)  # whether the sample has not been observed yet
        #: whether states are written, and no instance plays a run: without a memory, that is the same
        self.direct = spec.memoryless and n > MOST_PLAYED
        self._played: set[Key] = set()
        # Not at once: a plant may be collected while the pool is at work.
        weakref.finalize(self, pool.left.append, self._played).atexit = False

    # ---- what is measured

    @property
    def measurement(self) -> np.ndarray:
        """The current measurement (n, p), a copy; what no noise was given for is observed without."""
        if (rows := np.flatnonzero(self._open & self._begun)).size and self.spec.wrapped:
            self._sense(rows, np.zeros((len(rows), self.spec.dimension)))
        return self.truth

    @property
    def truth(self) -> np.ndarray:
        """The current measurement (n, p), a copy, before the present sample has been observed."""
        return np.column_stack(
            [
                self.spec.z(self._state),
                self._seen,
                self._report[:, 0],
                self.spec.succeeds(self._report),
                self._outcome,
            ]
        )

    def observe(self, true: np.ndarray, noise: np.ndarray, ids: np.ndarray) -> np.ndarray:
        """Returns the noisy measurements (k, p) of runs `ids` (k,), under noise (k, p) of this sample.

        Each run can be observed once in each sample: what remembers its observations then has seen it.
        """
        d = self.spec.dimension
        measured, needed = (
            true.copy(),
            noise[:, :d].any(axis=1) | (self.spec.wrapped & self._begun[ids]),
        )
        goes_on = self._outcome[ids] == Outcome.RUNNING
        some = np.flatnonzero(needed & self._open[ids] & goes_on)
        if len(some):
            self._sense(ids[some], noise[some, :d])
        self._open[ids] = False
        measured[:, :d] += noise[:, :d]
        measured[:, d : d + self.spec.columns] = self._seen[ids]
        return measured

    def _sense(self, rows: np.ndarray, noise: np.ndarray) -> None:
        if self.direct:
            raise BadInput(
                f"{self.n} episodes of {self.spec.name} cannot be observed under noise side by side: give at "
                f"most {MOST_PLAYED}"
            )
        keys = [self._keys[i] for i in rows]
        self._played.update(keys)
        seen, reports = self._pool.sense(keys, self._new(rows), noise)
        self._begun[rows], self._open[rows] = True, False
        self._seen[rows] = seen
        if reports is not None:
            self._judge(rows, reports)

    # ---- the state

    @property
    def unstable(self) -> np.ndarray:
        """The runs (n,) bool whose simulation has diverged since `set_state`."""
        return self._unstable.copy()

    @property
    def warnings(self) -> np.ndarray:
        """How often MuJoCo has warned about each run: (n,) int; warnings are not told apart here."""
        return np.zeros(self.n, dtype=int)

    @property
    def qpos(self) -> np.ndarray:
        """Generalised positions: (n, nq), a copy."""
        return self._state[:, self.spec.qpos]

    @property
    def qvel(self) -> np.ndarray:
        """Generalised velocities: (n, nv), a copy."""
        return self._state[:, self.spec.qvel]

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
        """Begins the runs `ids` (k,) anew at qpos (k, nq) and qvel (k, nv), all else as after a reset.

        Raises:
            BadInput: a wrong shape or a value that is not finite.
        """
        rows = self._rows(ids)
        qvel = np.zeros((len(rows), self.model.nv)) if qvel is None else qvel
        self._leave(rows)
        self._state[rows] = self.spec.state
        for name, columns, values in (
            ("qpos", self.spec.qpos, qpos),
            ("qvel", self.spec.qvel, qvel),
        ):
            self._state[np.ix_(rows, columns)] = checked(name, values, len(columns), rows)
        self._starts[rows] = self._state[rows]
        self._report[rows], self._unstable[rows] = 0.0, False
        self._begun[rows], self._open[rows] = False, True
        self._seen[rows], depths = self._pool.rest(self._starts[rows])
        blocked = depths > self.spec.depth
        self._outcome[rows] = np.where(blocked, Outcome.CRASHED, Outcome.RUNNING)

    def step(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Steps the runs `ids` (k,), all by default, with inputs u (k, m).

        Raises:
            BadInput: a wrong shape, a value that is not finite, or one outside the input limits.
        """
        rows = self._rows(ids)
        u = checked_inputs(u, self.low, self.high, rows, self.spec.name)
        # A run that is over stays where it ended.
        goes_on = (self._outcome[rows] == Outcome.RUNNING) & ~self._unstable[rows]
        rows, u = rows[goes_on], u[goes_on]
        if not len(rows):
            return
        if self.direct:
            states, reports, seen = self._pool.branch(self._state[rows], u)
        else:
            keys = [self._keys[i] for i in rows]
            self._played.update(keys)
            states, reports, seen = self._pool.act(keys, self._new(rows), u)
            self._begun[rows] = True
        self._open[rows] = True
        finite = np.isfinite(states).all(axis=1) & np.isfinite(seen).all(axis=1)
        self._state[rows[finite]], self._seen[rows[finite]] = states[finite], seen[finite]
        self._unstable[rows[~finite]] = True
        if not self.spec.wrapped:
            self._judge(rows, reports)
        self._leave(rows[~finite])

    def end(self) -> None:
        """Ends all runs.

        Raises:
            BadInput: random numbers were drawn in one of them.
        """
        self._leave(np.arange(self.n))

    def step_backward(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Refuses: an environment cannot be run backward."""
        raise BadInput(f"the environment {self.spec.name} cannot be run backward")

    def _judge(self, rows: np.ndarray, reports: np.ndarray) -> None:
        """Notes what the environment reported of runs, and lets go of those that are over."""
        self._report[rows] = reports
        self._outcome[rows] = self.spec.outcome(reports)
        self._leave(rows[self._outcome[rows] != Outcome.RUNNING])

    def _new(self, rows: np.ndarray) -> Mapping[Key, np.ndarray]:
        """Returns the starts of those of the runs that no instance plays yet."""
        return {self._keys[i]: self._starts[i] for i in rows if not self._begun[i]}

    def _leave(self, rows: np.ndarray) -> None:
        self._open[rows] = False
        keys = [self._keys[i] for i in rows if self._keys[i] in self._played]
        self._played.difference_update(keys)
        self._pool.leave(keys)

    def _rows(self, ids: np.ndarray | None) -> np.ndarray:
        return np.arange(self.n) if ids is None else np.asarray(ids)
