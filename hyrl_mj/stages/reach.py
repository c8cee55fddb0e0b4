"""How far a part reaches over M* (paper, Step 5): backward from its rim, or by the runs that enter it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hyrl_mj.learning import OverlapSettings
from hyrl_mj.sets import Cloud, Grid, GridSet
from hyrl_mj.simulation import Rollout, policy_runs
from hyrl_mj.stages.partition import Partition, PartPolicy
from hyrl_mj.tasks import Outcome, Task


def shortest(
    task: Task,
    reach: list[Callable[[int], GridSet]],
    goals: list[np.ndarray],
    settings: OverlapSettings,
) -> int:
    """Returns the least number of samples with which every set fills its goal (N,) bool.

    What some set never reaches does not count, as a corner behind the place where three parts meet.
    """
    most, best = [0] * len(goals), 1
    for k in range(1, round(settings.longest / task.dt) + 1):
        pairs = zip(reach, goals, strict=True)
        filled = [int(np.count_nonzero(within(k).mask[goal])) for within, goal in pairs]
        if all(n >= settings.filled * goal.sum() for n, goal in zip(filled, goals, strict=True)):
            return k
        if any(n > before for n, before in zip(filled, most, strict=True)):
            most, best = np.maximum(filled, most).tolist(), k
        if k * task.dt > settings.patience + best * task.dt:
            break
    return best


def runs_from_outside(
    task: Task,
    pi: PartPolicy,
    partition: Partition,
    part: GridSet,
    rim: np.ndarray | None,
    longest: int,
    rows: np.ndarray,
) -> np.ndarray:
    """Returns what is known of nodes `rows` (k,) by the runs of pi_i from those outside of M_i: (k, 3).

    These are whether they belong to W_i, from where pi_i arrives by its own way, whether the runs enter M_i
    on the rim (N,) bool, and after how many samples, infinite for others and beyond the `longest`. Past
    obstacles, a run from outside M_i may go another way into it (see `Partition.astray`). Scattered nodes
    lie too far apart for a rim: there it counts wherever the runs enter M_i. Without a rim, only W_i is asked
    for.
    """
    arrives = partition.succeeds & part.mask
    entry = np.full(len(rows), np.inf)
    wins = arrives[rows]
    if rim is not None:
        entry[part.mask[rows] & rim[rows]] = 1.0  # of those beside them
    outside = np.flatnonzero(~part.mask[rows])
    if len(outside):
        nodes = part.grid.nodes[rows[outside]]
        rollout = policy_runs(task, pi, nodes, label="extended sets")
        wins[outside] = rollout.outcome == Outcome.REACHED
        if not task.gives_direction:
            wins[outside] &= ~_astray(partition, part, arrives, rows[outside], rollout)
        if rim is not None:
            entry[outside] = _entries(part, rim, rollout, longest)
    return np.column_stack([wins, np.isfinite(entry), entry])


def _astray(
    partition: Partition, part: GridSet, arrives: np.ndarray, starts: np.ndarray, rollout: Rollout
) -> np.ndarray:
    """Returns which runs (k,) bool from nodes `starts` enter M_i by another way than its own.

    They enter M_i where they first come to one of the nodes (N,) bool of it from which pi_i `arrives`.
    """
    entered, astray = np.zeros((2, len(rollout.outcome)), dtype=bool)
    for z in rollout.path[1:]:
        at = part.grid.nearest(z)
        rows = np.flatnonzero(~entered & arrives[at])
        astray[rows] = partition.astray(part, starts[rows], at[rows])
        entered[rows] = True
    return astray


def _entries(part: GridSet, rim: np.ndarray, rollout: Rollout, longest: int) -> np.ndarray:
    """Returns after how many samples runs enter M_i on the rim (N,) bool: (k,), infinite for the others.

    No more samples are looked at than the `longest`.
    """
    entry = np.full(len(rollout.outcome), np.inf)
    under_way = np.ones(len(entry), dtype=bool)
    for k, z in enumerate(rollout.path[1 : longest + 1], 1):
        rows = np.flatnonzero(under_way)
        rows = rows[part.contains(z[rows])]
        on_rim = rows if isinstance(part.grid, Cloud) else rows[rim[part.grid.nearest(z[rows])]]
        entry[on_rim] = k
        under_way[rows] = False
    return entry


def backward_reach(
    task: Task, pi: PartPolicy, part: GridSet, rim: np.ndarray, gap: float
) -> Callable[[int], GridSet]:
    """Returns M_i u X_i as a function of the number of samples.

    X_i are the states that backward runs reach from the rim (N,) bool, the nodes of M_i near M*. A `gap` of
    so many cells between their samples is closed.
    """
    grid, gap = part.regular, gap * part.grid.cell
    nodes = grid.nodes[rim]
    path = nodes[None]

    def within(samples: int) -> GridSet:
        nonlocal path
        visited = np.zeros(len(grid.nodes), dtype=bool)
        if len(nodes):
            if len(path) <= samples:  # more than asked for: longer times are asked for in turn
                steps = max(samples, 2 * len(path))
                path = policy_runs(
                    task, pi, nodes, steps=steps, backward=True, label="backward"
                ).path
            z = _between_samples(path[: samples + 1], grid)
            visited[grid.nearest(z[task.chart.contains(z)])] = True
        # A closing, together with M_i, fills the gaps between the samples.
        wide = GridSet.from_mask(grid, visited | part.mask).dilated(gap)
        return GridSet.from_mask(grid, wide.mask).eroded(gap)

    return within


def forward_reach(part: GridSet, entry: np.ndarray) -> Callable[[int], GridSet]:
    """As `backward_reach`, but X_i are the nodes whose forward runs enter M_i on its rim.

    `entry` (N,) is after how many samples they do, not above zero where that is not known.
    """
    entry = np.where(entry > 0, entry, np.inf)
    return lambda samples: GridSet.from_mask(part.grid, part.mask | (entry <= samples))


def _between_samples(path: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns points (N, d) along paths (K + 1, n, d), so close that they miss no cell of the grid."""
    hops = np.diff(path, axis=0)
    count = max(int(np.ceil(np.abs(hops / grid.spacing).max(initial=0.0))), 1)
    shares = np.arange(count)[:, None, None, None] / count
    d = path.shape[-1]
    return np.concatenate([(path[:-1] + shares * hops).reshape(-1, d), path[-1]])
