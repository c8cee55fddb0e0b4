"""A lattice of states, with the transitions of its nodes by one sample of the compiled plant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game.resolution import (
    LATTICE,
    MOST_TRANSITIONS,
    level_counts,
    probed_hops,
    resolves,
    transitions,
)
from hyrl_mj.sets import Cloud, Grid, Nodes
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Outcome, Task

# A sample that ends this close to a node, in cells, ends on it.
ON_NODE = 1e-3
# Nodes from which a plant is stepped that moves all of them alike, up to this distance [chart units].
SAMPLE, ALIKE = 1_000, 1e-9


@dataclass(frozen=True)
class Places:
    """What the game is played on: N nodes or cells, then the places "arrived" and "failed".

    Attributes:
        arrived: (N,) bool, where an episode ends as a success.
        failed: (N,) bool, where it ends without success.
        running: (N,) bool, where it goes on.
    """

    arrived: np.ndarray
    failed: np.ndarray
    running: np.ndarray

    @property
    def nodes(self) -> int:
        """N, the number of nodes or cells."""
        return len(self.running)

    @property
    def places(self) -> int:
        """N + 2."""
        return self.nodes + 2


@dataclass(frozen=True)
class Lattice(Places):
    """The plant's own transition, tabulated over nodes and input levels.

    A sample that ends between nodes leads to all nodes around its end, and the adversary chooses among them:
    the lattice errs to the adversary's side, by less than a cell a sample. In three dimensions, or along
    walls that stop the robot, that would lose every run. There a sample leads to one of these nodes, drawn so
    that it is right on average, and the game is an estimate. No sample leads to a node inside of such a wall.

    Nodes at which an episode that is cut off is a success (`Task.verdict`) have arrived, too.

    Attributes:
        task: the robot and its problem.
        grid: the nodes.
        levels: (A, m) inputs: a discrete task's levels; for continuous inputs as many as lead to different
            nodes in one sample.
        after: (A, C, N) places around the end of one sample, the nearest first; one of them, C = 1, where
            the game is an estimate.
        hops: (A, d) how far one sample with each level moves the running nodes.
        uneven: (d,) by how much more or less it moves some of them, along each coordinate.
        direct: whether measurement, chart point and position are the same numbers.
    """

    task: Task
    grid: Grid
    levels: np.ndarray
    after: np.ndarray
    hops: np.ndarray
    uneven: np.ndarray
    direct: bool

    @property
    def exact(self) -> bool:
        """Whether every sample under every possible input leads from node to node."""
        on_nodes = not self.estimate and self.after.shape[1] == 1
        return on_nodes and self.task.input_levels is not None

    @property
    def estimate(self) -> bool:
        """Whether what is won on the nodes is an estimate, which may err to either side."""
        return Lattice.why_estimate(self.task) is not None

    @staticmethod
    def why_estimate(task: Task) -> str | None:
        """Returns why what is won on nodes of this task's chart is an estimate, None if it is none."""
        if task.chart.dimension > 2:
            return "the game is an estimate on a chart of three dimensions"
        if task.abilities.stopped_by_walls:
            return "the game is an estimate where contacts stop the robot between the nodes"
        return None

    @staticmethod
    def why_not(task: Task, grid: Grid | None = None) -> str | None:
        """Returns why the game cannot be played on nodes of this task's chart, None if it can be."""
        d = task.chart.dimension
        if d not in LATTICE:
            return f"the worst-case game takes a chart of 1 to 3 dimensions, that of {task.name} has {d}"
        if not task.chart_is_state:
            return (
                "the exact worst case needs a plant whose whole state is the chart, and "
                f"{task.name} has a larger state, or inertia"
            )
        if grid is None:
            return None
        hops = probed_hops(task)
        if transitions(task, grid, hops) > MOST_TRANSITIONS:
            return f"a lattice of {len(grid.nodes):,} nodes with all inputs does not fit into the memory"
        if not resolves(task, grid, hops):
            pairs = zip(grid.spacing, task.chart.units, strict=True)
            sides = " by ".join(f"{side:.3g} {unit}" for side, unit in pairs)
            return (
                f"along some coordinate no sample moves {task.name} by a whole cell of the lattice "
                f"({sides}), and rounding would hold it in its place there"
            )
        return None

    @staticmethod
    def check(task: Task, grid: Grid | None = None) -> None:
        """Raises `BadInput` unless the game can be played on nodes of this task's chart."""
        if why := Lattice.why_not(task, grid):
            raise BadInput(
                f"{why}: use noisy episodes instead (hyrl-mj robustness RUN --episodes N --noise adversarial)"
            )

    @staticmethod
    def decides(task: Task, grid: Nodes) -> bool:
        """Returns whether what is won on these nodes is good enough to train and to design by."""
        if isinstance(grid, Cloud):
            return False
        return Lattice.why_estimate(task) is None and Lattice.why_not(task, grid) is None

    @staticmethod
    def tabulate(task: Task, grid: Grid) -> Lattice:
        """Returns the lattice of a task on the nodes of a grid.

        Raises:
            BadInput: the plant's state is more than the chart, or the chart has more than three dimensions,
                or the lattice is too coarse, or too fine for the memory.
        """
        Lattice.check(task)
        nodes = grid.nodes
        measurement = task.placed(nodes).measurement
        ending, failed = task.ending(measurement), task.failed(measurement)
        arrived = ending == Outcome.REACHED
        running = ending == Outcome.RUNNING
        alive = np.flatnonzero(running)
        if not len(alive):
            raise BadInput(
                f"a lattice of {len(nodes):,} nodes has none at which {task.name} goes on: give "
                "more cells (`lattice` in the settings)"
            )
        levels = _levels(task, grid)
        if len(levels) * len(nodes) > MOST_TRANSITIONS:
            raise BadInput(
                f"a lattice of {len(nodes):,} nodes and {len(levels):,} inputs does not fit into the memory: "
                "give fewer cells (`lattice` in the settings)"
            )
        direct = measurement.shape == nodes.shape and bool((measurement == nodes).all())
        estimate = Lattice.why_estimate(task) is not None
        occurs = nearest_of(grid, running) if task.abilities.stopped_by_walls else None
        rng, d = np.random.default_rng(0) if estimate else None, nodes.shape[1]
        after = np.empty((len(levels), 1 if estimate else 2**d, len(nodes)), dtype=np.int32)
        after[:] = np.arange(len(nodes))
        hops, uneven, between = np.empty((len(levels), d)), np.zeros(d), np.zeros(d, dtype=bool)
        for a, end in enumerate(_one_sample_on(task, nodes[alive], levels, direct)):
            z = task.z(end)
            hop = grid.chart.difference(z, nodes[alive])
            hops[a] = (hop.max(axis=0) + hop.min(axis=0)) / 2
            uneven = np.maximum(uneven, np.ptp(hop, axis=0) / 2)
            arrives = task.ending(end) == Outcome.REACHED
            # A running episode that leaves the chart leaves the lattice: it counts as failed.
            fails = task.failed(end) | ~task.chart.contains(z) & ~arrives
            around, differ = _around(grid, z, rng)
            between |= differ
            around = around if occurs is None else occurs[around]
            over = [len(nodes) + 1, len(nodes)]
            after[a][:, alive] = np.select([fails, arrives], over, around)
        # Corners that repeat others are not needed.
        corners = np.array([*product((0, 1), repeat=d)])[: after.shape[1]]
        needed = ~(corners > between).any(axis=1)
        after = after if needed.all() else after[:, needed]
        arrived |= ~failed & (task.verdict(measurement) == Outcome.REACHED)
        return Lattice(arrived, failed, running, task, grid, levels, after, hops, uneven, direct)

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


def nearest_of(grid: Nodes, mask: np.ndarray) -> np.ndarray:
    """Returns the nearest node of a mask (N,) bool to each node: (N,) int."""
    of_mask = np.flatnonzero(mask)
    return np.asarray(of_mask[grid.chart.nearest(grid.nodes[of_mask], grid.nodes)[1]])


def _one_sample_on(
    task: Task, nodes: np.ndarray, levels: np.ndarray, direct: bool
) -> Iterator[np.ndarray]:
    """Yields for each level the measurements (n, p) one sample after the nodes (n, d).

    Without contacts, other constraints and an inner loop nothing depends on where a robot without inertia
    is. If the measurement is the position itself (`direct`), and some of the nodes move alike, all do.
    """
    unconstrained = bool(task.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    free = direct and unconstrained and not task.has_inner_loop
    few = nodes[:: max(len(nodes) // SAMPLE, 1)] if free else nodes
    plant = task.tabulating(len(few))
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


def _levels(task: Task, grid: Grid) -> np.ndarray:
    """Returns inputs (A, m); continuous ones so dense that neighbours lead at most a cell apart."""
    if task.input_levels is not None:
        return task.input_levels
    low, high = task.input_limits
    counts = level_counts(task, grid, probed_hops(task))
    return np.array(list(product(*map(np.linspace, low, high, counts))))


def _around(
    grid: Grid, z: np.ndarray, rng: np.random.Generator | None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the nodes (C, n) around points (n, d), the nearest first, and along which axes they differ.

    With a generator it is one node, C = 1, drawn so that it is right on average.
    """
    index = (grid.chart.wrap(z) - grid.chart.low) / grid.spacing
    near = np.round(index)
    far = near + np.where(np.abs(index - near) <= ON_NODE, 0, np.sign(index - near))
    between = (far != near).any(axis=0)
    if rng is not None:
        near = np.where(rng.random(index.shape) < np.abs(index - near), far, near)
    counts = np.array(grid.counts)
    strides = np.append(np.cumprod(counts[:0:-1])[::-1], 1)
    ends = [
        np.where(grid.chart.periodic, at % counts, np.clip(at, 0, counts - 1)) * strides
        for at in (near.astype(int), far.astype(int))
    ]
    corners = [*product((0, 1), repeat=len(counts))][: None if rng is None else 1]
    nodes = [sum(ends[i][:, axis] for axis, i in enumerate(corner)) for corner in corners]
    return np.stack(nodes), between
