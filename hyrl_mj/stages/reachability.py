"""Stage 5: from where a part's policy wins, and the states from which its closed loop reaches the part."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.stages.partition import Partition, PartPolicy
from hyrl_mj.tasks import Outcome, Task

# Gaps between the samples of the backward runs that are closed, in cells.
GAP_CELLS = 1.5
# The longest horizon that is tried [s].
LONGEST_HORIZON = 2.0


def part_wins(
    task: Task, pi: PartPolicy, partition: Partition, part: GridSet, candidates: GridSet
) -> np.ndarray:
    """Returns W_i: the nodes (N,) bool of `candidates` from which pi_i reaches the goal."""
    wins = partition.succeeds & part.mask
    outside = np.flatnonzero(candidates.mask & ~part.mask)
    if len(outside):
        loop, settings = PolicyController(pi), LoopSettings(label="extended sets")
        rollout = closed_loop(task, loop, part.grid.nodes[outside], settings=settings)
        wins[outside] = rollout.outcome == Outcome.REACHED
    return wins


def backward_reach(
    task: Task, pi: PartPolicy, part: GridSet, rim: np.ndarray
) -> Callable[[int], GridSet]:
    """Returns M_i u X_i as a function of the number of samples.

    Args:
        task: gives the plant.
        pi: pi_i.
        part: M_i.
        rim: (N,) bool, its nodes near M*, from where the closed loop is run backward.
    """
    grid, gap = part.grid, GAP_CELLS * part.grid.cell
    nodes = grid.nodes[rim]

    def within(steps: int) -> GridSet:
        visited = np.zeros(len(grid.nodes), dtype=bool)
        if len(nodes):
            settings = LoopSettings(steps=steps, backward=True, label="backward")
            path = closed_loop(task, PolicyController(pi), nodes, settings=settings).path
            z = between_samples(path, grid)
            visited[grid.nearest(z[task.chart.contains(z)])] = True
        # Close the gaps between samples, together with the part that they leave.
        wide = GridSet.from_mask(grid, visited | part.mask).dilated(gap)
        return GridSet.from_mask(grid, wide.mask).eroded(gap)

    return within


def forward_reach(
    task: Task, pi: PartPolicy, part: GridSet, rim: np.ndarray, candidates: np.ndarray
) -> Callable[[int], GridSet]:
    """Returns M_i u X_i as a function of the number of samples, for plants that cannot be run backward.

    Args:
        task: gives the plant.
        pi: pi_i.
        part: M_i.
        rim: (N,) bool, its nodes near M*; X_i are those that the closed loop brings there.
        candidates: (N,) bool, the nodes that may come to lie in the extended set.
    """
    grid = part.grid
    outside = np.flatnonzero(candidates & ~part.mask)
    arrival = np.full(len(grid.nodes), np.inf)
    if len(outside):
        loop, settings = (
            PolicyController(pi),
            LoopSettings(steps=longest_samples(task), label="forward"),
        )
        rollout = closed_loop(task, loop, grid.nodes[outside], settings=settings)
        under_way = np.ones(len(outside), dtype=bool)
        for k, z in enumerate(rollout.path[1:], 1):
            enters = under_way & part.contains(z)
            arrival[outside[enters & rim[grid.nearest(z)]]] = k
            under_way &= ~enters
    return lambda steps: GridSet.from_mask(grid, part.mask | (arrival <= steps))


def between_samples(path: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns points (N, d) along paths (K + 1, n, d), so close that they miss no cell of the grid."""
    hops = np.diff(path, axis=0)
    count = max(int(np.ceil(np.abs(hops / grid.spacing).max(initial=0.0))), 1)
    shares = np.arange(count)[:, None, None, None] / count
    d = path.shape[-1]
    return np.concatenate([(path[:-1] + shares * hops).reshape(-1, d), path[-1]])


def longest_hop(task: Task, policy: Policy, grid: Grid) -> np.ndarray:
    """Returns the longest way (d,) that the closed loop goes in one sample along each coordinate."""
    loop, settings = PolicyController(policy), LoopSettings(steps=1)
    path = closed_loop(task, loop, grid.nodes, settings=settings).path
    return np.asarray(np.abs(path[-1] - path[0]).max(axis=0))


def longest_samples(task: Task) -> int:
    """Returns the number of samples of the longest horizon."""
    return round(LONGEST_HORIZON / task.dt)
