"""A lattice of states, with the transitions of its nodes by one sample of the compiled plant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.mjcf import model_name
from hyrl_mj.progress import progress_bar
from hyrl_mj.sets import Grid
from hyrl_mj.tasks import Outcome, Task

# Cells along the longest side of the game's lattice, by the dimension of the chart.
LATTICE = {1: 12_000, 2: 480}
# The most cells where the game is played many times, or for an estimate.
CURVE_CELLS = {1: 3_000, 2: 240}
# A sample that ends this close to a node, in cells, ends on it.
ON_NODE = 1e-3
# Transitions of the largest lattice, each of which takes about 100 bytes while they are tabulated.
MOST_TRANSITIONS = 2**24
# Nodes from which a plant is stepped that moves all of them alike, up to this distance [chart units].
SAMPLE, ALIKE = 1_000, 1e-9
REMEDY = "use noisy episodes instead (hyrl-mj robustness RUN --episodes N --noise adversarial)"


@dataclass(frozen=True)
class Lattice:
    """The plant's own transition, tabulated over nodes and input levels.

    Two more places follow the N nodes: number N is "arrived", N + 1 is "failed". A sample that ends between
    nodes leads to all nodes around its end, and the adversary chooses among them: the lattice errs to the
    adversary's side, by less than a cell a sample.

    Attributes:
        task: the robot and its problem.
        grid: the nodes.
        levels: (A, m) inputs: a discrete task's levels; for continuous inputs as many as lead to different
            nodes in one sample.
        after: (A, C, N) places around the end of one sample, the nearest first.
        arrived: (N,) bool, nodes at which an episode that ended there would be a success.
        failed: (N,) bool, nodes at which an episode ends without success.
        hops: (A, d) how far one sample with each level moves the running nodes.
        uneven: (d,) by how much more or less it moves some of them, along each coordinate.
        direct: whether measurement, chart point and position are the same numbers.
    """

    task: Task
    grid: Grid
    levels: np.ndarray
    after: np.ndarray
    arrived: np.ndarray
    failed: np.ndarray
    hops: np.ndarray
    uneven: np.ndarray
    direct: bool

    @property
    def nodes(self) -> int:
        """N, the number of nodes."""
        return len(self.grid.nodes)

    @property
    def places(self) -> int:
        """N + 2: the nodes, "arrived" and "failed"."""
        return self.nodes + 2

    @cached_property
    def running(self) -> np.ndarray:
        """(N,) bool, the nodes at which an episode goes on."""
        return self.task.ending(self.grid.nodes) == Outcome.RUNNING

    @cached_property
    def exact(self) -> bool:
        """Whether every sample leads from node to node."""
        return self.after.shape[1] == 1

    @staticmethod
    def check(task: Task) -> None:
        """Raises `BadInput` unless the game can be played on a lattice of this task's chart."""
        d = task.chart.dimension
        if d not in LATTICE:
            raise BadInput(
                f"the worst-case game takes a chart of 1 or 2 dimensions, that of {task.name} has {d}: "
                f"{REMEDY}"
            )
        if task.measurement_columns != d or task.model.nq != d or not task.kinematic:
            raise BadInput(
                f"the worst-case game takes a plant that one sample maps from chart point to chart point, "
                f"and {model_name(task.model)} has a larger state: {REMEDY}"
            )

    @staticmethod
    def possible(task: Task) -> bool:
        """Returns whether the game can be played on a lattice of this task's chart."""
        try:
            Lattice.check(task)
        except BadInput:
            return False
        return True

    @staticmethod
    def of(task: Task, grid: Grid | None = None) -> Lattice:
        """Returns the lattice of a task, by default of 12,000 cells along a line or 480 x 480 in the plane.

        Raises:
            BadInput: the plant's state is more than the chart, the chart has three dimensions, or the
                lattice is too coarse, or too fine for the memory.
        """
        Lattice.check(task)
        grid = grid or Grid.with_cells(task.chart, LATTICE[task.chart.dimension])
        nodes = grid.nodes
        plant = task.plant(len(nodes))
        plant.set_state(*task.state(nodes))
        measurement = plant.measurement
        ending, failed = task.ending(measurement), task.failed(measurement)
        success = task.verdict(measurement) == Outcome.REACHED
        arrived = (ending == Outcome.REACHED) | ~failed & success
        alive = np.flatnonzero(ending == Outcome.RUNNING)
        if not len(alive):
            raise BadInput(
                f"a lattice of {len(nodes):,} nodes has none at which {task.name} goes on: give "
                "more cells (`lattice` in the settings)"
            )
        levels = _levels(task, grid, nodes[alive])
        if len(levels) * len(nodes) > MOST_TRANSITIONS:
            raise BadInput(
                f"a lattice of {len(nodes):,} nodes and {len(levels):,} inputs does not fit into the memory: "
                "give fewer cells (`lattice` in the settings)"
            )
        direct = bool((measurement == nodes).all())
        ends = np.empty((len(levels), *nodes.shape))
        fails = np.zeros((len(levels), len(nodes)), dtype=bool)
        arrives = np.zeros_like(fails)
        hops, uneven = np.empty((len(levels), nodes.shape[1])), np.zeros(nodes.shape[1])
        for a, measurement in enumerate(_one_sample_on(task, nodes[alive], levels, direct)):
            ends[a] = nodes
            ends[a, alive] = task.z(measurement)
            hop = grid.chart.difference(ends[a, alive], nodes[alive])
            hops[a] = (hop.max(axis=0) + hop.min(axis=0)) / 2
            uneven = np.maximum(uneven, np.ptp(hop, axis=0) / 2)
            fails[a, alive] = task.failed(measurement)
            arrives[a, alive] = task.ending(measurement) == Outcome.REACHED
        after = _around(grid, ends)
        outside = ~task.chart.contains(ends)
        # A running episode that leaves the chart leaves the lattice: it counts as failed.
        after = np.where((fails | outside & ~arrives)[:, None], len(nodes) + 1, after)
        after = np.where(arrives[:, None], len(nodes), after)
        return Lattice(
            task, grid, levels, after.astype(np.int32), arrived, failed, hops, uneven, direct
        )

    def level_of(self, u: np.ndarray) -> np.ndarray:
        """Returns the levels (n,) int nearest to inputs (n, m).

        Raises:
            BadInput: an input that is not finite, out of range, or not one of a discrete task's.
        """
        name, (low, high) = self.task.name, self.task.input_limits
        if u.ndim != 2 or u.shape[1] != len(low):
            raise BadInput(f"a controller of {name} gives (n, {len(low)}) inputs, got {u.shape}")
        wrong = ~((u >= low - 1e-6) & (u <= high + 1e-6)).all(axis=1)
        if wrong.any():
            raise BadInput(
                f"the controller's input {u[wrong][0].tolist()} cannot be applied: the limits of "
                f"{name} are {low.tolist()} to {high.tolist()}"
            )
        counts = np.array([len(np.unique(column)) for column in self.levels.T])
        steps = (counts - 1) / (high - low)
        index = np.clip(np.round((u - low) * steps), 0, counts - 1).astype(int)
        level = np.ravel_multi_index(tuple(index.T), tuple(counts))
        off = np.abs(self.levels[level] - u).max(axis=1) > 1e-6
        if self.task.learning.levels is not None and off.any():
            raise BadInput(
                f"the controller's input {u[off][0].tolist()} is not one of the levels of {name}: "
                f"{np.unique(self.levels).tolist()}"
            )
        return level


def _one_sample_on(
    task: Task, nodes: np.ndarray, levels: np.ndarray, direct: bool
) -> Iterator[np.ndarray]:
    """Yields for each level the measurements (n, p) one sample after the nodes (n, d).

    Without contacts and other constraints nothing depends on where a robot without inertia is. If the
    measurement is the position itself (`direct`), and some of the nodes move alike, all move like these.
    """
    free = bool(task.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT) and direct
    few = nodes[:: max(len(nodes) // SAMPLE, 1)] if free else nodes
    plant = task.plant(len(few))
    for level in progress_bar(levels, "tabulating the plant", "inputs"):
        plant.set_state(*task.state(few))
        plant.step(np.tile(level, (len(few), 1)))
        after = plant.measurement
        if free:
            hop = after - few
            if np.ptp(hop, axis=0).max() > ALIKE:
                yield from _one_sample_on(task, nodes, level[None], False)
                continue
            after = nodes + hop[0]
        yield after


def _levels(task: Task, grid: Grid, nodes: np.ndarray) -> np.ndarray:
    """Returns inputs (A, m); continuous ones so dense that neighbours lead at most a cell apart."""
    if task.input_levels is not None:
        return task.input_levels
    low, high = task.input_limits
    plant, axes = task.plant(2), []
    for i in range(len(low)):
        u = np.tile((low + high) / 2, (2, 1))
        u[:, i] = low[i], high[i]
        plant.set_state(*task.state(nodes[[0, 0]]))
        plant.step(u)
        ends = task.z(plant.measurement)
        cells = np.abs((ends[1] - ends[0]) / grid.spacing).max()
        axes.append(np.linspace(low[i], high[i], int(np.ceil(cells)) + 1))
    return np.array(list(product(*axes)))


def _around(grid: Grid, ends: np.ndarray) -> np.ndarray:
    """Returns the nodes around points (A, N, d), the nearest first: (A, C, N) flat indices."""
    index = (grid.chart.wrap(ends) - grid.chart.low) / grid.spacing
    nearest = np.round(index)
    other = nearest + np.where(np.abs(index - nearest) <= ON_NODE, 0, np.sign(index - nearest))
    between = (other != nearest).any(axis=(0, 1))
    corners = product(*[(0, 1) if b else (0,) for b in between])
    counts = np.array(grid.counts)
    around = []
    for corner in corners:
        at = np.where(corner, other, nearest).astype(int)
        at = np.where(grid.chart.periodic, at % counts, np.clip(at, 0, counts - 1))
        around.append(np.ravel_multi_index(tuple(np.moveaxis(at, -1, 0)), grid.counts))
    return np.stack(around, axis=1)
