"""Stage 5 (paper, Step 5): the extended sets M_ext_i, which overlap over the critical set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hyrl_mj.artifacts import Saved
from hyrl_mj.game import Limit
from hyrl_mj.policies import Policy
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.critical_set import check_points, distance_to, policy_runs, ranges
from hyrl_mj.stages.partition import (
    Partition,
    PartPolicy,
    check_sets,
    longest_hop,
    neighbourhood,
    open_ways,
    part_policies,
)
from hyrl_mj.tasks import Outcome, Task

# A horizon is long enough when the propagated sets fill this share of the overlap that the noise needs.
FILLED = 0.995
# Gaps of this many cells between the samples of the backward runs are closed.
GAP_CELLS = 1.5
# The longest horizon that is tried [s].
LONGEST_HORIZON = 2.0


@dataclass(frozen=True)
class ExtendedSets(Saved):
    """The extended sets M_ext_i (paper, Step 5).

    Attributes:
        modes: the modes.
        sets: M_ext_i of each mode, in the same order.
        winning: W_i as (N,) bool over the grid's nodes, from where pi_i reaches the set-point.
        horizon: time T of the backward propagation [s]; 0 without propagation.
        noise: bound eps of the measurement noise that the sets are made for.
        narrow: (K, d) points of M* where the noise needs more room than a mode has.
        room: (K,) room across M* at these points, in chart units; 2 eps are needed.
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
            return "one mode, whose set is the whole chart"
        share = (self.sets[0] & self.sets[1]).mask.mean()
        reach = f"T = {self.horizon:.2g} s" if self.horizon else "as far as the ways are open"
        text = f"{len(self.sets)} extended sets, {reach}, the first two share {100 * share:.1f}% of the chart"
        if not len(self.narrow):
            return text
        return (
            f"{text}; no overlap can be wide enough for noise {self.noise:g} at "
            f"{ranges(task.chart, self.narrow, 1e-3)}: {2 * self.noise:g} of room are needed there and as "
            f"little as {self.room.min():.2g} is left"
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

    X_i are the states outside M_i that x' = -f(x, pi_i(x)) reaches from the neighbourhood of M* within the
    horizon; for a plant that cannot run backward, those that pi_i brings into M_i within the horizon. They
    are trimmed to where mode i still succeeds, with room for the noise. Every part is widened by the noise
    bound, so that a wrong measurement does not switch back:

        M_ext_i = ((M_i u X_i) n (W_i eroded by eps)) u (M_i dilated by eps)

    Erosion and dilation act along the noisy coordinates.

    Args:
        task: gives plant and chart.
        policy: the stage-1 policy.
        points: (N, d) of M*, from stage 2.
        partition: M_i, from stage 3.
        noise: bound eps of the measurement noise.
        horizon: time T of the backward propagation [s]. By default, the shortest with which every set
            reaches 2 eps and one sample over M* wherever its mode succeeds; the sets end there.
        ways: from where each way is open, for an agent. Beyond its decision an agent may be unable to go
            the other way, but stage 6 trains the mode to do so: W_i is then where way i is open. Without a
            horizon, every set reaches 2 eps and one sample over the boundary of its part.
    """
    points = check_points(task, points)
    grid, parts = partition.grid, partition.parts
    eps, hop = task.noise_in_chart(noise), longest_hop(task, policy, grid)
    near = neighbourhood(grid, noise, hop)
    pis = part_policies(task, policy, partition, near)
    wanted = [part.dilated_by_box(2 * eps + hop * (task.noise_in_chart(1.0) > 0)) for part in parts]
    # The extended sets lie among these candidates.
    radius = 3 * noise + near + (0.0 if horizon is None else horizon / task.dt * near)
    candidates = [part.dilated(radius).mask for part in parts]
    if ways is None:
        winning = tuple(
            _part_wins(task, pi, partition, part, candidate)
            for pi, part, candidate in zip(pis, parts, candidates, strict=True)
        )
    else:
        winning = open_ways(ways, grid)
    roomy = [
        GridSet.from_mask(grid, wins | ~candidate).eroded_by_box(eps)
        for wins, candidate in zip(winning, candidates, strict=True)
    ]
    # Only M* has to be covered: where parts meet elsewhere, as at the set-point, nothing is left to decide.
    off = distance_to(task, points, grid.nodes)
    around = off <= float(np.linalg.norm(2 * eps + hop))
    propagated = horizon or 0.0
    if len(parts) > 1 and (ways is None or horizon is not None):
        reach = [
            _backward_reach(task, pi, part, part.mask & (off <= near))
            if task.kinematic
            else _forward_reach(task, pi, part, part.mask & (off <= near), candidate)
            for pi, part, candidate in zip(pis, parts, candidates, strict=True)
        ]
        goals = [
            (w & room).mask & ~part.mask & around
            for w, room, part in zip(wanted, roomy, parts, strict=True)
        ]
        longest = round(LONGEST_HORIZON / task.dt)
        for k in [max(round(horizon / task.dt), 1)] if horizon else range(1, longest + 1):
            reached = [part | within(k) for part, within in zip(parts, reach, strict=True)]
            pairs = zip(reached, goals, strict=True)
            filled = [r.mask[goal].mean() for r, goal in pairs if goal.any()]
            if min(filled, default=1.0) >= FILLED:
                break
        propagated = horizon or k * task.dt
        if horizon is None:
            reached = [r & w for r, w in zip(reached, wanted, strict=True)]
    else:
        reached = wanted if horizon is None else list(parts)
    sets = tuple(
        (r & room) | part.dilated_by_box(eps)
        for r, room, part in zip(reached, roomy, parts, strict=True)
    )
    narrow, room = _narrow(task, points, grid, winning, eps)
    return ExtendedSets(partition.modes, sets, winning, propagated, noise, narrow, room)


def _part_wins(
    task: Task, pi: PartPolicy, partition: Partition, part: GridSet, candidates: np.ndarray
) -> np.ndarray:
    """Returns W_i: the nodes (N,) bool among the candidates (N,) from which pi_i reaches the set-point."""
    wins = partition.succeeds & part.mask
    outside = np.flatnonzero(candidates & ~part.mask)
    if len(outside):
        rollout = policy_runs(task, pi, part.grid.nodes[outside], label="extended sets")
        wins[outside] = rollout.outcome == Outcome.REACHED
    return wins


def _backward_reach(
    task: Task, pi: PartPolicy, part: GridSet, rim: np.ndarray
) -> Callable[[int], GridSet]:
    """Returns M_i u X_i as a function of the number of samples.

    X_i are the states that backward runs reach from the rim (N,) bool, the nodes of M_i near M*.
    """
    grid, gap = part.grid, GAP_CELLS * part.grid.cell
    nodes = grid.nodes[rim]

    def within(samples: int) -> GridSet:
        visited = np.zeros(len(grid.nodes), dtype=bool)
        if len(nodes):
            runs = policy_runs(task, pi, nodes, steps=samples, backward=True, label="backward")
            z = _between_samples(runs.path, grid)
            visited[grid.nearest(z[task.chart.contains(z)])] = True
        # A closing, together with M_i, fills the gaps between the samples.
        wide = GridSet.from_mask(grid, visited | part.mask).dilated(gap)
        return GridSet.from_mask(grid, wide.mask).eroded(gap)

    return within


def _forward_reach(
    task: Task, pi: PartPolicy, part: GridSet, rim: np.ndarray, candidates: np.ndarray
) -> Callable[[int], GridSet]:
    """As `_backward_reach`, but X_i are the candidates (N,) whose forward runs enter M_i on the rim (N,)."""
    grid = part.grid
    outside = np.flatnonzero(candidates & ~part.mask)
    arrival = np.full(len(grid.nodes), np.inf)
    if len(outside):
        longest = round(LONGEST_HORIZON / task.dt)
        rollout = policy_runs(task, pi, grid.nodes[outside], steps=longest, label="forward")
        under_way = np.ones(len(outside), dtype=bool)
        for k, z in enumerate(rollout.path[1:], 1):
            enters = under_way & part.contains(z)
            arrival[outside[enters & rim[grid.nearest(z)]]] = k
            under_way &= ~enters
    return lambda samples: GridSet.from_mask(grid, part.mask | (arrival <= samples))


def _between_samples(path: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns points (N, d) along paths (K + 1, n, d), so close that they miss no cell of the grid."""
    hops = np.diff(path, axis=0)
    count = max(int(np.ceil(np.abs(hops / grid.spacing).max(initial=0.0))), 1)
    shares = np.arange(count)[:, None, None, None] / count
    d = path.shape[-1]
    return np.concatenate([(path[:-1] + shares * hops).reshape(-1, d), path[-1]])


def _narrow(
    task: Task, points: np.ndarray, grid: Grid, winning: tuple[np.ndarray, ...], eps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the points (K, d) of M* where some mode wins, but the room (K,) is less than 2 eps (d,).

    The room is the distance to either side of M* over which all modes win.
    """
    shares = np.arange(0.0, 1.0 + 1e-9, 0.02)
    reach = 2 * eps.max(initial=0.0)
    if not len(points) or not reach or len(winning) < 2:
        return np.empty((0, task.chart.dimension)), np.empty(0)
    room = np.full(len(points), reach)
    directions = np.vstack([np.diag(2 * eps), -np.diag(2 * eps)])
    for direction in directions[directions.any(axis=1)]:
        line = grid.nearest((points[:, None] + shares[:, None] * direction).reshape(-1, len(eps)))
        for wins in winning:
            succeeds = wins[line].reshape(len(points), -1)
            first_loss = np.where(succeeds.all(axis=1), len(shares), succeeds.argmin(axis=1))
            room = np.minimum(room, np.maximum(first_loss - 1, 0) * 0.02 * reach)
    someone = np.any([wins[grid.nearest(points)] for wins in winning], axis=0)
    narrow = someone & (room < reach - grid.cell)
    return points[narrow], room[narrow]
