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

from hyrl_mj.errors import BadArtifact
from hyrl_mj.files import artifacts
from hyrl_mj.judging.game import nearest_of
from hyrl_mj.learning import TableSettings
from hyrl_mj.sets import Grid
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Outcome, Task

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from hyrl_mj.stages.extended_sets import ExtendedSets

# Values of each of m inputs that are tried.
VALUES = {1: 9, 2: 5, 3: 3, 4: 3}
# Values that change by less have converged [samples].
SETTLED = 1e-2
# Shares that are smaller are errors of rounding.
ROUNDING = 1e-9


@dataclass(frozen=True)
class TablePolicy:
    """Inputs at the nodes of a grid; between the nodes they are interpolated, or those of the nearest node.

    Attributes:
        task: gives the chart.
        grid: the nodes.
        inputs: (N, m).
    """

    KIND: ClassVar[str] = "table policy"

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
        arrays = {"counts": np.array(self.grid.counts), "inputs": self.inputs}
        artifacts.write_arrays(path.with_name(f"{path.stem}_table.npz"), arrays, self.KIND)

    @staticmethod
    def load(path: Path, task: Task) -> TablePolicy:
        """Reads what `save` wrote.

        Raises:
            BadArtifact: the file is missing, damaged, or does not fit the task.
        """
        arrays = artifacts.read_arrays(path, TablePolicy.KIND)
        with artifacts.reading(path):
            grid, inputs = Grid.from_counts(task.chart, arrays["counts"]), arrays["inputs"]
            if inputs.shape != (grid.size, len(task.inputs)) or not np.isfinite(inputs).all():
                raise BadArtifact(
                    f"a table of inputs {inputs.shape} does not fit {task.name}: run hyrl-mj retrain RUN to "
                    "write it again"
                )
        return TablePolicy(task, grid, inputs)


@dataclass(frozen=True)
class HeldInputs:
    """Where held inputs lead a robot that begins at rest at the nodes of a grid.

    Attributes:
        task: the robot and its problem.
        extended: M_ext_i of each mode, and the noise bound.
        rows: (k,) the nodes at which an episode goes on.
        inputs: (A, m) the inputs.
        samples: for how many samples each is held.
        ends: (A, k, d) chart points at the end.
        arrived: (A, k) bool, whether the robot arrives before.
        failed: (A, k) bool, whether it fails before.
        leaves: (M, A, k) bool, whether it leaves M_ext_i after a sample, or is outside of it at the end.
        settings: for how long inputs are held, and what noise shows.
    """

    task: Task
    extended: ExtendedSets
    rows: np.ndarray
    inputs: np.ndarray
    samples: int
    ends: np.ndarray
    arrived: np.ndarray
    failed: np.ndarray
    leaves: np.ndarray
    settings: TableSettings

    @staticmethod
    def from_sets(
        task: Task, extended: ExtendedSets, settings: TableSettings = TableSettings()
    ) -> HeldInputs | None:
        """Returns these runs, None where no table can be made, or the robot takes too long to get away.

        A table takes a chart of at most two dimensions, at most four inputs or a few levels, and an arrival
        that ends the episode.
        """
        grid, m, inputs = extended.sets[0].grid, len(task.inputs), task.input_levels
        few = m in VALUES or inputs is not None
        if not isinstance(grid, Grid) or len(grid.counts) > 2 or not few:
            return None
        if not (task.abilities.arrival_ends and task.abilities.restarts):
            return None
        if inputs is None:
            axes = [np.linspace(a, b, VALUES[m]) for a, b in zip(*task.input_limits, strict=True)]
            inputs = np.array(list(product(*axes)))
        rows = np.flatnonzero(task.goes_on(grid.nodes))
        bound = task.noise_in_chart(extended.eps)
        scaled = float((bound / task.chart.scale).max())
        away = max(settings.cells * grid.cell, settings.bounds * scaled)
        samples = _samples(task, grid.nodes[rows], inputs, away, settings.longest)
        if not samples:
            return None
        z = grid.nodes[rows]
        each = len(inputs), len(z)
        ends, outcome = np.empty((*each, z.shape[1])), np.empty(each, dtype=int)
        leaves = np.zeros((len(extended.sets), *each), dtype=bool)
        plant = task.tabulating(len(z))
        for a, u in enumerate(progress_bar(inputs, "held inputs", "inputs")):
            plant.set_state(*task.state(z))
            outcome[a] = Outcome.RUNNING
            inside = [own.contains(z) for own in extended.sets]
            for _ in range(samples):
                on = np.flatnonzero(outcome[a] == Outcome.RUNNING)
                plant.step(np.tile(u, (len(on), 1)), on)
                outcome[a] = task.outcome(plant.measurement, plant.unstable)
                ends[a] = task.z(plant.measurement)
                for i, own in enumerate(extended.sets):
                    before, inside[i] = inside[i], own.contains(ends[a])
                    leaves[i, a] |= before & ~inside[i]
            leaves[:, a] |= ~np.stack(inside)
        arrived = outcome == Outcome.REACHED
        failed = (outcome != Outcome.RUNNING) & ~arrived
        return HeldInputs(
            task, extended, rows, inputs, samples, ends, arrived, failed, leaves, settings
        )

    @property
    def grid(self) -> Grid:
        """The grid of the extended sets and of the table."""
        return self.extended.sets[0].regular

    @cached_property
    def bound(self) -> np.ndarray:
        """(d,) largest error of a measured chart point, along each coordinate."""
        return self.task.noise_in_chart(self.extended.eps)

    def own(self, mode: int) -> np.ndarray:
        """Returns whether the rows are in the set of a mode: (k,) bool."""
        return self.extended.sets[self.extended.modes.index(mode)].mask[self.rows]

    @property
    def never(self) -> float:
        """As many samples as count for an arrival that never comes."""
        return 2.0 * self.task.max_steps

    @cached_property
    def nearest(self) -> np.ndarray:
        """(N,) the place among `rows` of the node nearest to each node."""
        robots = np.isin(np.arange(self.grid.size), self.rows)
        return np.searchsorted(self.rows, nearest_of(self.grid, robots))

    @cached_property
    def _at_ends(self) -> csr_array:
        """(A * k, k) the matrix that interpolates values of the `rows` at the ends."""
        from scipy.sparse import csr_array  # slow to import

        nodes, weights = self.grid.corners(self.ends.reshape(-1, self.ends.shape[2]))
        corners, ends = nodes.shape
        index = np.tile(np.arange(ends), corners), self.nearest[nodes].ravel()
        return csr_array((weights.ravel(), index), shape=(ends, len(self.rows)))

    def after(self, left: np.ndarray, mode: int) -> np.ndarray:
        """Returns the samples (A, k) that are left after an input was held, from those at the rows (k,).

        They are `never` after a failure, and where the robot has left the set of the mode.
        """
        value = np.where(self.arrived, 0.0, (self._at_ends @ left).reshape(self.arrived.shape))
        lost = self.failed | self.leaves[self.extended.modes.index(mode)]
        return np.where(lost, self.never, value)


def _samples(task: Task, z: np.ndarray, inputs: np.ndarray, away: float, longest: int) -> int:
    """Returns after how many samples a held input usually has led away far enough, 0 if beyond the longest.

    That is found out from some of the points z (n, d).
    """
    z = z[np.random.default_rng(0).choice(len(z), min(len(z), 64), replace=False)]
    n = len(z)
    plant = task.tabulating(n * len(inputs))
    starts, u = np.tile(z, (len(inputs), 1)), np.repeat(inputs, n, axis=0)
    plant.set_state(*task.state(starts))
    for k in range(1, longest + 1):
        on = np.flatnonzero(task.ending(plant.measurement) == Outcome.RUNNING)
        plant.step(u[on], on)
        gone = task.chart.distance(task.z(plant.measurement), starts).reshape(len(inputs), n)
        if np.median(gone.max(axis=0)) >= away:
            return k
    return 0


def table_for(held: HeldInputs, mode: int) -> TablePolicy:
    """Returns the policy of a mode: at each node the input that does well wherever noise may hide the robot.

    The measure of an input at a node is how many samples farther from arrival it leads, at the worst and on
    average over the nodes within the noise bound. How far a node is from arrival is computed without noise
    at first, and then, some times over, under noise and the table so far: noise holds the robot where inputs
    that do well from each of two places are of no use in between. The table that arrives first on average
    is returned.

    The robot may not leave the mode's set on its way. The set ends behind M*, so that no other way is open.
    Where noise shows the robot outside of the set, inputs lead it back at once.

    Args:
        held: where held inputs lead.
        mode: the mode.
    """
    own = held.own(mode)
    left = _left(held, mode, lambda after: after.min(axis=0))
    tables: list[tuple[float, np.ndarray]] = []
    for _ in range(held.settings.tables):
        after = held.after(left, mode)
        table = _best(held, after - np.where(own, left, after.min(axis=0)))
        left = _left(held, mode, _under_noise(held, table))
        tables.append((float(left[own].mean()), table))
    _, table = min(tables, key=lambda made: made[0])
    return TablePolicy(held.task, held.grid, held.inputs[table])


def _left(held: HeldInputs, mode: int, follow: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Returns the samples (k,) from the rows to arrival.

    `follow` returns those (k,) after the input that is held next, from those (A, k) after each input. From
    rows outside of the mode's set there are `never` many: what lies behind its edge is not open.
    """
    own = held.own(mode)
    left = np.full(len(held.rows), held.never)
    for _ in range(2_000):  # far more than are needed
        new = np.minimum(held.samples + follow(held.after(left, mode)), held.never)
        new[~own] = held.never
        change, left = np.abs(new - left).max(), new
        if change < SETTLED:
            break
    return left


def _under_noise(held: HeldInputs, table: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Returns what follows, for `_left`, where noise chooses among the inputs (N,) of a table.

    Of its choices the share `worst` of the settings are the worst, the others are as likely as each other.
    """
    anywhere = np.ones(held.grid.size, dtype=bool)
    shares = np.stack(
        [
            _in_reach(held.grid, held.bound, table == a, anywhere, "mean")[held.rows]
            for a in range(len(held.inputs))
        ]
    )
    worst = held.settings.worst
    choices = np.where(shares > ROUNDING, 0.0, -np.inf)
    return lambda after: (
        worst * (after + choices).max(axis=0) + (1 - worst) * (shares * after).sum(axis=0)
    )


def _best(held: HeldInputs, farther: np.ndarray) -> np.ndarray:
    """Returns the best inputs (N,), from how many samples farther each of them leads from the rows (A, k)."""
    robots = np.zeros(held.grid.size, dtype=bool)
    robots[held.rows] = True
    score, values = np.full((len(farther), held.grid.size), np.inf), np.zeros(held.grid.size)
    for a, of_rows in enumerate(farther):
        values[held.rows] = of_rows
        worst, mean = (
            _in_reach(held.grid, held.bound, values, robots, how) for how in ("worst", "mean")
        )
        np.add(worst, mean, where=np.isfinite(worst), out=score[a])
    best = score.argmin(axis=0)
    told = score.min(axis=0) < score.max(axis=0) - SETTLED
    told &= np.isfinite(score).all(axis=0)  # else no node at which an episode goes on is near
    return best[nearest_of(held.grid, told)] if told.any() else best


def _in_reach(
    grid: Grid, bound: np.ndarray, values: np.ndarray, among: np.ndarray, how: str
) -> np.ndarray:
    """Returns the worst or the mean (N,) of values (N,), `among` (N,) bool, within the noise of each node.

    It is not finite where there is none.
    """
    from scipy.ndimage import maximum_filter, uniform_filter  # slow to import

    cells = np.where(bound > 0, np.maximum(np.ceil(bound / grid.spacing - 1e-9), 1), 0).astype(int)
    size = tuple(int(k) for k in 2 * cells + 1)
    modes = ["wrap" if wraps else "constant" for wraps in grid.chart.periodic]
    if how == "worst":
        kept = np.where(among, values, -np.inf).reshape(grid.counts)
        return np.asarray(maximum_filter(kept, size, mode=modes, cval=-np.inf)).ravel()
    total, count = (
        uniform_filter(v.reshape(grid.counts), size, mode=modes).ravel()
        for v in (np.where(among, values, 0.0), among.astype(float))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(count > ROUNDING, total / count, np.inf)
