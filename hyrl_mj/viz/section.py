"""The plane of a chart's first two coordinates: what can be drawn of a chart that has more of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.chart import Chart
from hyrl_mj.plant import Plant
from hyrl_mj.policies import Policy
from hyrl_mj.run_directory import Run
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition, critical_points
from hyrl_mj.tasks import Task

# Grid points along the longest side from which critical points of a section are searched for.
CELLS = 40


class SectionTask(Task):
    """A task on the plane of its chart's first two coordinates; all else is that of the whole task.

    Args:
        whole: the task.
        rest: (d - 2,) values of the other coordinates.
    """

    def __init__(self, whole: Task, rest: np.ndarray):
        self.whole, self.rest = whole, rest
        chart, scene = whole.chart, whole.scene
        where = zip(chart.names[2:], rest, chart.units[2:], strict=True)
        self.chart = Chart(
            chart.names[:2],
            chart.units[:2],
            chart.low[:2],
            chart.high[:2],
            chart.periodic[:2],
            section=", ".join(f"{name} = {value:g} {unit}" for name, value, unit in where),
        )
        self.start_low, self.start_high = whole.start_low[:2], whole.start_high[:2]
        self.scene = replace(
            scene,
            starts=tuple(z[:2] for z in scene.starts),
            policy_starts=tuple(z[:2] for z in scene.policy_starts),
        )
        self.source, self.learning, self.mirror = whole.source, whole.learning, whole.mirror
        self.input_units, self.precision, self.close = (
            whole.input_units,
            whole.precision,
            whole.close,
        )

    def __getattr__(self, name: str) -> Any:
        """Returns what this class does not define: the whole task's."""
        return getattr(self.whole, name)

    @property
    def model(self) -> mujoco.MjModel:
        return self.whole.model

    @property
    def input_limits(self) -> tuple[np.ndarray, np.ndarray]:
        return self.whole.input_limits

    @property
    def set_point(self) -> np.ndarray | None:
        return None if self.whole.set_point is None else self.whole.set_point[:2]

    def plant(self, n: int, threads: int = 0) -> Plant:
        return self.whole.plant(n, threads)

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        return self.whole.state(_lifted(z, self.rest), rng)

    def z(self, measured: np.ndarray) -> np.ndarray:
        return self.whole.z(measured)[:, :2]

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        return self.whole.with_z(measured, np.hstack([z, self.whole.z(measured)[:, 2:]]))

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return self.whole.observation(measured)

    def measured(self, observation: np.ndarray) -> np.ndarray:
        return self.whole.measured(observation)

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self.whole.reward(measurement, u)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        return self.whole.ending(measurement)

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        return self.whole.verdict(measurement)

    def arrived(self, z: np.ndarray) -> np.ndarray:
        return self.whole.arrived(_lifted(z, self.rest))

    def miss(self, z: np.ndarray) -> np.ndarray:
        return self.whole.miss(_lifted(z, self.rest))

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        return self.whole.danger(measurement)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        return self.whole.starts(n, rng)[:, :2]

    def direction(self, path: np.ndarray) -> np.ndarray:
        return self.whole.direction(_lifted(path, self.rest))


@dataclass(frozen=True)
class Section:
    """Results on a chart of more than two dimensions, cut where the other coordinates have fixed values.

    These are those of the first replay start. A chart of one or two dimensions is left as it is.

    Attributes:
        whole: the task.
        task: the same task with a chart of two dimensions; to `direction` and `miss` the others are fixed.
        rest: (d - 2,) values of the others.
    """

    whole: Task
    task: Task
    rest: np.ndarray

    @staticmethod
    def of(task: Task) -> Section:
        """The section of a task."""
        chart = task.chart
        if chart.dimension <= 2:
            return Section(task, task, np.empty(0))
        rest = np.array(task.scene.starts[0][2:], dtype=float)
        return Section(task, SectionTask(task, rest), rest)

    @property
    def cut(self) -> bool:
        """Whether there is more than the section."""
        return self.task is not self.whole

    def critical_set(
        self, found: CriticalSet, policy: Policy, cells: int, resolution: float
    ) -> CriticalSet:
        """M* in the section, searched for there by outcome; `found` if there is nothing to cut.

        Args:
            found: M* on the whole chart.
            policy: of stage 1.
            cells: of the search along the longest side.
            resolution: length of the last rods, as a share of the first.
        """
        if not (self.cut and len(found.points)):
            return found
        grid = Grid.with_cells(self.task.chart, cells)
        nodes = self.lift(grid.nodes)
        points = critical_points(
            self.whole, policy, nodes, grid.neighbours(), grid.cell, resolution
        )[:, :2]
        one_piece = np.zeros(len(points), dtype=int)
        return CriticalSet(points, one_piece, resolution * grid.cell, grid.cell)

    def partition(self, found: Partition) -> Partition:
        """The parts in the section."""
        if not self.cut:
            return found
        parts = tuple(self._set(part) for part in found.parts)
        at = found.grid.nearest(self.lift(parts[0].grid.nodes))
        return Partition(found.modes, parts, found.succeeds[at])

    def extended_sets(self, found: ExtendedSets) -> ExtendedSets:
        """The extended sets in the section."""
        if not self.cut:
            return found
        sets = tuple(self._set(members) for members in found.sets)
        at = found.sets[0].grid.nearest(self.lift(sets[0].grid.nodes))
        winning = tuple(wins[at] for wins in found.winning)
        return replace(found, sets=sets, winning=winning, narrow=np.empty((0, 2)), room=np.empty(0))

    def arc(self, found: HybridArc) -> HybridArc:
        """An arc, seen in the section."""
        return replace(found, z=found.z[:, :2]) if self.cut else found

    def lift(self, z: np.ndarray) -> np.ndarray:
        """Chart points (n, d) of points of the section (n, 2)."""
        return _lifted(z, self.rest)

    def _set(self, members: GridSet) -> GridSet:
        grid = Grid(self.task.chart, members.grid.counts[:2])
        return GridSet(grid, members.signed_distance(self.lift(grid.nodes)))


def critical_section(run: Run) -> CriticalSet:
    """M* of a run in the section of its chart."""
    s = run.settings
    cells = max(s.rods, CELLS)
    return Section.of(run.task).critical_set(run.critical_set, run.steady, cells, s.resolution)


def _lifted(z: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Points (..., 2) with the other coordinates (k,): (..., 2 + k)."""
    return np.concatenate([z, np.broadcast_to(rest, (*z.shape[:-1], len(rest)))], axis=-1)
