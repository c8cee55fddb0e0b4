"""The ways that a policy goes, which become the modes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.learning import WaySettings
from hyrl_mj.simulation import Passing, WayRuns, windings
from hyrl_mj.tasks import ANY, LEFT, RIGHT, Task, number_of, sides, wrapped

# The most modes of a controller.
MOST_MODES = 32
# Indices (k,) of nodes -> which of all nodes (n,) bool lie near them.
Near = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class HomotopyClasses:
    """The modes of a policy: the patterns of the ways that its runs go.

    A pattern holds, for each obstacle, whether it is passed on its `LEFT`, on its `RIGHT`, or `ANY` of them:
    an obstacle says nothing if all runs pass it on the same side, or if it does not lie between the start
    and the end of a run. The patterns of modes are those of which no other one says more, put together where
    they do not contradict: a mode says how to pass every obstacle about which starts decide. A state belongs
    to every mode that agrees with its pattern.

    Attributes:
        patterns: (Q, K) the pattern of each mode; a task's own direction is a pattern of one.
        modes: their numbers.
        dropped: numbers of the ways that too few of the nodes go from which a run can start.
        end: (K,) the usual bearing of the end of a run from each obstacle [rad].
        half: (K,) an obstacle lies between start and end if they are seen from it at more than this angle: at
            most a right one (Thales), lowered to the smallest angle at which the ways part, and to that of
            starts near there, but by no more than half [rad].
        decides: (K,) bool, whether runs pass the obstacle on both sides.
        arriving: whether enough runs arrive; if not, all show a way.
    """

    patterns: np.ndarray
    modes: tuple[int, ...]
    dropped: tuple[int, ...]
    end: np.ndarray
    half: np.ndarray
    decides: np.ndarray
    arriving: bool

    @staticmethod
    def from_runs(
        task: Task,
        runs: WayRuns,
        neighbours: tuple[np.ndarray, np.ndarray],
        near: Near | None = None,
        settings: WaySettings = WaySettings(),
    ) -> HomotopyClasses:
        """Returns the ways of runs from all nodes of a chart.

        They are those of the runs that arrive; if hardly any does, those of all runs.

        Args:
            task: the robot and its problem.
            runs: (n,) of the nodes.
            neighbours: (k,), (k,) indices of nodes that lie next to each other.
            near: tells which nodes are so close to others, where ways part, that they have to decide, too
                (see `make_partition`). By default none are.
            settings: how few nodes make no mode, and what is near.

        Raises:
            BadInput: there are more than `MOST_MODES` ways.
        """
        counted = runs.arrived if runs.arriving else runs.stable
        end = half = np.empty(0)
        decides = np.ones(1, dtype=bool)
        if (passing := runs.passing) is not None:
            last = passing.last[counted]
            end = np.arctan2(np.sin(last).sum(axis=0), np.cos(last).sum(axis=0))
            first, second = neighbours
            both = counted[first] & counted[second]
            first, second = first[both], second[both]
            part = windings(passing[first], passing[second]) != 0
            angle = np.abs(_angles(passing, end))
            half = np.full(angle.shape[1], np.pi / 2)
            for k, pairs in enumerate(part.T):
                at = np.unique([first[pairs], second[pairs]])
                if len(at):
                    close = counted & near(at) if near else at
                    near_by = settings.near_share * angle[at, k].min()
                    least = max(angle[close, k].min(), near_by)
                    half[k] = min(half[k], least)
            seen = sides(_angles(passing, end), half)[counted]
            decides = (seen == LEFT).any(axis=0) & (seen == RIGHT).any(axis=0)
        patterns = _patterns(runs, end, half, decides)[counted]
        kept, dropped = _modes(patterns, settings.least_share * runs.alive.sum())
        if len(kept):
            kept = _complete(kept, dropped)
        if len(kept) > MOST_MODES:
            raise BadInput(
                f"{task.name} has {len(kept)} ways, if not more, and a controller has at most {MOST_MODES} "
                "modes: train it in a smaller part of the scene, or give it a direction() that tells "
                "fewer apart"
            )
        numbers = (
            [kept[:, 0], dropped[:, 0]] if passing is None else [*map(number_of, (kept, dropped))]
        )
        order = np.argsort(numbers[0])
        modes, gone = (tuple(int(q) for q in values) for values in (numbers[0][order], numbers[1]))
        return HomotopyClasses(kept[order], modes, gone, end, half, decides, runs.arriving)

    def works(self, runs: WayRuns) -> np.ndarray:
        """Returns the runs (n,) bool that show the way of a mode, or nothing to decide."""
        shows = runs.shows if self.arriving else runs.stable
        return np.asarray(shows & self.members(runs).any(axis=1))

    def members(self, runs: WayRuns) -> np.ndarray:
        """Returns the modes that runs belong to: (n, Q) bool, none for runs of a way that is no mode."""
        patterns = _patterns(runs, self.end, self.half, self.decides)[:, None]
        agree = (patterns == self.patterns) | (patterns == ANY) | (self.patterns == ANY)
        return np.asarray(agree.all(axis=2))


def _patterns(runs: WayRuns, end: np.ndarray, half: np.ndarray, decides: np.ndarray) -> np.ndarray:
    """Returns the patterns (n, K) of runs, with `end`, `half` and `decides` as in `HomotopyClasses`."""
    if runs.direction is not None:
        return runs.direction[:, None]
    assert runs.passing is not None
    return np.where(decides, sides(_angles(runs.passing, end), half), ANY)


def _angles(passing: Passing, end: np.ndarray) -> np.ndarray:
    """Returns the angles (n, K) from the end to the start, followed back along the run [rad]."""
    return np.asarray(wrapped(passing.last - end) - passing.turned)


def _modes(patterns: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the patterns (P, K) of ways, and those (R, K) that are gone fewer than `least` times.

    Those are patterns of which no other one says more.
    """
    rows, counts = np.unique(patterns, axis=0, return_counts=True)
    decided = rows != ANY
    rows, counts = rows[decided.any(axis=1)], counts[decided.any(axis=1)]
    dropped: list[np.ndarray] = []
    while True:
        modes = [i for i, row in enumerate(rows) if _say_all(rows, row).sum() == 1]  # itself
        rare = [i for i in modes if counts[i] < least]
        if not rare:
            return rows[modes], np.reshape(dropped, (-1, patterns.shape[1])).astype(int)
        rarest = min(rare, key=lambda i: counts[i])
        dropped.append(rows[rarest])
        rows, counts = np.delete(rows, rarest, axis=0), np.delete(counts, rarest)


def _complete(modes: np.ndarray, dropped: np.ndarray) -> np.ndarray:
    """Returns the patterns (Q, K) that say all that patterns (P, K) without a contradiction say together.

    Where no start has to decide about two obstacles, each pattern would say something about only one of
    them, and the policy of such a mode would decide about the other by itself. Ways that were `dropped`
    (R, K) do not come back. There are no more than one too many for a controller, or P.
    """
    import networkx  # slow to import

    both = (modes != ANY) & (modes[:, None] != ANY)
    agree = (~both | (modes == modes[:, None])).all(axis=2)
    groups = networkx.find_cliques(networkx.from_numpy_array(agree))
    all_said = (modes[group].max(axis=0) for group in groups)  # ANY is less than both sides
    kept = (row for row in all_said if not any(_say_all(row, other) for other in dropped))
    joined = list(islice(kept, MOST_MODES + 1))
    alone = [row for row in modes if not any(_say_all(other, row) for other in joined)]
    return np.unique([*joined, *alone], axis=0)


def _say_all(patterns: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns whether patterns (..., K) say all that another (K,) says: (...) bool."""
    return np.asarray(((other == ANY) | (patterns == other)).all(axis=-1))
