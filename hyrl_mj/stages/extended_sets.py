"""Stage 5: extend each part over the critical set, by running the closed loop backward."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hyrl_mj.artifacts import Saved
from hyrl_mj.game import NEVER, Limit
from hyrl_mj.policies import Policy
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.critical_set import check_points, distance_to
from hyrl_mj.stages.partition import Partition, check_sets, part_policies
from hyrl_mj.stages.reachability import (
    backward_reach,
    forward_reach,
    longest_hop,
    longest_samples,
    part_wins,
)
from hyrl_mj.tasks import Task

# The neighbourhood of M* is at least this many cells wide, and as wide as the loop goes in one sample.
NEIGHBOURHOOD_CELLS = 4
# A horizon is long enough when the backward runs have filled this share of the overlap that is wanted.
FILLED = 0.995


@dataclass(frozen=True)
class ExtendedSets(Saved):
    """M_ext_i for each mode (paper, Step 5).

    Attributes:
        modes: the modes.
        sets: M_ext_i, in the same order.
        winning: W_i as (N,) bool over the grid's nodes: where pi_i reaches its goal.
        horizon: time T of the backward propagation [s]; 0 if there was none.
        noise: bound eps of the measurement noise that the sets are made for.
        narrow: (K, d) points of M* at which a mode has less room than the noise asks for.
        room: (K,) the room there is, across, in chart units; 2 eps are needed.
    """

    KIND: ClassVar[str] = "extended sets"

    modes: tuple[int, ...]
    sets: tuple[GridSet, ...]
    winning: tuple[np.ndarray, ...]
    horizon: float
    noise: float
    narrow: np.ndarray
    room: np.ndarray

    def __post_init__(self) -> None:
        check_sets(self.modes, self.sets, self.winning)

    def __repr__(self) -> str:
        shares = [f"{q}: {m.mask.mean():.1%}" for q, m in zip(self.modes, self.sets, strict=True)]
        return f"ExtendedSets({', '.join(shares)} of the chart, eps {self.noise:g})"

    def sentence(self, task: Task) -> str:
        """Returns a one-line description."""
        if len(self.sets) < 2:
            return "one mode, its set is everything"
        both = self.sets[0] & self.sets[1]
        share = both.mask.mean()
        reach = f"T = {self.horizon:.2g} s" if self.horizon else "as far as the ways are open"
        text = f"{len(self.sets)} extended sets, {reach}, the first two share {100 * share:.1f}% of the chart"
        if not len(self.narrow):
            return text
        low, high, chart = self.narrow.min(axis=0), self.narrow.max(axis=0), task.chart
        where = ", ".join(
            f"{name} {a:.3g} to {b:.3g} {unit}" if b - a > 1e-3 else f"{name} {a:.3g} {unit}"
            for name, unit, a, b in zip(chart.names, chart.units, low, high, strict=True)
        )
        return (
            f"{text}; no overlap can be wide enough for noise {self.noise:g} at {where}: "
            f"{2 * self.noise:g} of room are needed there and as little as {self.room.min():.2g} is left"
        )


def extend(
    task: Task,
    policy: Policy,
    points: np.ndarray,
    partition: Partition,
    noise: float,
    horizon: float | None = None,
    ways: Limit | None = None,
) -> ExtendedSets:
    """Extends the parts over M* (paper, Steps 4 and 5).

    X_i are the states that x' = -f(x, pi_i(x)) reaches outside M_i within the horizon, from the
    neighbourhood of M*; for a plant that cannot be run backward, those outside M_i that pi_i brings into
    M_i within the horizon. They are trimmed to where mode i still succeeds, with room for the noise, and
    every part is widened by the noise bound, so that a wrong measurement does not flip the mode back:

        M_ext_i = ((M_i u X_i) n (W_i eroded by eps)) u (M_i dilated by eps)

    Erosion and dilation act along the coordinates that are measured with noise.

    Args:
        task: gives plant and chart.
        policy: the stage-1 policy.
        points: (N, d) of M*, from stage 2.
        partition: M_i, from stage 3.
        noise: bound eps of the measurement noise.
        horizon: time T of the backward propagation [s]. By default the shortest with which every set
            reaches 2 eps and one sample over M*, where its mode still succeeds, and then no farther.
        ways: which way is open from where. An agent need not know how to go on its way from beyond the
            place where it decides otherwise; with `ways` W_i is where way i is open, for the mode will be
            trained to go it, and without a horizon every set reaches 2 eps and one sample over the
            boundary of its part there.
    """
    points = check_points(task, points)
    grid, parts = partition.grid, partition.parts
    eps, hop = task.noise_in_chart(noise), longest_hop(task, policy, grid)
    near = neighbourhood(grid, noise, hop)
    pis = part_policies(task, policy, partition, near)
    wanted = [part.dilated_by_box(2 * eps + hop * (task.noise_in_chart(1.0) > 0)) for part in parts]
    # W_i, wherever a set may come to lie.
    radius = 3 * noise + near + (0.0 if horizon is None else horizon / task.dt * near)
    if ways is None:
        winning = tuple(
            part_wins(task, pi, partition, part, part.dilated(radius))
            for pi, part in zip(pis, parts, strict=True)
        )
    else:
        winning = open_ways(ways, grid)
    roomy = [
        GridSet.from_mask(grid, wins | ~part.dilated(radius).mask).eroded_by_box(eps)
        for wins, part in zip(winning, parts, strict=True)
    ]
    # Only M* is to be covered; parts that meet again elsewhere, at the set-point, have nothing to decide.
    off = distance_to(task, points, grid.nodes)
    around = off <= float(np.linalg.norm(2 * eps + hop))
    reached = list(parts)
    running = len(parts) > 1 and (ways is None or horizon is not None)
    if running:
        reach = [
            backward_reach(task, pi, part, part.mask & (off <= near))
            if task.kinematic
            else forward_reach(task, pi, part, part.mask & (off <= near), part.dilated(radius).mask)
            for pi, part in zip(pis, parts, strict=True)
        ]
    steps = [max(round(horizon / task.dt), 1)] if horizon else range(1, longest_samples(task) + 1)
    for k in steps if running else ():
        reached = [part | within(k) for part, within in zip(parts, reach, strict=True)]
        goals = [
            (w & r).mask & ~p.mask & around for w, r, p in zip(wanted, roomy, parts, strict=True)
        ]
        filled = [r.mask[goal].mean() for r, goal in zip(reached, goals, strict=True) if goal.any()]
        if min(filled, default=1.0) >= FILLED:
            break
    if horizon is None:
        reached = [r & w for r, w in zip(reached, wanted, strict=True)] if running else wanted
    sets = tuple(
        (r & room) | part.dilated_by_box(eps)
        for r, room, part in zip(reached, roomy, parts, strict=True)
    )
    narrow, room = room_along(task, points, partition, winning, eps)
    propagated = horizon or (k * task.dt if running else 0.0)
    return ExtendedSets(partition.modes, sets, winning, propagated, noise, narrow, room)


def open_ways(ways: Limit, grid: Grid) -> tuple[np.ndarray, ...]:
    """Returns where on a grid each mode's way is open: (N,) bool for each."""
    at = ways.lattice.grid.nearest(grid.nodes)
    return tuple(samples[at] < NEVER for samples in ways.samples)


def with_room(
    task: Task, policy: Policy, partition: Partition, ways: Limit, noise: float
) -> Partition:
    """Returns the parts, changed where the policy goes a way that is about to close while another is not.

    A policy that drives towards the obstacle's middle and decides at the last moment leaves no room for an
    overlap. So a state with less room for its way than 2 eps and one sample belongs to the mode whose way
    has the most. Where every way has that room, or none, the policy's own decision stands.

    Args:
        task: gives the noisy coordinates.
        policy: the agent.
        partition: M_i, by the way that it goes.
        ways: which way is open from where.
        noise: bound eps of the measurement noise.
    """
    grid = partition.grid
    if len(partition.parts) < 2:
        return partition
    hop = longest_hop(task, policy, grid) * (task.noise_in_chart(1.0) > 0)
    wanted = float((2 * task.noise_in_chart(noise) + hop).max())
    room = -np.stack([GridSet.from_mask(grid, open_).values for open_ in open_ways(ways, grid)])
    masks = np.stack([part.mask for part in partition.parts])
    own = np.where(masks, room, -np.inf).max(axis=0)
    best = room.argmax(axis=0)
    moved = (masks.sum(axis=0) == 1) & (own < wanted) & (room.max(axis=0) > np.maximum(own, 0))
    parts = tuple(
        GridSet.from_mask(grid, np.where(moved, best == i, mask)) for i, mask in enumerate(masks)
    )
    return Partition(partition.modes, parts, partition.succeeds)


def boundary(partition: Partition) -> np.ndarray:
    """Returns points (N, d) between neighbouring nodes of which no part holds both."""
    grid = partition.grid
    first, second = grid.neighbours()
    shared = np.any([part.mask[first] & part.mask[second] for part in partition.parts], axis=0)
    a, b = grid.nodes[first[~shared]], grid.nodes[second[~shared]]
    return np.asarray(a + grid.chart.difference(b, a) / 2)


def neighbourhood(grid: Grid, noise: float, hop: np.ndarray) -> float:
    """Returns the distance from M* that counts as near it: the noise, some cells, and a sample's way (d,)."""
    return max(noise, NEIGHBOURHOOD_CELLS * grid.cell, float(np.linalg.norm(hop)))


def room_along(
    task: Task,
    points: np.ndarray,
    partition: Partition,
    winning: tuple[np.ndarray, ...],
    eps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns where on M* a mode has less than 2 eps (d,) of room across M*, though some mode wins there.

    Args:
        task: gives the chart.
        points: (N, d) of M*.
        partition: gives the grid.
        winning: W_i of each mode, (N,) bool over the nodes.
        eps: (d,) noise bound along each coordinate.

    Returns:
        Points (K, d) of M*, and the room (K,) at each: how far to either side all modes still succeed.
    """
    grid = partition.grid
    shares = np.arange(0.0, 1.0 + 1e-9, 0.02)
    reach = 2 * eps.max(initial=0.0)
    if not len(points) or not reach or len(winning) < 2:
        return np.empty((0, task.chart.dimension)), np.empty(0)
    room = np.full(len(points), reach)
    for direction in np.vstack([np.diag(2 * eps), -np.diag(2 * eps)]):
        if not direction.any():
            continue
        line = grid.nearest((points[:, None] + shares[:, None] * direction).reshape(-1, len(eps)))
        for wins in winning:
            ok = wins[line].reshape(len(points), -1)
            first = np.where(ok.all(axis=1), len(shares), ok.argmin(axis=1))
            room = np.minimum(room, np.maximum(first - 1, 0) * 0.02 * reach)
    someone = np.any([wins[grid.nearest(points)] for wins in winning], axis=0)
    narrow = someone & (room < reach - grid.cell)
    return points[narrow], room[narrow]
