"""A table of inputs as the policy of a mode (stage 6), where samples are too slow to train it by many.

The reward of an environment of others may also say nothing before the goal. The robot is simulated from rest
at each node of the chart, under inputs that are held for some samples. Dynamic programming over the ends of
these runs tells how far each node is from arrival on the mode's way. A measurement is then answered by the
input that does well from all nodes that noise could hide behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from hyrl_mj.artifacts import Saved
from hyrl_mj.errors import BadInput
from hyrl_mj.progress import progress_bar
from hyrl_mj.sets import Grid, Nodes
from hyrl_mj.tasks import Outcome, Task

if TYPE_CHECKING:
    from hyrl_mj.stages.grounds import ModeGround

# Values of each of m inputs that are tried.
VALUES = {1: 9, 2: 5, 3: 3, 4: 3}
# Inputs are held until the robot has usually gone so many cells, and so many times the noise bound, but for
# no more than so many samples. That is found out from so many nodes.
CELLS, BOUNDS, LONGEST, TRIED = 2.0, 1.5, 64, 64
# To leave the mode's set, or to fail, counts as this share of the samples of an episode where it is averaged.
LEAVING = 0.5
# How much the worst of the nodes that noise may hide counts beside their average.
WORST = 0.3
# Values that change by less have converged [samples].
SETTLED, SWEEPS = 1e-3, 2_000


@dataclass(frozen=True)
class TablePolicy(Saved):
    """Inputs at the nodes of a grid; between the nodes they are interpolated, or those of the nearest node.

    Attributes:
        counts: (d,) number of nodes along each coordinate of the chart.
        inputs: (N, m).
    """

    KIND: ClassVar[str] = "table policy"

    counts: np.ndarray
    inputs: np.ndarray

    def of(self, task: Task) -> BoundTable:
        """Returns the policy on the chart of a task.

        Raises:
            BadInput: the table does not fit the task.
        """
        if (
            len(self.counts) != task.chart.dimension
            or self.inputs.shape != (np.prod(self.counts), len(task.inputs))
            or not np.isfinite(self.inputs).all()
        ):
            raise BadInput(
                f"a table of inputs {self.inputs.shape} does not fit {task.name}: run hyrl-mj retrain RUN "
                "to write it again"
            )
        return BoundTable(task, Grid.from_counts(task.chart, self.counts), self.inputs)


@dataclass(frozen=True)
class BoundTable:
    """A `TablePolicy` on the chart of a task."""

    task: Task
    grid: Grid
    inputs: np.ndarray

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for measurements (n, p)."""
        z = self.task.z(measured)
        if self.task.input_levels is not None:
            return np.asarray(self.inputs[self.grid.nearest(z)])
        return np.column_stack([self.grid.interpolate(column, z) for column in self.inputs.T])

    def save(self, path: Path) -> None:
        """Writes `<stem>_table.npz` beside a path."""
        table = TablePolicy(np.array(self.grid.counts), self.inputs)
        table.save(path.with_name(f"{path.stem}_table.npz"))


@dataclass(frozen=True)
class Held:
    """Where held inputs lead a robot that begins at rest at the nodes of a grid.

    Attributes:
        task: the robot and its problem.
        grid: the nodes.
        rows: (k,) the nodes at which an episode goes on.
        inputs: (A, m) the inputs.
        samples: for how many samples each is held.
        ends: (A, k, d) chart points at the end.
        arrived: (A, k) bool, whether the robot arrives before.
        failed: (A, k) bool, whether it fails before.
    """

    task: Task
    grid: Grid
    rows: np.ndarray
    inputs: np.ndarray
    samples: int
    ends: np.ndarray
    arrived: np.ndarray
    failed: np.ndarray

    @staticmethod
    def of(task: Task, grid: Nodes, noise: float) -> Held | None:
        """Returns these runs, None where no table is `possible`, or the robot takes too long to get away."""
        if not possible(task, grid):
            return None
        assert isinstance(grid, Grid)
        m, inputs = len(task.inputs), task.input_levels
        if inputs is None:
            axes = [np.linspace(a, b, VALUES[m]) for a, b in zip(*task.input_limits, strict=True)]
            inputs = np.array(list(product(*axes)))
        plant = task.plant(len(grid.nodes))
        plant.set_state(*task.state(grid.nodes))
        rows = np.flatnonzero(task.ending(plant.measurement) == Outcome.RUNNING)
        away = (
            np.maximum(CELLS * grid.spacing, BOUNDS * task.noise_in_chart(noise)) / task.chart.scale
        )
        samples = _samples(task, grid.nodes[rows], inputs, float(away.min()))
        if not samples:
            return None
        z = grid.nodes[rows]
        ends, outcome = (
            np.empty((len(inputs), *z.shape)),
            np.empty((len(inputs), len(z)), dtype=int),
        )
        plant = task.plant(len(z))
        for a, u in enumerate(progress_bar(inputs, "held inputs", "inputs")):
            plant.set_state(*task.state(z))
            for _ in range(samples):
                on = np.flatnonzero(task.ending(plant.measurement) == Outcome.RUNNING)
                plant.step(np.tile(u, (len(on), 1)), on)
            ends[a], outcome[a] = task.z(plant.measurement), task.ending(plant.measurement)
        failed = ~np.isin(outcome, (Outcome.RUNNING, Outcome.REACHED))
        return Held(task, grid, rows, inputs, samples, ends, outcome == Outcome.REACHED, failed)

    @cached_property
    def nearest(self) -> np.ndarray:
        """(N,) the place among `rows` of the node nearest to each node."""
        tree = self.grid.chart.tree(self.grid.nodes[self.rows])
        return np.asarray(tree.query(self.grid.chart.in_box(self.grid.nodes))[1])


def possible(task: Task, grid: Nodes) -> bool:
    """Returns whether a table can be made.

    That takes a chart of at most two dimensions, at most four inputs or a few levels, and an arrival that
    ends the episode.
    """
    few = len(task.inputs) in VALUES or task.input_levels is not None
    return isinstance(grid, Grid) and len(grid.counts) <= 2 and few and task.arrival_ends


def _samples(task: Task, z: np.ndarray, inputs: np.ndarray, away: float) -> int:
    """Returns after how many samples a held input usually has led away far enough, 0 if too many."""
    z = z[np.random.default_rng(0).choice(len(z), min(len(z), TRIED), replace=False)]
    n = len(z)
    plant = task.plant(n * len(inputs))
    starts, u = np.tile(z, (len(inputs), 1)), np.repeat(inputs, n, axis=0)
    plant.set_state(*task.state(starts))
    for k in range(1, LONGEST + 1):
        on = np.flatnonzero(task.ending(plant.measurement) == Outcome.RUNNING)
        plant.step(u[on], on)
        gone = task.chart.distance(task.z(plant.measurement), starts).reshape(len(inputs), n)
        if np.median(gone.max(axis=0)) >= away:
            return k
    return 0


def table_for(held: Held, ground: ModeGround) -> BoundTable:
    """Returns the policy of a mode: at each node the input that does well wherever noise may hide the robot.

    The measure of an input at a node is how many samples farther from arrival it leads, at the worst and on
    average over the nodes within the noise bound. Inputs may lead anywhere in the mode's set, which ends
    behind M*, so that no other way is open.

    Args:
        held: where held inputs lead.
        ground: where the mode has to win.
    """
    task, grid, rows = held.task, held.grid, held.rows
    ends = held.ends.reshape(-1, len(grid.counts))
    farther = _farther(held, ground.within.contains(ends))
    worst = np.stack([_in_reach(held, ground.bound, gain, "worst") for gain in farther])
    most = np.minimum(farther, LEAVING * task.max_steps)
    usual = np.stack([_in_reach(held, ground.bound, gain, "mean") for gain in most])
    hidden = ~np.isfinite(worst).all(axis=0)  # no node of the robot's is within the noise
    best = np.zeros(grid.size, dtype=int)
    best[~hidden] = (WORST * worst[:, ~hidden] + usual[:, ~hidden]).argmin(axis=0)
    best[hidden] = best[rows][held.nearest[hidden]]
    return BoundTable(task, grid, held.inputs[best])


def _farther(held: Held, stays: np.ndarray) -> np.ndarray:
    """Returns how many samples farther from arrival inputs lead: (A, k).

    `stays` (A * k,) bool tells which ends are allowed.
    """
    never = 2.0 * held.task.max_steps
    lost = ~held.arrived & (held.failed | ~stays.reshape(held.failed.shape))

    def after(left: np.ndarray) -> np.ndarray:
        """Returns the samples (A, k) that are left at the ends, from those at the nodes (k,)."""
        everywhere = left[held.nearest]
        value = np.stack([held.grid.interpolate(everywhere, z) for z in held.ends])
        return np.where(held.arrived, 0.0, np.where(lost, never, value))

    left = np.full(len(held.rows), never)
    for _ in range(SWEEPS):
        new = np.minimum(held.samples + after(left).min(axis=0), never)
        change, left = np.abs(new - left).max(), new
        if change < SETTLED:
            break
    return np.asarray(after(left) - left)


def _in_reach(held: Held, bound: np.ndarray, values: np.ndarray, how: str) -> np.ndarray:
    """Returns the worst or the mean (N,) of values (k,) of the `rows` within the noise of each node.

    It is not finite where there is none.
    """
    from scipy.ndimage import maximum_filter, uniform_filter  # slow to import

    grid = held.grid
    cells = np.where(bound > 0, np.maximum(np.ceil(bound / grid.spacing - 1e-9), 1), 0).astype(int)
    size = tuple(int(k) for k in 2 * cells + 1)
    modes = ["wrap" if wraps else "constant" for wraps in grid.chart.periodic]

    def spread(filled: float, of_rows: np.ndarray) -> np.ndarray:
        whole = np.full(grid.size, filled)
        whole[held.rows] = of_rows
        return whole.reshape(grid.counts)

    if how == "worst":
        whole = spread(-np.inf, values)
        return np.asarray(maximum_filter(whole, size, mode=modes, cval=-np.inf)).ravel()
    total, count = (
        uniform_filter(spread(0.0, of_rows), size, mode=modes).ravel()
        for of_rows in (values, np.ones(len(values)))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(count > 1e-9, total / count, np.inf)


# Returns the table of a mode by its ground.
TableOf = Callable[["ModeGround"], BoundTable]
