"""Sections: results on charts of more than two dimensions, cut to the plane of two coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from hyrl_mj.judging.game import Maps
from hyrl_mj.runs.directory import Run
from hyrl_mj.sets import Chart, Grid, GridSet
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition, critical_points
from hyrl_mj.tasks import Task

SECTIONS = 24  # over the period of a coordinate
# Least number of cells along the longest side in the search for the critical points of a section.
CELLS = 40
# Cells along the longest side of the map of where runs end without success.
OVER = 480


class Section:
    """The plane of a chart's first two coordinates, in which results of the whole task are drawn.

    A chart of one or two dimensions stays whole.

    Args:
        task: the whole task.
        rest: (d - 2,) values of the other coordinates, by default those of the scene's first start.

    Attributes:
        task: the whole task.
        chart: of the plane.
        cut: whether the whole chart has more coordinates.
        rest: (d - 2,) values of the other coordinates.
        set_point: the task's, as far as it lies in the plane.
        start_low, start_high: corners of the task's box of starts in the plane.
    """

    def __init__(self, task: Task, rest: ArrayLike | None = None):
        whole = task.chart
        self.task, self.cut = task, whole.dimension > 2
        self.rest = np.array(task.scene.starts[0][2:] if rest is None else rest, dtype=float)
        where = zip(whole.names[2:], self.rest, whole.units[2:], strict=True)
        place = ", ".join(f"{name} = {value:g} {unit}" for name, value, unit in where)
        low, high, periodic = whole.low[:2], whole.high[:2], whole.periodic[:2]
        names, units, scale = whole.names[:2], whole.units[:2], whole.scale[:2]
        self.chart = Chart(names, units, low, high, periodic, place, scale)
        self.set_point = None if task.set_point is None else task.set_point[:2]
        self.start_low, self.start_high = task.start_low[:2], task.start_high[:2]

    @property
    def where(self) -> str:
        """Where the section lies: " at heading = 0 rad", "" of a whole chart."""
        return f" at {self.chart.section}" if self.cut else ""

    def noise(self, bound: float) -> np.ndarray:
        """Returns the largest error of a measured point of the plane, by coordinate."""
        return self.task.noise_in_chart(bound)[:2]

    def lift(self, z: np.ndarray) -> np.ndarray:
        """Returns the points (..., d) of the whole chart at points (..., 2) of the plane."""
        rest = np.broadcast_to(self.rest, (*z.shape[:-1], len(self.rest)))
        return np.concatenate([z, rest], axis=-1)

    def failed(self, z: np.ndarray) -> np.ndarray:
        """Returns (n,) bool: whether a run ends without success at points (n, 2) of the plane."""
        return self.task.failed(self.task.placed(self.lift(z)).measurement)

    @cached_property
    def over(self) -> GridSet | None:
        """The points at which a run ends without success, with a smooth outline; None if there are none."""
        grid = Grid.with_cells(self.chart, OVER)
        over = self.failed(grid.nodes).reshape(grid.counts)
        # Blurred, the mask has a smooth outline where it is one half, without the steps of its cells.
        blurred = gaussian_filter(over.astype(float), 4, mode="nearest")
        return GridSet(grid, 0.5 - blurred.ravel()) if over.any() else None

    # ---- results in the section

    def critical_set(self, run: Run) -> CriticalSet:
        """Returns M* of a run, searched for by outcome in the section."""
        return critical_sets(run, [self])[0]

    def partition(self, partition: Partition) -> Partition:
        """Returns the parts."""
        if not self.cut:
            return partition
        parts = tuple(self._set(part) for part in partition.parts)
        at = partition.grid.nearest(self.lift(parts[0].grid.nodes))
        return Partition(partition.modes, parts, partition.succeeds[at])

    def extended_sets(self, extended: ExtendedSets) -> ExtendedSets:
        """Returns the extended sets."""
        if not self.cut:
            return extended
        sets = tuple(self._set(members) for members in extended.sets)
        at = extended.sets[0].grid.nearest(self.lift(sets[0].grid.nodes))
        winning = tuple(wins[at] for wins in extended.winning)
        points, room, between = np.empty((0, 2)), np.empty(0), np.empty((0, 2), dtype=int)
        return replace(
            extended, sets=sets, winning=winning, points=points, room=room, between=between
        )

    def maps(self, maps: Maps) -> Maps:
        """Returns the classes of the nodes nearest to the section."""
        if not self.cut:
            return maps
        nodes = Grid.from_counts(self.chart, maps.grid_counts[:2]).nodes
        at = maps.grid(self.task.chart).nearest(self.lift(nodes))
        classes = {name: values[at] for name, values in maps.map.items()}
        return Maps(maps.eps, maps.grid_counts[:2], classes)

    def _set(self, members: GridSet) -> GridSet:
        whole = members.grid
        counts = whole.counts[:2] if isinstance(whole, Grid) else (96, 96)  # nodes are scattered
        grid = Grid(self.chart, counts)
        return GridSet(grid, members.signed_distance(self.lift(grid.nodes)))


def sections(task: Task) -> tuple[int | None, list[Section]]:
    """Returns the number of the chart's first periodic coordinate after two, and sections over its period.

    Without such a coordinate there is one section, that of the scene's first start.
    """
    turning = [i for i in range(2, task.chart.dimension) if task.chart.periodic[i]]
    if not turning:
        return None, [Section(task)]
    axis, rest = turning[0], np.tile(task.scene.starts[0][2:], (SECTIONS, 1))
    rest[:, axis - 2] = (
        task.chart.low[axis] + np.arange(SECTIONS) / SECTIONS * task.chart.sides[axis]
    )
    return axis, [Section(task, values) for values in rest]


def critical_sets(run: Run, cuts: Sequence[Section]) -> list[CriticalSet]:
    """Returns M* of a run in sections of one chart, searched for by outcome in all of them at once."""
    whole = run.critical_set
    if not (cuts[0].cut and len(whole.points)):
        return [replace(whole, points=whole.points[:, :2])] * len(cuts)
    resolution, eps = run.settings.resolution, run.settings.eps
    grid = Grid.with_cells(cuts[0].chart, max(run.settings.rods, CELLS))
    nodes = np.vstack([cut.lift(grid.nodes) for cut in cuts])
    firsts = len(grid.nodes) * np.arange(len(cuts))[:, None]
    first, second = ((firsts + ends).ravel() for ends in grid.neighbours())
    rods, ways = (first, second), run.settings.ways
    points = critical_points(
        cuts[0].task, run.steady, nodes, rods, grid.cell, resolution, eps, ways
    )
    found = []
    for cut in cuts:
        # A point between two nodes of a section lies in it.
        inside = points[(np.abs(points[:, 2:] - cut.rest) < 1e-9).all(axis=1), :2]
        one_piece = np.zeros(len(inside), dtype=int)
        found.append(CriticalSet(inside, one_piece, resolution * grid.cell, grid.cell))
    return found
