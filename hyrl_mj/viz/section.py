"""Sections: results on charts of more than two dimensions, cut to the plane of two coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.chart import Chart
from hyrl_mj.game import Maps
from hyrl_mj.run_directory import Run
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition, critical_points
from hyrl_mj.tasks import Task

# Sections over the period of a coordinate.
SECTIONS = 24
# Least number of cells along the longest side in the search for the critical points of a section.
CELLS = 40
# Nodes along each side of a section through sets on scattered nodes.
CELLS_OF_CLOUD = 96


def _of_whole(name: str) -> Any:
    """Returns a property of `Section` with the attribute or method of the whole task."""
    return property(attrgetter(f"whole.{name}"))


class Section(Task):
    """A task on the plane of its chart's first two coordinates, in which results are drawn.

    All else is that of the whole task. A chart of one or two dimensions stays whole.

    Args:
        whole: the task.
        rest: (d - 2,) values of the other coordinates, by default those of the scene's first start.

    Attributes:
        whole: the task.
        cut: whether its chart has more coordinates than the section.
        rest: (d - 2,) values of the other coordinates.
    """

    source, description, mirror = _of_whole("source"), _of_whole("description"), _of_whole("mirror")
    precision, close, learning = _of_whole("precision"), _of_whole("close"), _of_whole("learning")
    model, plant, measure = _of_whole("model"), _of_whole("plant"), _of_whole("measure")
    control, has_inner_loop = _of_whole("control"), _of_whole("has_inner_loop")
    mocap, steady_control = _of_whole("mocap"), _of_whole("steady_control")
    input_units, input_limits = _of_whole("input_units"), _of_whole("input_limits")
    observation, measured = _of_whole("observation"), _of_whole("measured")
    reward, danger = _of_whole("reward"), _of_whole("danger")
    where, plane, obstacles = _of_whole("where"), _of_whole("plane"), _of_whole("obstacles")
    gives_direction, mode_name = _of_whole("gives_direction"), _of_whole("mode_name")
    colour_of, tinted = _of_whole("colour_of"), _of_whole("tinted")
    slow, spec, chart_is_state = _of_whole("slow"), _of_whole("spec"), _of_whole("chart_is_state")
    observation_parts, arrival_ends = _of_whole("observation_parts"), _of_whole("arrival_ends")
    observation_dtype = _of_whole("observation_dtype")
    stopped_by_walls = _of_whole("stopped_by_walls")
    ending, verdict = _of_whole("ending"), _of_whole("verdict")

    def __init__(self, whole: Task, rest: ArrayLike | None = None):
        chart, scene = whole.chart, whole.scene
        self.whole, self.cut = whole, chart.dimension > 2
        self.rest = np.array(scene.starts[0][2:] if rest is None else rest, dtype=float)
        where = zip(chart.names[2:], self.rest, chart.units[2:], strict=True)
        place = ", ".join(f"{name} = {value:g} {unit}" for name, value, unit in where)
        low, high, periodic = chart.low[:2], chart.high[:2], chart.periodic[:2]
        names, units, scale = chart.names[:2], chart.units[:2], chart.scale[:2]
        self.chart = Chart(names, units, low, high, periodic, place, scale)
        self.start_low, self.start_high = whole.start_low[:2], whole.start_high[:2]
        starts, policy_starts = (
            tuple(z[:2] for z in points) for points in (scene.starts, scene.policy_starts)
        )
        self.scene = replace(scene, starts=starts, policy_starts=policy_starts)

    def __getattr__(self, name: str) -> Any:
        """Returns what neither this class nor `Task` defines: the robot's own."""
        return getattr(object.__getattribute__(self, "whole"), name)

    @property
    def set_point(self) -> np.ndarray | None:
        return None if self.whole.set_point is None else self.whole.set_point[:2]

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        return self.whole.state(self.lift(z), rng)

    def z(self, measured: np.ndarray) -> np.ndarray:
        return self.whole.z(measured)[:, :2]

    def at(self, z: np.ndarray) -> np.ndarray:
        return self.whole.at(self.lift(z))

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        return self.whole.with_z(measured, np.hstack([z, self.whole.z(measured)[:, 2:]]))

    def arrived(self, z: np.ndarray) -> np.ndarray:
        return self.whole.arrived(self.lift(z))

    def miss(self, z: np.ndarray) -> np.ndarray:
        return self.whole.miss(self.lift(z))

    def noise_on(self, everywhere: bool = False) -> tuple[str, str]:
        return self.whole.noise_on(everywhere)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        return self.whole.starts(n, rng)[:, :2]

    def direction(self, path: np.ndarray) -> np.ndarray:
        return self.whole.direction(self.lift(path))

    def lift(self, z: np.ndarray) -> np.ndarray:
        """Returns the points (..., d) of the whole chart at points (..., 2) of the section."""
        rest = np.broadcast_to(self.rest, (*z.shape[:-1], len(self.rest)))
        return np.concatenate([z, rest], axis=-1)

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
        at = maps.grid(self.whole.chart).nearest(self.lift(nodes))
        classes = {name: values[at] for name, values in maps.map.items()}
        return Maps(maps.eps, maps.grid_counts[:2], classes)

    def arc(self, arc: HybridArc) -> HybridArc:
        """Returns an arc with the section's coordinates."""
        return replace(arc, z=arc.z[:, :2]) if self.cut else arc

    def _set(self, members: GridSet) -> GridSet:
        whole = members.grid
        counts = whole.counts[:2] if isinstance(whole, Grid) else (CELLS_OF_CLOUD,) * 2
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
    if not (cuts[0].cut and len(run.critical_set.points)):
        return [run.critical_set] * len(cuts)
    resolution, noise = run.settings.resolution, run.settings.noise
    grid = Grid.with_cells(cuts[0].chart, max(run.settings.rods, CELLS))
    nodes = np.vstack([cut.lift(grid.nodes) for cut in cuts])
    firsts = len(grid.nodes) * np.arange(len(cuts))[:, None]
    first, second = ((firsts + ends).ravel() for ends in grid.neighbours())
    rods = first, second
    whole = cuts[0].whole
    points = critical_points(whole, run.steady, nodes, rods, grid.cell, resolution, noise)
    found = []
    for cut in cuts:
        # A point between two nodes of a section lies in it.
        inside = points[(np.abs(points[:, 2:] - cut.rest) < 1e-9).all(axis=1), :2]
        one_piece = np.zeros(len(inside), dtype=int)
        found.append(CriticalSet(inside, one_piece, resolution * grid.cell, grid.cell))
    return found
