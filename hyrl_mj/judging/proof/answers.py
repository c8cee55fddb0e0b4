"""The answers that a controller can give anywhere in boxes of measurements, bounded from outside."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from hyrl_mj.judging.proof.affine import Unbounded
from hyrl_mj.judging.proof.assumptions import check_assumptions
from hyrl_mj.judging.proof.cells import TINY, Cells
from hyrl_mj.judging.proof.networks import BoundedPolicy, in_chunks
from hyrl_mj.policies import ON_EDGE, Controller, HybridController, PolicyController
from hyrl_mj.sets import Everything, Grid, GridSet, StateSet, within_reach
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Boxes:
    """Boxes that cover all measurements: those of the chart, and around it as far as the noise reaches.

    Attributes:
        cells: the cells of the true states.
        fine: (d,) int, number of boxes along one side of a cell.
        pad: (d,) int, number of cells beyond the chart on either side.
    """

    cells: Cells
    fine: np.ndarray
    pad: np.ndarray

    @staticmethod
    def around(cells: Cells, bound: np.ndarray) -> Boxes:
        """Returns the boxes for noise within bounds (d,)."""
        grid = cells.lattice.grid
        fine = np.where(bound > 0, 2, 1)  # boxes along one side of a cell
        pad = np.ceil(bound / grid.spacing + 1).astype(int)
        return Boxes(cells, fine, np.where(grid.chart.periodic, 0, pad))

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of boxes along each coordinate."""
        return tuple(int(k) for k in (np.array(self.cells.counts) + 2 * self.pad) * self.fine)

    @property
    def step(self) -> np.ndarray:
        """The sides of a box (d,)."""
        return np.asarray(self.cells.lattice.grid.spacing / self.fine)

    @property
    def low(self) -> np.ndarray:
        """The lowest corner (d,)."""
        grid = self.cells.lattice.grid
        return np.asarray(grid.chart.low - self.pad * grid.spacing)

    def everywhere(self, bounds: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """Returns bounds of answers in every box, from blocks that are halved where these are not sharp.

        Args:
            bounds: boxes with centres (n, d) and half sides (d,) -> (n, ...): bool for each of several
                answers, or the ends of intervals (n, 2, m).
        """
        counts, d = np.array(self.counts), len(self.counts)
        block = 8  # boxes along each side, at first
        size = np.where(counts >= block, block, 1)
        index = _all(-(-counts // size)) * size
        whole: np.ndarray | None = None
        while len(index):
            centre = self.low + self.step * (index + size / 2)
            found = in_chunks(bounds, centre, self.step * size / 2 + self.cells.slack)
            if whole is None:
                whole = np.empty((*counts, *found.shape[1:]), dtype=found.dtype)
            sharp = _is_sharp(found) | (size == 1).all()
            covered = (index[sharp][:, None] + _all(size)).reshape(-1, d)
            values = np.repeat(found[sharp], int(size.prod()), axis=0)
            inside = (covered < counts).all(axis=1)
            whole[tuple(covered[inside].T)] = values[inside]
            half = np.maximum(size // 2, 1)
            index = (index[~sharp][:, None] + _all(size // half) * half).reshape(-1, d)
            index, size = index[(index < counts).all(axis=1)], half
        assert whole is not None
        return whole

    def distances(self, members: StateSet) -> tuple[np.ndarray, np.ndarray]:
        """Returns the least and the greatest signed distance to a set in every box: (M...), (M...).

        A set on a grid is multilinear between its nodes: its extremes lie in corners of the box, or where
        the lines of the grid cross its edges.

        Raises:
            Unbounded: a set that is not on a grid.
        """
        if type(members) is Everything:
            nowhere = np.full(self.counts, -np.inf)
            return nowhere, nowhere
        if type(members) is not GridSet:
            raise Unbounded(f"a {type(members).__name__} cannot be bounded: give sets on grids")
        if members.regular.chart != self.cells.lattice.grid.chart:
            raise Unbounded(
                "a set in another chart cannot be bounded: give sets in that of the task"
            )
        grid, values = members.regular, members.values.reshape(members.regular.counts)
        steep = 0.0
        for axis, periodic in enumerate(grid.chart.periodic):
            ring = np.take(values, [0], axis=axis)
            rises = (
                np.diff(values, axis=axis, append=ring) if periodic else np.diff(values, axis=axis)
            )
            steep += float(np.abs(rises).max() / grid.spacing[axis] * self.cells.slack[axis])
        least = greatest = values
        for axis, n in enumerate(self.counts):
            ends = self.low[axis] + self.step[axis] * np.arange(n + 1)
            lines = np.arange(
                np.floor((ends[0] - grid.chart.low[axis]) / grid.spacing[axis]),
                np.ceil((ends[-1] - grid.chart.low[axis]) / grid.spacing[axis]) + 1,
            )
            lines = grid.chart.low[axis] + grid.spacing[axis] * lines
            inner = lines[(lines > ends[0]) & (lines < ends[-1])]
            at = np.union1d(ends, inner)
            first = np.searchsorted(at, ends)
            least = _extremes(np.minimum, _interpolated(least, axis, at, grid), first, axis)
            greatest = _extremes(np.maximum, _interpolated(greatest, axis, at, grid), first, axis)
        slack = steep + 1e-12
        return least - slack, greatest + slack

    def reachable(
        self, mask: np.ndarray, bound: np.ndarray, centre: np.ndarray | None = None
    ) -> np.ndarray:
        """Returns the cells (N,) bool from which noise can show a box of a mask (M...).

        The noise is within bounds (d,) around `centre` (d,), by default 0.
        """
        if centre is not None:
            by = np.round(centre / self.step).astype(int)
            # No farther than the boxes reach beyond the chart, so what comes around again is not looked at.
            mask = np.roll(mask, -by, range(mask.ndim))
            bound = bound + np.abs(centre - by * self.step)
        reach = np.ceil(bound / self.step - TINY).astype(int)
        mask = within_reach(mask, reach, self.cells.lattice.grid.chart.periodic)
        for axis, (n, fine) in enumerate(zip(self.cells.counts, self.fine, strict=True)):
            of_cells = self.pad[axis] * fine + np.arange(n * fine)
            boxes = np.take(mask, of_cells, axis)
            mask = np.logical_or.reduceat(boxes, np.arange(0, n * fine, fine), axis)
        return np.asarray(mask.ravel())


def _check_task(cells: Cells, task: Task) -> None:
    """Raises `Unbounded` unless a part of a controller that has a task of its own sees as a proof assumes."""
    if task is cells.lattice.task:
        return
    if task.chart != cells.lattice.task.chart:
        raise Unbounded(f"the controller is one for another chart, that of {task.name}")
    check_assumptions(task)


def _all(counts: np.ndarray) -> np.ndarray:
    """Returns all indices (n, d) of an array with `counts` (d,) entries along each axis."""
    return np.indices(tuple(counts)).reshape(len(counts), -1).T


def _is_sharp(found: np.ndarray) -> np.ndarray:
    """Returns whether only one answer is possible: (n,) bool."""
    if found.dtype == bool:
        return np.asarray(found.sum(axis=1) == 1)
    return np.asarray((found[:, 0] == found[:, 1]).all(axis=1))


def _interpolated(values: np.ndarray, axis: int, at: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns values on the lines of a grid, interpolated linearly at points (k,) along an axis."""
    chart, counts = grid.chart, grid.counts[axis]
    index = (at - chart.low[axis]) / grid.spacing[axis]
    if chart.periodic[axis]:
        below = np.floor(index).astype(int)
        share, above = index - below, (below + 1) % counts
        below %= counts
    else:
        index = np.clip(index, 0, counts - 1)
        below = np.minimum(index.astype(int), counts - 2)
        share, above = index - below, below + 1
    shape = [1] * values.ndim
    shape[axis] = -1
    share = share.reshape(shape)
    return np.take(values, below, axis) * (1 - share) + np.take(values, above, axis) * share


def _extremes(extreme: np.ufunc, values: np.ndarray, first: np.ndarray, axis: int) -> np.ndarray:
    """Returns the extreme over the closed ranges between points `first` (n + 1,) along an axis."""
    inner = extreme.reduceat(values, first[:-1], axis=axis)
    return np.asarray(extreme(inner, np.take(values, first[1:], axis)))


@dataclass(frozen=True)
class BoundedAnswers:
    """All answers that a controller can give in every box, in every mode.

    The last row is for a run that has not started yet, as in `game.Answers`.

    Attributes:
        boxes: the boxes of measurements.
        modes: the controller's modes.
        goes: (Q + 1, Q, M...) bool, the modes after the sample that are possible.
        shifts: for each mode, shifts (d,) by whole cells with the boxes (M...) bool in which its policy may
            choose an input that moves a cell so.
    """

    boxes: Boxes
    modes: tuple[int, ...]
    goes: np.ndarray
    shifts: tuple[tuple[tuple[np.ndarray, np.ndarray], ...], ...]

    @staticmethod
    def enclose(cells: Cells, controller: Controller, bound: np.ndarray) -> BoundedAnswers:
        """Returns the answers of a controller to measurements with noise of at most `bound` (d,).

        Raises:
            Unbounded: the controller, one of its policies or sets, or the task cannot be bounded.
        """
        boxes = Boxes.around(cells, bound)
        if type(controller) is PolicyController:
            policies, goes = [controller.policy], np.ones((2, 1, *boxes.counts), dtype=bool)
        elif type(controller) is HybridController:
            _check_task(cells, controller.task)
            policies = [controller.policies[q] for q in controller.modes]
            goes = _modes_after(boxes, controller)
        else:
            raise Unbounded(f"a controller that is a {type(controller).__name__} cannot be bounded")
        bounded = [BoundedPolicy.from_policy(policy) for policy in policies]
        for policy in bounded:
            _check_task(cells, policy.network.task)
        shifts = tuple(tuple(_shifts(boxes, policy)) for policy in bounded)
        return BoundedAnswers(boxes, controller.modes, goes, shifts)

    def possible(
        self, bound: np.ndarray, centre: np.ndarray | None = None
    ) -> Iterator[Iterator[tuple[int, np.ndarray, np.ndarray]]]:
        """Yields for each row what noise can lead to: number of the mode, shift, cells.

        The noise is within bounds (d,) around `centre` (d,), by default 0.
        """
        for goes in self.goes:
            yield (
                (mode, shift, self.boxes.reachable(goes[mode] & chosen, bound, centre))
                for mode, shifts in enumerate(self.shifts)
                for shift, chosen in shifts
                if (goes[mode] & chosen).any()
            )


def _shifts(boxes: Boxes, policy: BoundedPolicy) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields the shifts of cells that a policy can choose, with the boxes in which it can."""
    cells, task = boxes.cells, policy.network.task
    if task.input_levels is not None:
        chosen = boxes.everywhere(policy.levels)
        first, last = cells.shifts(task.input_levels, task.input_levels)
        for shift in _between(first, last):
            leads = ((first <= shift) & (shift <= last)).all(axis=1)
            yield shift, np.asarray(chosen[..., leads].any(axis=-1))
        return
    ends = boxes.everywhere(policy.inputs)
    first, last = cells.shifts(ends[..., 0, :], ends[..., 1, :])
    for shift in _between(first.reshape(-1, first.shape[-1]), last.reshape(-1, last.shape[-1])):
        yield shift, np.asarray(((first <= shift) & (shift <= last)).all(axis=-1))


def _between(first: np.ndarray, last: np.ndarray) -> Iterator[np.ndarray]:
    """Yields all shifts (d,) from the least of the first (n, d) to the greatest of the last (n, d)."""
    ranges = [*zip(first.min(axis=0), last.max(axis=0) + 1, strict=True)]
    most = 512  # each takes a mask of all boxes
    if (number := int(np.prod([b - a for a, b in ranges]))) > most:
        raise Unbounded(
            f"one sample can lead to {number:,} different cells, more than {most}: give fewer cells "
            "(`lattice` in the settings)"
        )
    yield from map(np.array, product(*(range(a, b) for a, b in ranges)))


def _modes_after(boxes: Boxes, controller: HybridController) -> np.ndarray:
    """Returns the modes (Q + 1, Q, M...) bool that are possible after a sample, for every mode before it."""
    modes, flows = controller.modes, controller.flow_sets
    within = [boxes.distances(flows[q]) for q in modes]
    starts = controller.starts or flows
    begin = _deepest([boxes.distances(starts[q]) for q in modes])
    goes = np.zeros((len(modes) + 1, len(modes), *boxes.counts), dtype=bool)
    for q, (least, greatest) in enumerate(within):
        others = [k for k in range(len(modes)) if k != q]
        goes[q, q] = least <= ON_EDGE if others else True
        if others:
            goes[q, others] = _deepest([within[k] for k in others]) & (greatest > ON_EDGE)
        # A run begins in the mode that its first measurement selects, and may jump at once.
        goes[-1] |= begin[q] & goes[q]
    return goes


def _deepest(distances: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Returns which of the sets may be the deepest: (Q, M...) bool, from their signed distances."""
    nearest = np.min([greatest for _, greatest in distances], axis=0)
    return np.stack([least <= nearest for least, _ in distances])
