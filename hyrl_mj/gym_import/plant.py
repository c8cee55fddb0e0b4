"""n runs of an environment as a plant: each is played by an instance from its start to its end."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from functools import cached_property
from itertools import count
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.pool import Pool
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.plant import MOST, checked, checked_inputs
from hyrl_mj.ranges import Integer
from hyrl_mj.tasks import Outcome

# Runs that are played by instances side by side, at most: each holds an environment in memory.
PLAYED = 1024
_NUMBERS = count()


def check_finite(name: str, seen: np.ndarray) -> None:
    """Raises `BadInput` unless observations (k, o) of an environment of a name are finite numbers."""
    if (blank := np.argwhere(~np.isfinite(seen))).size:
        row, column = blank[0]
        raise BadInput(
            f"{name} observes {seen[row, column]} in observation[{column}], and policies take "
            "finite numbers: let it observe finite numbers, such as the longest range of a sensor"
        )


class EnvironmentPlant:
    """n runs of an environment, with the interface of `hyrl_mj.physics.plant.Plant`.

    A run is played from its start: nothing is saved or restored on its way. `observe` gives it the noise of a
    sample before it is stepped; a run that is stepped without has none.

    Args:
        pool: plays the runs.
        model: of MuJoCo.
        n: number of runs.
        written: whether states are written, and no instance plays a run: without a memory, that is the same.
    """

    invertible = False

    def __init__(self, pool: Pool, model: Any, n: int, written: bool = False):
        self.n = Integer(1, MOST).checked("the number of copies of a robot", n)
        self.spec, self._pool, self.model, self._written = pool.spec, pool, model, written
        spec = self.spec
        self.low, self.high, self.late = spec.low, spec.high, spec.wrapped
        self._runs, self._places = next(_NUMBERS) * MOST + np.arange(n), pool.places(n)
        self._state = np.tile(spec.state, (n, 1))
        self._seen = slice(spec.dimension, spec.dimension + spec.columns)
        self._truth = np.zeros((n, spec.dimension + spec.columns + 3))
        self._unstable = np.zeros(n, dtype=bool)
        self._open = np.zeros(n, dtype=bool)  # whether the sample has not been observed yet
        self._plays = np.zeros(n, dtype=bool)  # whether an instance plays the run
        # Not at once: a plant may be collected while the pool is at work.
        left = self._places, self._runs, self._plays
        weakref.finalize(self, pool.left.append, left).atexit = False

    # ---- what is measured

    @property
    def measurement(self) -> np.ndarray:
        """The current measurement (n, p), a copy; what no noise was given for is observed without."""
        if self.spec.wrapped:
            self._sense(np.flatnonzero(self._plays))
        return self._truth.copy()

    def truth(self, ids: np.ndarray) -> np.ndarray:
        """Returns the current measurement (k, p) of runs `ids` (k,), before the sample has been observed."""
        return self._truth[ids]

    def observe(self, true: np.ndarray, noise: np.ndarray, ids: np.ndarray) -> np.ndarray:
        """Returns the noisy measurements (k, p) of runs `ids` (k,), under noise (k, p) of this sample.

        Each run can be observed once in each sample: what remembers its observations then has seen it.
        """
        d, measured = self.spec.dimension, true.copy()
        if (beside := noise[:, d:].any(axis=0)).any():
            raise BadInput(
                f"noise acts on column {d + int(beside.argmax())} of the measurement, and in "
                f"{self.spec.name} it is added to the chart, columns 0 to {d - 1}: what is observed there "
                "follows it"
            )
        needed = noise[:, :d].any(axis=1) | self.spec.wrapped
        self._sense(ids[needed], noise[needed, :d])
        self._open[ids] = False
        measured[:, :d] += noise[:, :d]
        measured[:, self._seen] = self._truth[ids, self._seen]
        return measured

    def _sense(self, rows: np.ndarray, noise: np.ndarray | None = None) -> None:
        """Has runs (k,) that go on, and have not observed yet, do so under noise (k, d), by default none."""
        waits = self._open[rows] & (self._outcome[rows] == Outcome.RUNNING)
        noise = np.zeros((len(rows), self.spec.dimension)) if noise is None else noise
        rows, noise = rows[waits], noise[waits]
        if not len(rows):
            return
        if self._written:
            raise BadInput(
                f"{self.spec.name} cannot be observed under noise where states are written"
            )
        begun = self._plays[rows]
        self._begin(rows)
        seen, reports = self._ask("sense", rows, noise)
        self._open[rows] = False
        self._truth[rows, self._seen] = seen
        if self.spec.wrapped:
            self._judge(rows[begun], reports[begun])

    @property
    def _outcome(self) -> np.ndarray:
        return self._truth[:, -1]

    def _begin(self, rows: np.ndarray) -> None:
        """Gives those of the runs an instance that have none."""
        if len(new := rows[~self._plays[rows]]):
            if self._plays.sum() + len(new) > PLAYED:
                raise BadInput(
                    f"{self.n} episodes of {self.spec.name} side by side need as many environments in "
                    f"memory: give at most {PLAYED}"
                )
            self._ask("begin", new, self._state[new])
            self._plays[new] = True

    def _ask(self, what: str, rows: np.ndarray, *values: np.ndarray) -> Any:
        """Has the instances of runs (k,) do something with values (k, ...); see `Stage`."""
        return self._pool.ask(what, self._places[rows], self._runs[rows], *values)

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
        return self._geoms[None, list(ids)]

    @cached_property
    def _geoms(self) -> np.ndarray:
        return mjcf.geom_positions(self.model, list(range(self.model.ngeom)))

    def set_state(
        self, qpos: np.ndarray, qvel: np.ndarray | None = None, ids: np.ndarray | None = None
    ) -> None:
        """Begins the runs `ids` (k,) anew at qpos (k, nq) and qvel (k, nv), all else as after a reset.

        Raises:
            BadInput: a wrong shape or a value that is not finite.
        """
        rows, nq, nv = self._rows(ids), len(self.spec.qpos), len(self.spec.qvel)
        qvel = np.zeros((len(rows), nv)) if qvel is None else qvel
        state = np.tile(self.spec.state, (len(rows), 1))
        state[:, self.spec.qpos] = checked("qpos", qpos, nq, rows)
        state[:, self.spec.qvel] = checked("qvel", qvel, nv, rows)
        self.resume(state, rows)

    def resume(self, state: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Begins the runs `ids` (k,), all by default, in whole states (k, nstate) as `state` gives them."""
        rows = self._rows(ids)
        self._leave(rows)
        self._state[rows] = state
        self._unstable[rows], self._open[rows] = False, True
        seen, depths = self._pool.scatter("rest", self._state[rows])
        blocked = depths > self.spec.depth
        check_finite(self.spec.name, seen[~blocked])
        outcome = np.where(blocked, Outcome.CRASHED, Outcome.RUNNING)
        nothing = np.zeros((len(rows), 2))
        self._truth[rows] = np.column_stack(
            [self.spec.z(self._state[rows]), seen, nothing, outcome]
        )

    def step(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Steps the runs `ids` (k,), all by default, with inputs u (k, m).

        Raises:
            BadInput: a wrong shape, a value that is not finite, or one outside the input limits.
        """
        rows = self._rows(ids)
        u = checked_inputs(u, self.low, self.high, rows, self.spec.name)
        if self.spec.wrapped and not self._written:  # what the last step came to may be an end
            self._sense(rows)
        # A run that is over stays where it ended.
        goes_on = (self._outcome[rows] == Outcome.RUNNING) & ~self._unstable[rows]
        rows, u = rows[goes_on], u[goes_on]
        if not len(rows):
            return
        if self._written:
            states, seen, reports = self._pool.scatter("branch", self._state[rows], u)
        else:
            self._begin(rows)
            states, seen, reports = self._ask("act", rows, u)
        self._open[rows] = True
        finite = np.isfinite(states).all(axis=1)
        check_finite(self.spec.name, seen[finite])
        some = rows[finite]
        self._state[some] = states[finite]
        self._truth[some, : self.spec.dimension] = self.spec.z(states[finite])
        self._truth[some, self._seen] = seen[finite]
        self._unstable[rows[~finite]] = True
        if not self.spec.wrapped:
            self._judge(rows, reports)
        self._leave(rows[~finite])

    def end(self, ids: np.ndarray | None = None) -> None:
        """Ends the runs `ids` (k,), all by default.

        Raises:
            BadInput: random numbers were drawn in one of them.
        """
        self._leave(self._rows(ids))

    def put(self, state: np.ndarray) -> None:
        """Refuses: runs are played from their starts."""
        raise BadInput(f"no state can be written to a run of the environment {self.spec.name}")

    def step_backward(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Refuses: an environment cannot be run backward."""
        raise BadInput(f"the environment {self.spec.name} cannot be run backward")

    def _judge(self, rows: np.ndarray, reports: np.ndarray) -> None:
        """Notes what the environment reported of runs, and lets go of those that are over."""
        success, outcome = self.spec.criterion.judged(reports)
        self._truth[rows, -3:] = np.column_stack([reports[:, 0], success, outcome])
        self._leave(rows[outcome != Outcome.RUNNING])

    def _leave(self, rows: np.ndarray) -> None:
        self._open[rows] = False
        if len(rows := rows[self._plays[rows]]):
            self._plays[rows] = False
            self._ask("leave", rows)

    def _rows(self, ids: np.ndarray | None) -> np.ndarray:
        return np.arange(self.n) if ids is None else np.asarray(ids)
