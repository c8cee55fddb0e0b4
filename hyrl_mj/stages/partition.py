"""Stages 3 and 4: split the chart by the way the closed loop goes, and one policy for each part."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, closed_loop, ways
from hyrl_mj.stages.critical_set import CriticalSet
from hyrl_mj.tasks import Outcome, Task


@dataclass(frozen=True)
class Partition:
    """The parts M_i (paper, Step 3).

    States where there is nothing left to decide (beyond the obstacle, at the set-point) belong to
    every part.

    Attributes:
        modes: the modes.
        parts: M_i for each mode, in the same order.
        succeeds: (N,) bool, the grid's nodes from which the stage-1 policy reaches its goal.
    """

    modes: tuple[int, ...]
    parts: tuple[GridSet, ...]
    succeeds: np.ndarray

    def __iter__(self) -> Iterator[GridSet]:
        """Iterates over the parts."""
        return iter(self.parts)

    @property
    def grid(self) -> Grid:
        """The grid that the parts live on."""
        return self.parts[0].grid

    def sentence(self, task: Task) -> str:
        """The result for people."""
        shares = ", ".join(
            f"{task.scene.mode_name(q)} {100 * part.mask.mean():.0f}%"
            for q, part in zip(self.modes, self.parts, strict=True)
        )
        return f"share of the chart by mode: {shares}"

    def save(self, path: Path) -> None:
        """Write it as npz."""
        artifacts.write_arrays(
            path,
            {
                "modes": np.array(self.modes),
                "grid_counts": np.array(self.grid.counts),
                "signed_distance": np.stack([part.values for part in self.parts]),
                "succeeds": self.succeeds,
            },
            kind="partition",
        )

    @staticmethod
    def load(path: Path, task: Task) -> Partition:
        """Read what `save` wrote.

        Raises:
            BadArtifact: the file is missing, truncated, or not a partition of this task.
        """
        arrays = artifacts.read_arrays(path, kind="partition")
        with artifacts.reading(path):
            grid = Grid.from_counts(task.chart, arrays["grid_counts"])
            return Partition(
                modes=tuple(int(q) for q in arrays["modes"]),
                parts=tuple(GridSet(grid, values) for values in arrays["signed_distance"]),
                succeeds=arrays["succeeds"],
            )


def make_partition(task: Task, policy: Policy, critical: CriticalSet, cells: int) -> Partition:
    """Run the closed loop from every node of a grid and split the nodes by the way that it goes.

    Without a critical set there is nothing to split: one part, mode 0, holds everything.

    Args:
        task: gives chart, plant, and the direction of a run.
        policy: the stage-1 policy.
        critical: M*, from stage 2.
        cells: cells of the grid along the longest side of the chart.
    """
    grid = Grid.with_cells(task.chart, cells)
    loop, settings = PolicyController(policy), LoopSettings(label="partition")
    rollout = closed_loop(task, loop, grid.nodes, settings=settings)
    succeeds = rollout.outcome == Outcome.REACHED
    way = ways(task, rollout)
    if not len(critical.points):
        way = np.full_like(way, -1)
    modes = tuple(int(q) for q in np.unique(way[way >= 0])) or (0,)
    parts = tuple(GridSet.from_mask(grid, (way == q) | (way < 0)) for q in modes)
    return Partition(modes, parts, succeeds)


@dataclass(frozen=True)
class PartPolicy:
    """pi_i: the stage-1 policy on M_i, elsewhere what it does at the nearest point (paper, Step 4).

    Near M* a continuous policy goes neither way, so the neighbourhood of the boundary counts as
    elsewhere: there, too, pi_i does what the stage-1 policy does where it has made up its mind.

    Attributes:
        task: gives the chart.
        policy: the stage-1 policy.
        inside: M_i without the neighbourhood of its boundary.
    """

    task: Task
    policy: Policy
    inside: GridSet

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Inputs (n, m) for measurements (n, p)."""
        nearest = self.inside.project(self.task.z(measured))
        return self.policy.act(self.task.with_z(measured, nearest))


def part_policies(
    task: Task, policy: Policy, partition: Partition, neighbourhood: float
) -> tuple[PartPolicy, ...]:
    """pi_i for each mode; `neighbourhood` is the distance from M* that counts as near it."""
    return tuple(PartPolicy(task, policy, part.eroded(neighbourhood)) for part in partition.parts)
