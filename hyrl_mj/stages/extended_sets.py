"""Stage 5 (paper, Step 5): the extended sets M_ext_i, which overlap over the critical set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import ClassVar

import numpy as np

from hyrl_mj.errors import BadInput, counted
from hyrl_mj.files.artifacts import Saved
from hyrl_mj.judging.game import Limit, nearest_of
from hyrl_mj.learning import OverlapSettings
from hyrl_mj.policies import Policy
from hyrl_mj.sets import Grid, GridSet, check_points, distance_to
from hyrl_mj.stages.meeting import least_room, where
from hyrl_mj.stages.partition import (
    Partition,
    check_sets,
    longest_hop,
    neighbourhood,
    open_ways,
    part_policies,
)
from hyrl_mj.stages.reach import backward_reach, forward_reach, runs_from_outside, shortest
from hyrl_mj.stages.refinement import refined
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class ExtendedSets(Saved):
    """The extended sets M_ext_i (paper, Step 5).

    Attributes:
        modes: the modes.
        sets: M_ext_i of each mode, in the same order.
        winning: W_i, the winning region of each mode, as (N,) bool over the grid's nodes: from there pi_i
            reaches the set-point.
        horizon: time T of the backward propagation [s]; 0 without propagation.
        eps: bound of the measurement noise that the sets are made for.
        points: (K, d) points of M* where modes meet, and the way of one of them is open.
        room: (K,) how far across M* two modes that meet there both win, in the unit of the noise; 2 eps are
            needed.
        between: (K, 2) the numbers of these two modes: of all that meet there those with the least room.
    """

    KIND: ClassVar[str] = "extended sets"

    modes: tuple[int, ...]
    sets: tuple[GridSet, ...]
    winning: tuple[np.ndarray, ...]
    horizon: float
    eps: float
    points: np.ndarray
    room: np.ndarray
    between: np.ndarray = field(default_factory=lambda: np.empty((0, 2), dtype=int))

    def __post_init__(self) -> None:
        check_sets(self.modes, self.sets, self.winning)
        k = len(self.points)
        if self.room.shape != (k,) or self.between.shape != (k, 2):
            raise BadInput(
                f"room of shape {self.room.shape} between modes of shape {self.between.shape} does not fit "
                f"{k} points of M*: give ({k},) and ({k}, 2)"
            )

    def __repr__(self) -> str:
        shares = [f"{q}: {m.share:.1%}" for q, m in zip(self.modes, self.sets, strict=True)]
        return f"ExtendedSets({', '.join(shares)} of the chart, eps {self.eps:g})"

    def sentence(self, task: Task) -> str:
        """Returns a one-line description."""
        if len(self.sets) < 2:
            return "one mode, whose set is the whole chart"
        reach = f"T = {self.horizon:.2g} s" if self.horizon else "as far as the ways are open"
        text = f"{len(self.sets)} extended sets, {reach}{self._shared()}"
        return "; ".join([text, *self._narrow_places(task)])

    @property
    def narrow(self) -> np.ndarray:
        """Whether the noise needs more room than two modes have at each of the points: (K,) bool."""
        return np.asarray(self.room < 2 * self.eps - self.sets[0].grid.cell)

    def _narrow_places(self, task: Task) -> Iterator[str]:
        """Yields between which modes nobody can change over in time, and where."""
        unit, narrow = task.noise_on()[1], self.narrow
        pairs, counts = np.unique(self.between[narrow], axis=0, return_counts=True)
        most = np.argsort(-counts, kind="stable")[:3]
        for pair in pairs[most]:
            here = (self.between == pair).all(axis=1)
            first, second = map(task.mode_name, pair.tolist())
            left = self.room[here & narrow].min()
            place = where(task.chart, self.points[here], narrow[here])
            yield (
                f"between {first} and {second} nobody can change over safely {place}: "
                f"{2 * self.eps:g} {unit} of room are needed, and as little as {left:.2g} is left"
            )
        if more := len(pairs) - len(most):
            yield f"nor in places between {counted(more, 'other pair')} of modes"

    def _shared(self) -> str:
        """Returns how much of the chart the sets of modes that meet share."""
        sets = dict(zip(self.modes, self.sets, strict=True))
        pairs = np.unique(self.between, axis=0).tolist()
        shares = [100 * (sets[a] & sets[b]).share for a, b in pairs]
        if not shares:
            return ""
        if len(self.sets) == 2:
            return f", which share {shares[0]:.1f}% of the chart"
        least, most = min(shares), max(shares)
        much = f"{least:.1f}%" if most - least < 0.05 else f"{least:.1f} to {most:.1f}%"
        return f", those of two modes that meet share {much} of the chart"


def extend(
    task: Task,
    policy: Policy,
    points: np.ndarray,
    partition: Partition,
    eps: float,
    horizon: float | None = None,
    ways: Limit | None = None,
    settings: OverlapSettings = OverlapSettings(),
) -> ExtendedSets:
    """Extends the parts over M* (paper, Steps 4 and 5).

    X_i are the states outside M_i that x' = -f(x, pi_i(x)) reaches from the neighbourhood of M* within the
    horizon; for a plant that cannot run backward, those that pi_i brings into M_i within the horizon. They
    are trimmed to where mode i still succeeds, with room for the noise. Every part is widened by the noise
    bound, so that a wrong measurement does not switch back:

        M_ext_i = ((M_i u X_i) n (W_i eroded by eps)) u (M_i dilated by eps)

    Erosion and dilation act along the noisy coordinates. For a plant with dynamics the dilation is by the
    longest hop in one sample more. A wall that only stops the robot is not eroded from, and its inside
    belongs to the sets of the states beside it.

    Args:
        task: gives plant and chart.
        policy: the stage-1 policy.
        points: (N, d) of M*, from stage 2.
        partition: M_i, from stage 3.
        eps: bound of the measurement noise.
        horizon: time T of the backward propagation [s]. By default, the shortest with which every set
            reaches 2 eps and one sample over M* wherever its mode succeeds; the sets end there.
        ways: from where each way is open, for an agent. Beyond its decision an agent may be unable to go
            the other way, but stage 6 trains the mode to do so: W_i is then where way i is open. Without a
            horizon, every set reaches 2 eps and one sample over the boundary of its part.
        settings: when a horizon is long enough, and what is a gap.
    """
    points = check_points(task.chart, points, task.name)
    case = _Case(task, policy, points, partition, eps, horizon, settings)
    winning = case.winning() if ways is None else open_ways(ways, partition.grid)
    roomy = case.trim(winning)
    if ways is None or horizon is not None:
        reached, propagated = case.reach(roomy)
    else:
        reached, propagated = case.wanted, 0.0
    rows, pair, room = least_room(case.points, case.parts, winning, case.eps)
    return ExtendedSets(
        partition.modes,
        case.widen(reached, roomy),
        winning,
        propagated,
        eps,
        case.points[rows],
        2 * eps * room,
        np.array(partition.modes)[pair],
    )


class _Case:
    """What is extended, step by step; the arguments are those of `extend`.

    Attributes:
        eps, hop: (d,) the noise, and the longest hop in one sample, along each coordinate.
        wanted: each part with 2 eps and one sample around it.
        around: (N,) bool, the nodes so near to M* that they have to be covered: where parts meet elsewhere,
            as at the set-point, nothing is left to decide.
        walls: (N,) bool, the nodes in walls that only stop the robot.
    """

    def __init__(
        self,
        task: Task,
        policy: Policy,
        points: np.ndarray,
        partition: Partition,
        eps: float,
        horizon: float | None,
        settings: OverlapSettings,
    ):
        self.task, self.points, self.partition = task, points, partition
        self.horizon, self.settings = horizon, settings
        self.grid, self.parts = partition.grid, partition.parts
        self.eps, self.hop = task.noise_in_chart(eps), longest_hop(task, policy, self.grid)
        near = neighbourhood(partition, eps, self.hop)
        self._pis = part_policies(task, policy, partition, near)
        by = 2 * self.eps + self.hop * (task.noise_in_chart(1.0) > 0)
        self.wanted = [part.dilated_by_box(by) for part in self.parts]
        # The extended sets lie among these candidates.
        radius = 3 * eps + near + (0.0 if horizon is None else horizon / task.dt * near)
        self._candidates = [part.dilated(radius).mask for part in self.parts]
        off = distance_to(task.chart, points, self.grid.nodes)
        self.around = off <= float(np.linalg.norm((2 * self.eps + self.hop) / task.chart.scale))
        # The cells that backward runs visit are those of a grid.
        self._backward = task.kinematic and isinstance(self.grid, Grid)
        self._rims = [part.mask & (off <= near) for part in self.parts]
        longest = round(settings.longest / task.dt)
        # The same runs from outside of a part tell from where its way succeeds, and when they enter the part.
        self._told = [
            cache(partial(
                refined, task, self.grid, candidate & ~part.mask, points, radius,
                partial(
                    runs_from_outside, task, pi, partition, part,
                    None if self._backward else rim, longest,
                ), 2,
            ))
            for pi, part, rim, candidate in zip(
                self._pis, self.parts, self._rims, self._candidates, strict=True
            )
        ]  # fmt: skip
        nowhere = np.zeros(self.grid.size, dtype=bool)
        self.walls = ~task.goes_on(self.grid.nodes) if task.abilities.stopped_by_walls else nowhere

    def winning(self) -> tuple[np.ndarray, ...]:
        """Returns W_i, the nodes (N,) bool from which the policy of a part arrives by its own way."""
        return tuple(
            (self.partition.succeeds & part.mask) | (known()[:, 0] > 0)
            for part, known in zip(self.parts, self._told, strict=True)
        )

    def trim(self, winning: Sequence[np.ndarray]) -> list[GridSet]:
        """Returns W_i (N,) bool with room for the noise.

        Noise that shows the robot in a wall that only stops it does not show it where its mode fails.
        """
        return [
            GridSet.from_mask(self.grid, wins | ~candidate | self.walls).eroded_by_box(self.eps)
            for wins, candidate in zip(winning, self._candidates, strict=True)
        ]

    def reach(self, roomy: Sequence[GridSet]) -> tuple[list[GridSet], float]:
        """Returns M_i u X_i, and the time T of the propagation [s]."""
        if len(self.parts) < 2:
            return (self.wanted if self.horizon is None else [*self.parts]), self.horizon or 0.0
        within = [
            backward_reach(self.task, pi, part, rim, self.settings.gap)
            if self._backward
            else forward_reach(part, known()[:, 2])
            for pi, part, rim, known in zip(
                self._pis, self.parts, self._rims, self._told, strict=True
            )
        ]
        goals = [
            (w & room).mask & ~part.mask & self.around
            for w, room, part in zip(self.wanted, roomy, self.parts, strict=True)
        ]
        given = max(round(self.horizon / self.task.dt), 1) if self.horizon else None
        k = given or shortest(self.task, within, goals, self.settings)
        reached = [part | reach(k) for part, reach in zip(self.parts, within, strict=True)]
        if self.horizon is None:
            reached = [r & w for r, w in zip(reached, self.wanted, strict=True)]
        return reached, self.horizon or k * self.task.dt

    def widen(self, reached: Sequence[GridSet], roomy: Sequence[GridSet]) -> tuple[GridSet, ...]:
        """Returns M_ext_i.

        With inertia a run goes on for a sample before the new mode tells: chattering would cross a set that
        is just as wide as the noise.
        """
        wide = self.eps if self.task.kinematic else self.eps + self.hop * (self.eps > 0)
        sets = tuple(
            (r & room) | part.dilated_by_box(wide)
            for r, room, part in zip(reached, roomy, self.parts, strict=True)
        )
        if self.walls.any():  # where noise shows the robot in a wall, it is beside it
            beside = nearest_of(self.grid, ~self.walls)
            sets = tuple(GridSet.from_mask(self.grid, own.mask[beside]) for own in sets)
        return sets
