"""Cells: the states between the nodes of a lattice, and the cells that one sample can lead to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game import Lattice, Places
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.judging.proof.assumptions import check_assumptions
from hyrl_mj.judging.proof.networks import bounds_of, method_of, program_of
from hyrl_mj.judging.proof.rules import as_form
from hyrl_mj.sets import Grid, within_reach
from hyrl_mj.simulation import Sensor
from hyrl_mj.tasks import Outcome, Task

# Samples whose ends lie this close to the border of a cell, in cells after a whole episode, end on it.
ON_BORDER = 1e-3
# Rounding of what is counted in cells.
TINY = 1e-9
# Rounding of a coordinate, and of how far a turn is, as a share of it.
ROUNDING = 16 * float(np.finfo(float).eps)
# The plant has to move all states alike, up to this share of a cell.
ALIKE = 1e-3
# States from which it is tried how evenly the plant moves, and samples of each run.
STATES, SAMPLES = 3_000, 3


@dataclass(frozen=True)
class Cells(Places):
    """The closed cells between the nodes of a lattice, a covering of the chart.

    Every state of a cell, widened by `slack`, is one of the cell's states: rounding in the plant never leaves
    the covering. All states of a cell that has arrived, and some of one that has failed, end an episode so.

    A run has arrived for good where it ends as a success. Where it does not end, it has to be able to stay
    in cells that would be a success at the end of an episode.

    Attributes:
        lattice: the nodes.
        counts: (d,) number of cells along each coordinate.
        exact: (d,) bool, whether every sample moves cells onto cells, but for rounding.
        slack: (d,) by how much the cells are widened [chart units].
        success: (N,) bool, cells all of whose states are a success if the episode is cut off there.
        slope, offset: (d, m), (d,) of the displacement in one sample, slope @ u + offset [chart units].
        error: (d,) largest error of the displacement in one sample.
        outside: (M...) int, places of the cells and of those around the chart, from `-margin` on.
        margin: (d,) number of cells beyond the chart on either side of coordinates that are not periodic.
    """

    lattice: Lattice
    counts: tuple[int, ...]
    exact: np.ndarray
    slack: np.ndarray
    success: np.ndarray
    slope: np.ndarray
    offset: np.ndarray
    error: np.ndarray
    outside: np.ndarray
    margin: np.ndarray

    @staticmethod
    def cover(lattice: Lattice, spacing: np.ndarray | None = None) -> Cells:
        """Returns the cells of a lattice; its plant has to be even on nodes `spacing` (d,) apart.

        Raises:
            Unbounded: the plant does not move all states alike, or the end of an episode cannot be bounded.
        """
        task, grid = lattice.task, lattice.grid
        check_assumptions(task)
        if not lattice.direct:
            raise Unbounded(f"the chart of {task.name} is not its position")
        periodic, h = np.array(task.chart.periodic), grid.spacing
        # The displacement is linear in the inputs.
        levels = np.hstack([lattice.levels, np.ones((len(lattice.levels), 1))])
        fit, *_ = np.linalg.lstsq(levels, lattice.hops, rcond=None)
        slope, offset = fit[:-1].T, fit[-1]
        error = _error(lattice, slope, offset)
        if (error > ALIKE * (h if spacing is None else spacing)).any():
            raise Unbounded(
                f"the plant of {task.name} does not move all states alike: with the same input some move "
                f"{error.max():.2g} farther than others"
            )
        _check_chart(lattice)
        # Where every sample moves cells onto cells, only rounding adds up over an episode.
        cells = lattice.hops / h
        drift = task.max_steps * (np.abs(cells - np.round(cells)) * h + error).max(axis=0)
        # Between levels, inputs lead to places between those of the levels.
        on_levels = (task.input_levels is not None) | ~slope.any(axis=1)
        exact = (drift <= ON_BORDER * h) & on_levels
        slack = np.where(exact, drift, error) + 2 * TINY * h
        # Far from the chart, after many turns, numbers are rounded more.
        far = (
            np.abs(grid.chart.low)
            + grid.chart.sides
            + task.max_steps * np.abs(lattice.hops).max(axis=0)
        )
        slack = np.maximum(slack, np.where(periodic, ROUNDING * far, 0.0))
        counts = np.array(grid.counts) - ~periodic
        # What lies beyond the chart is known as far as a sample leads, and a bias shows the robot.
        bias = Sensor.parse(task.sensor).bounds(task)[1] / h if task.sensor else 0.0
        reach = np.ceil(np.abs(cells).max(axis=0) + 1 + bias).astype(int)
        margin = np.where(periodic, 0, reach)
        index = np.stack([*np.indices(tuple(counts + 2 * margin))], axis=-1) - margin
        centre, half = grid.chart.low + h * (index.reshape(-1, len(h)) + 0.5), h / 2 + slack
        fails, ends, success = _ends(task, Affine.box(centre, half))
        # Beyond the chart the episode has to end as a success now, or after whatever comes next.
        low, high = lattice.hops.min(axis=0), lattice.hops.max(axis=0)
        next_half = half + (high - low) / 2 + error
        _, next_ends, _ = _ends(task, Affine.box(centre + (low + high) / 2, next_half))
        arrives = ends | success & next_ends
        fails, ends, success, arrives = (
            mask.reshape(index.shape[:-1]) for mask in (fails, ends, success, arrives)
        )
        inside = ((index >= 0) & (index < counts)).all(axis=-1)
        n = int(counts.prod())
        outside = np.where(arrives, n, n + 1)
        outside[inside] = np.arange(n)
        covering = Cells(
            arrived=ends[inside],
            failed=fails[inside],
            running=~(ends | fails)[inside],
            lattice=lattice,
            counts=tuple(int(k) for k in counts),
            exact=exact,
            slack=slack,
            success=success[inside],
            slope=slope,
            offset=offset,
            error=error,
            outside=outside,
            margin=margin,
        )
        # A node lies in all cells around it.
        odd = lattice.failed & ~covering.all_around(covering.failed)
        odd |= lattice.running & ~covering.all_around(~covering.arrived)
        if odd.any():
            raise Unbounded(
                f"{method_of(task, 'ending')} gives another result at "
                f"{task.chart.format(grid.nodes[odd][0])} than the operations that it does with the "
                "measurement: let it do the same with all of them"
            )
        return covering

    def widened(self, by: np.ndarray) -> Cells:
        """Returns cells that end a run as they do where a robot is anywhere within `by` (d,) of them."""
        n = self.nodes
        inside, arrives = self.outside < n, self.outside == n
        arrived = self._throughout(self.arrived, arrives, by)
        goes_on = self._throughout(~self.failed, arrives, by)[inside]
        return replace(
            self,
            arrived=arrived[inside],
            failed=~goes_on,
            running=goes_on & ~arrived[inside],
            success=self._throughout(self.success, arrives, by)[inside],
            outside=np.where(inside, self.outside, np.where(arrived, n, n + 1)),
        )

    def within(self, mask: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Returns the cells (N,) bool of which all that lies within `by` (d,) is in cells of a mask."""
        inside = self.outside < self.nodes
        return self._throughout(mask, np.zeros_like(inside), by)[inside]

    def _throughout(self, mask: np.ndarray, beyond: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Returns where all that lies within `by` (d,) is of a mask (N,) bool, or is `beyond` the chart."""
        whole, grid = beyond.copy(), self.lattice.grid
        whole[self.outside < self.nodes] = mask
        reach = np.ceil(by / grid.spacing - TINY).astype(int)
        return ~within_reach(~whole, reach, grid.chart.periodic)

    def shifts(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the first and last cell (..., d) that a cell can move onto, relative to itself.

        Args:
            low, high: (..., m) least and greatest inputs.
        """
        middle, half = (low + high) / 2, (high - low) / 2
        centre = middle @ self.slope.T + self.offset
        reach = half @ np.abs(self.slope).T + self.error
        h = self.lattice.grid.spacing
        near = np.where(self.exact, ON_BORDER, 0.0)
        first = np.floor((centre - reach) / h + near).astype(int)
        last = np.ceil((centre + reach) / h - near).astype(int)
        return first, last

    def after(self, shift: np.ndarray) -> np.ndarray:
        """Returns the places (N,) of the cells after a shift (d,) by whole cells."""
        axes = []
        pairs = zip(shift, self.counts, self.margin, self.lattice.grid.chart.periodic, strict=True)
        for by, n, margin, periodic in pairs:
            at = np.arange(n) + by
            axes.append(at % n if periodic else at + margin)
        return np.asarray(self.outside[np.ix_(*axes)].ravel())

    def shifted(self, by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the cells (k, N) at shifts (k, d) by whole cells, and whether these exist: (k, N)."""
        periodic, counts = self.lattice.grid.chart.periodic, np.array(self.counts)
        at = np.stack(np.unravel_index(np.arange(self.nodes), self.counts), axis=-1) + by[:, None]
        at = np.where(periodic, at % counts, at)
        inside = np.clip(at, 0, counts - 1)
        found = np.ravel_multi_index(tuple(np.moveaxis(inside, -1, 0)), self.counts)
        return np.asarray(found), (at == inside).all(axis=-1)

    def all_corners(self, nodes: np.ndarray) -> np.ndarray:
        """Returns the cells (N,) bool all of whose corners are among the nodes (nodes,) bool."""
        grid = self.lattice.grid
        mask = nodes.reshape(grid.counts)
        for axis, periodic in enumerate(grid.chart.periodic):
            mask = mask & np.roll(mask, -1, axis)
            if not periodic:
                mask = np.delete(mask, -1, axis)
        return np.asarray(mask.ravel())

    def some_corner(self, nodes: np.ndarray) -> np.ndarray:
        """Returns the cells (N,) bool with a corner among the nodes (nodes,) bool."""
        return ~self.all_corners(~nodes)

    def all_around(self, cells: np.ndarray) -> np.ndarray:
        """Returns the nodes (nodes,) bool all of whose cells are among the cells (N,) bool."""
        mask = cells.reshape(self.counts)
        for axis, periodic in enumerate(self.lattice.grid.chart.periodic):
            if periodic:
                mask = mask & np.roll(mask, 1, axis)
            else:
                ends = [(1, 1) if a == axis else (0, 0) for a in range(mask.ndim)]
                wide = np.pad(mask, ends, constant_values=True)
                mask = np.delete(wide, 0, axis) & np.delete(wide, -1, axis)
        return np.asarray(mask.ravel())

    def place(self, z: np.ndarray) -> np.ndarray:
        """Returns the place (n,) of chart points (n, d): its cell, or "arrived" or "failed" beyond."""
        grid = self.lattice.grid
        index = np.floor((grid.chart.wrap(z) - grid.chart.low) / grid.spacing).astype(int)
        index = np.where(grid.chart.periodic, index % self.counts, index + self.margin)
        index = np.clip(index, 0, np.array(self.outside.shape) - 1)
        return self.outside[tuple(index.T)]

    def middle(self, cells: np.ndarray) -> np.ndarray:
        """Returns the chart points (n, d) in the middle of cells (n,)."""
        index = np.stack(np.unravel_index(cells, self.counts), axis=-1)
        grid = self.lattice.grid
        return np.asarray(grid.chart.low + grid.spacing * (index + 0.5))

    def draw(self, cells: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns a chart point inside of each of cells (n,): (n, d)."""
        off = rng.uniform(-0.5, 0.5, (len(cells), len(self.counts)))
        return self.middle(cells) + off * self.lattice.grid.spacing


def _check_chart(lattice: Lattice) -> None:
    """Raises `Unbounded` if an episode may go on beyond the chart, where nothing is known of what it wins."""
    task, nodes = lattice.task, lattice.grid.nodes[lattice.running]
    for hop in lattice.hops:
        out = nodes + hop
        out = out[~task.chart.contains(out)]
        goes_on = task.ending(out) == Outcome.RUNNING
        if goes_on.any():
            raise Unbounded(
                f"an episode of {task.name} goes on where a sample leads out of its chart, as at "
                f"{task.chart.format(out[goes_on][0])}, and nothing is known of what is won from there: let "
                "ending() end it, or make the chart wider"
            )


def _ends(task: Task, boxes: Affine) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns where an episode may fail, surely ends as a success, or is one if cut off: (n,) bool each."""
    found = []
    for name in ("ending", "verdict"):
        outcome = bounds_of(program_of(task, name), method_of(task, name), boxes)
        found.append(as_form(outcome, len(boxes.generators)))
    ending, verdict = found
    # The outcomes RUNNING, REACHED, and the failures are numbered in this order.
    fails = (ending.high > Outcome.REACHED + 0.5) | ending.nan
    reached, success = (
        (np.abs(form.centre - Outcome.REACHED) + form.radius < 0.5) & ~form.nan
        for form in (ending, verdict)
    )
    return fails, reached & ~fails, (reached | success) & ~fails


def _error(lattice: Lattice, slope: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Returns the largest error (d,) of the displacement in one sample, with a safety factor of 2.

    It is that of the nodes and levels, and of runs from states between them, with all kinds of inputs, each
    of which carries on what the input before has left.
    """
    task = lattice.task
    off = np.abs(lattice.hops - lattice.levels @ slope.T - offset).max(axis=0)
    spread = np.zeros_like(off)
    rng, low, high = np.random.default_rng(0), *task.input_limits
    z = task.chart.draw(STATES, rng)
    plant = task.placed(z)
    for _ in range(SAMPLES):
        drawn = rng.uniform(low, high, (STATES, len(low)))
        corners = np.where(rng.random(drawn.shape) < 0.5, low, high)
        levels = lattice.levels[rng.integers(len(lattice.levels), size=STATES)]
        which = rng.integers(3, size=(STATES, 1))
        u = np.select([which == 0, which == 1], [drawn, corners], levels)
        before = plant.measurement
        plant.step(u)
        hops = plant.measurement - before
        spread = np.maximum(spread, np.abs(hops - u @ slope.T - offset).max(axis=0))
    return np.asarray(2 * np.maximum(lattice.uneven + off + _carried(lattice), spread))


def _carried(lattice: Lattice) -> np.ndarray:
    """Returns by how much the input before changes the displacement in one sample, at most: (d,)."""
    task, grid = lattice.task, lattice.grid
    before = np.unique(lattice.levels[[0, -1]], axis=0)
    first, then = (
        np.repeat(before, len(lattice.levels), axis=0),
        np.tile(lattice.levels, (len(before), 1)),
    )
    start = grid.nodes[np.flatnonzero(lattice.running)[:1]]
    plant = task.placed(np.repeat(start, len(first), axis=0))
    plant.step(first)
    middle = plant.measurement
    plant.step(then)
    hops = plant.measurement - middle
    return np.asarray(np.abs(hops - np.tile(lattice.hops, (len(before), 1))).max(axis=0))


@lru_cache(8)
def why_no_cells(task: Task, counts: tuple[int, ...]) -> str | None:
    """Returns why no cells cover this task's chart, so that a game proves nothing and decides nothing.

    None if they do. The cells are tried on at most 61 nodes along each side, the plant at the distances of a
    grid of `counts` nodes.
    """
    few = tuple(min(count, 61) for count in counts)
    try:
        Cells.cover(Lattice.tabulate(task, Grid(task.chart, few)), Grid(task.chart, counts).spacing)
    except (Unbounded, BadInput) as error:
        return str(error)
    return None
