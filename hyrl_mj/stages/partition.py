"""Stages 3 and 4: split the chart by the way the closed loop goes, and one policy for each part."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hyrl_mj.artifacts import Saved
from hyrl_mj.errors import BadInput
from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, closed_loop, ways
from hyrl_mj.stages.critical_set import check_points
from hyrl_mj.tasks import Outcome, Task


@dataclass(frozen=True)
class Partition(Saved):
    """The parts M_i (paper, Step 3).

    States where there is nothing left to decide (beyond the obstacle, at the set-point) belong to
    every part.

    Attributes:
        modes: the modes.
        parts: M_i for each mode, in the same order.
        succeeds: (N,) bool, the grid's nodes from which the stage-1 policy reaches its goal.
    """

    KIND: ClassVar[str] = "partition"

    modes: tuple[int, ...]
    parts: tuple[GridSet, ...]
    succeeds: np.ndarray

    def __post_init__(self) -> None:
        check_sets(self.modes, self.parts, (self.succeeds,))

    def __repr__(self) -> str:
        shares = [f"{q}: {p.mask.mean():.1%}" for q, p in zip(self.modes, self.parts, strict=True)]
        return f"Partition({', '.join(shares)} of {' x '.join(map(str, self.grid.counts))} nodes)"

    def __iter__(self) -> Iterator[GridSet]:
        """Iterates over the parts M_i."""
        return iter(self.parts)

    @property
    def grid(self) -> Grid:
        """The grid that the parts live on."""
        return self.parts[0].grid

    def sentence(self, task: Task) -> str:
        """Returns a one-line description."""
        shares = ", ".join(
            f"{task.scene.mode_name(q)} {100 * part.mask.mean():.0f}%"
            for q, part in zip(self.modes, self.parts, strict=True)
        )
        return f"share of the chart by mode: {shares}"


def check_sets(
    modes: tuple[int, ...], sets: tuple[GridSet, ...], masks: tuple[np.ndarray, ...]
) -> None:
    """Checks that there is one set for each mode, and that masks (N,) have an entry for each node.

    Raises:
        BadInput: they do not fit each other.
    """
    if not sets or len(sets) != len(modes):
        raise BadInput(f"{len(sets)} sets do not fit {len(modes)} modes: give one for each mode")
    shapes = {members.values.shape for members in sets} | {mask.shape for mask in masks}
    if len(shapes) > 1:
        raise BadInput(f"sets and masks of shapes {shapes} do not lie on one grid")


def make_partition(task: Task, policy: Policy, points: np.ndarray, cells: int) -> Partition:
    """Splits the nodes of a grid by the way that the closed loop goes from each (paper, Step 3).

    Without a critical set there is nothing to split: one part, mode 0, holds everything.

    Args:
        task: gives chart, plant, and the direction of a run.
        policy: the stage-1 policy.
        points: (N, d) of M*, from stage 2.
        cells: cells of the grid along the longest side of the chart.
    """
    points = check_points(task, points)
    grid = Grid.with_cells(task.chart, cells)
    loop, settings = PolicyController(policy), LoopSettings(label="partition")
    rollout = closed_loop(task, loop, grid.nodes, settings=settings)
    succeeds = rollout.outcome == Outcome.REACHED
    way = ways(task, rollout)
    if not len(points):
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
        """Returns inputs (n, m) for measurements (n, p)."""
        nearest = self.inside.project(self.task.z(measured))
        return self.policy.act(self.task.with_z(measured, nearest))


def part_policies(
    task: Task, policy: Policy, partition: Partition, neighbourhood: float
) -> tuple[PartPolicy, ...]:
    """Returns pi_i for each mode; `neighbourhood` is the distance from M* that counts as near it."""
    return tuple(PartPolicy(task, policy, part.eroded(neighbourhood)) for part in partition.parts)
