"""Stage 5: extend each part over the critical set, by running the closed loop backward."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.critical_set import CriticalSet
from hyrl_mj.partition import Partition, PartPolicy, part_policies
from hyrl_mj.policies import Policy
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import PolicyController, closed_loop
from hyrl_mj.tasks.base import Outcome, Task

# The neighbourhood of M* is at least this many cells wide, and as wide as the loop goes in one sample.
NEIGHBOURHOOD_CELLS = 4
# Gaps between the samples of the backward runs that are closed, in cells.
GAP_CELLS = 1.5


@dataclass(frozen=True)
class ExtendedSets:
    """M_ext_i for each mode (paper, Step 5).

    Attributes:
        modes: the modes.
        sets: M_ext_i, in the same order.
        winning: W_i as (N,) bool over the grid's nodes: where pi_i reaches its goal.
        horizon: time T of the backward propagation [s].
        noise: bound eps of the measurement noise that the sets are made for.
    """

    modes: tuple[int, ...]
    sets: tuple[GridSet, ...]
    winning: tuple[np.ndarray, ...]
    horizon: float
    noise: float

    def sentence(self, task: Task) -> str:
        """How far the sets overlap, for people."""
        if len(self.sets) < 2:
            return "one mode, its set is everything"
        both = self.sets[0] & self.sets[1]
        share = both.mask.mean()
        return (
            f"{len(self.sets)} extended sets, the first two share {100 * share:.1f}% of the chart"
        )

    def save(self, path: Path) -> None:
        """Write them as npz."""
        artifacts.write_arrays(
            path,
            {
                "modes": np.array(self.modes),
                "grid_counts": np.array(self.sets[0].grid.counts),
                "signed_distance": np.stack([s.values for s in self.sets]),
                "winning": np.stack(self.winning),
                "horizon": np.array(self.horizon),
                "noise": np.array(self.noise),
            },
            kind="extended sets",
        )

    @staticmethod
    def load(path: Path, task: Task) -> ExtendedSets:
        """Read what `save` wrote.

        Raises:
            BadArtifact: the file is missing, truncated, or not the extended sets of this task.
        """
        arrays = artifacts.read_arrays(path, kind="extended sets")
        with artifacts.reading(path):
            grid = Grid.from_counts(task.chart, arrays["grid_counts"])
            return ExtendedSets(
                modes=tuple(int(q) for q in arrays["modes"]),
                sets=tuple(GridSet(grid, values) for values in arrays["signed_distance"]),
                winning=tuple(arrays["winning"]),
                horizon=float(arrays["horizon"]),
                noise=float(arrays["noise"]),
            )


def extend(
    task: Task,
    policy: Policy,
    critical: CriticalSet,
    partition: Partition,
    horizon: float,
    noise: float,
) -> ExtendedSets:
    """Extend the parts over M*.

    X_i are the states that x' = -f(x, pi_i(x)) reaches outside M_i within the horizon, from the
    neighbourhood of M*. They are trimmed to where mode i still succeeds, with room for the noise, and
    every part is widened by the noise bound, so that a wrong measurement does not flip the mode back:

        M_ext_i = ((M_i u X_i) n (W_i eroded by eps)) u (M_i dilated by eps)

    Args:
        task: gives plant and chart.
        policy: the stage-1 policy.
        critical: M*, from stage 2.
        partition: M_i, from stage 3.
        horizon: time T of the backward propagation [s].
        noise: bound eps of the measurement noise.
    """
    grid = partition.grid
    near = max(noise, NEIGHBOURHOOD_CELLS * grid.cell, one_sample(task, policy, grid))
    sets, winning = [], []
    for part, pi in zip(partition.parts, part_policies(task, policy, partition, near), strict=True):
        reached = part | backward_reach(task, pi, critical, part, near, horizon)
        wins = part_wins(task, pi, partition, part, reached.dilated(2 * noise + 2 * grid.cell))
        winning.append(wins)
        # Nodes that were not asked, far from the critical set, do not take room away.
        roomy = GridSet.from_mask(grid, wins | ~part.mask & ~reached.dilated(noise).mask)
        sets.append((reached & roomy.eroded(noise)) | part.dilated(noise))
    return ExtendedSets(partition.modes, tuple(sets), tuple(winning), horizon, noise)


def backward_reach(
    task: Task, pi: PartPolicy, critical: CriticalSet, part: GridSet, near: float, horizon: float
) -> GridSet:
    """X_i: what the backward closed loop reaches outside M_i from the neighbourhood of M*."""
    grid = part.grid
    steps = max(round(horizon / task.dt), 1)
    nodes = grid.nodes[part.mask & (distance_to(task, critical, grid.nodes) <= near)]
    visited = np.zeros(len(grid.nodes), dtype=bool)
    if len(nodes):
        loop = PolicyController(pi)
        path = closed_loop(task, loop, nodes, steps=steps, backward=True, label="backward").path
        z = between_samples(path, grid)
        visited[grid.nearest(z[task.chart.contains(z)])] = True
    # Close the gaps between samples, together with the part that they leave.
    gap = GAP_CELLS * grid.cell
    wide = GridSet.from_mask(grid, visited | part.mask).dilated(gap)
    return GridSet.from_mask(grid, wide.mask).eroded(gap)


def between_samples(path: np.ndarray, grid: Grid) -> np.ndarray:
    """Points (N, d) along sampled paths (K + 1, n, d), so close that they miss no cell of the grid."""
    hops = np.diff(path, axis=0)
    count = max(int(np.ceil(np.abs(hops / grid.spacing).max(initial=0.0))), 1)
    shares = np.arange(count)[:, None, None, None] / count
    d = path.shape[-1]
    return np.concatenate([(path[:-1] + shares * hops).reshape(-1, d), path[-1]])


def one_sample(task: Task, policy: Policy, grid: Grid) -> float:
    """The longest way that the closed loop goes in one sample, in chart units."""
    path = closed_loop(task, PolicyController(policy), grid.nodes, steps=1).path
    return float(np.linalg.norm(path[-1] - path[0], axis=1).max())


def part_wins(
    task: Task, pi: PartPolicy, partition: Partition, part: GridSet, asked: GridSet
) -> np.ndarray:
    """W_i: the nodes (N,) bool of `asked` from which pi_i reaches the goal."""
    wins = partition.succeeds & part.mask
    outside = np.flatnonzero(asked.mask & ~part.mask)
    if len(outside):
        loop = PolicyController(pi)
        rollout = closed_loop(task, loop, part.grid.nodes[outside], label="extended sets")
        wins[outside] = rollout.outcome == Outcome.REACHED
    return wins


def distance_to(task: Task, critical: CriticalSet, z: np.ndarray) -> np.ndarray:
    """Distance (n,) of chart points (n, d) to M*, in chart units; infinite if M* is empty."""
    if not len(critical.points):
        return np.full(len(z), np.inf)
    return task.chart.tree(critical.points).query(task.chart.in_box(z))[0]
