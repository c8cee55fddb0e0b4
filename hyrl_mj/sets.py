"""Sets in a task's chart, by their signed distance in chart units: negative inside, positive outside."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Protocol

import numpy as np

from hyrl_mj.artifacts import MOST_ROWS
from hyrl_mj.chart import Chart
from hyrl_mj.errors import BadInput

# The runs from more nodes than this do not fit into the memory of a small machine.
MOST_NODES = 2**19


class StateSet(Protocol):
    """A closed set of chart points, given by its signed distance."""

    def signed_distance(self, z: np.ndarray) -> np.ndarray:
        """Returns the distance (n,) of points (n, d) to the boundary, negative inside, in chart units."""

    def contains(self, z: np.ndarray) -> np.ndarray:
        """Returns whether points (n, d) lie in the set: (n,) bool."""
        return self.signed_distance(z) <= 0


@dataclass(frozen=True)
class Everything(StateSet):
    """The whole chart, without a boundary."""

    def signed_distance(self, z: np.ndarray) -> np.ndarray:
        return np.full(len(z), -np.inf)


@dataclass(frozen=True)
class Complement(StateSet):
    """The closure of the complement of a set."""

    inner: StateSet

    def signed_distance(self, z: np.ndarray) -> np.ndarray:
        return -self.inner.signed_distance(z)


@dataclass(frozen=True)
class Grid:
    """Nodes that cover a chart, equally spaced along each coordinate.

    Attributes:
        chart: the chart. A periodic coordinate has no node at the end of the period.
        counts: number of nodes along each coordinate.
    """

    chart: Chart
    counts: tuple[int, ...]

    @staticmethod
    def with_cells(chart: Chart, cells: int) -> Grid:
        """Returns a grid with square cells (in chart units), `cells` of them along the longest side.

        Raises:
            BadInput: it would have more than `MOST_NODES` nodes.
        """
        number = np.maximum(np.round(cells * chart.sides / chart.sides.max()).astype(int), 2)
        counts = tuple(int(k) for k in number + ~np.array(chart.periodic))
        if (nodes := math.prod(counts)) > MOST_NODES:
            raise BadInput(
                f"a grid of {cells:,} cells along the longest side has {nodes:,} nodes: give fewer cells, "
                f"for at most {MOST_NODES:,}"
            )
        return Grid(chart, counts)

    @staticmethod
    def from_counts(chart: Chart, counts: np.ndarray) -> Grid:
        """Returns a grid with `counts` (d,) nodes.

        Raises:
            BadInput: the chart has another dimension, or no grid has so many nodes.
        """
        if len(counts) != chart.dimension:
            raise BadInput(f"a grid of {len(counts)} dimensions does not fit chart {chart.names}")
        numbers = tuple(int(n) for n in counts)
        if min(numbers) < 2 or math.prod(numbers) > MOST_NODES:
            raise BadInput(
                f"a grid of {numbers} nodes cannot be used: give 2 or more on each axis, and at most "
                f"{MOST_NODES:,} in all"
            )
        return Grid(chart, numbers)

    @cached_property
    def spacing(self) -> np.ndarray:
        """Distance between nodes along each coordinate (d,)."""
        return self.chart.sides / (np.array(self.counts) - ~np.array(self.chart.periodic))

    @property
    def cell(self) -> float:
        """The longest side of a cell."""
        return float(self.spacing.max())

    @cached_property
    def nodes(self) -> np.ndarray:
        """All nodes (N, d); the last coordinate varies fastest."""
        axes = [
            low + step * np.arange(count)
            for low, step, count in zip(self.chart.low, self.spacing, self.counts, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))

    @cached_property
    def _last(self) -> np.ndarray:
        """The greatest index (d,); infinite for periodic coordinates."""
        return np.where(self.chart.periodic, np.inf, np.array(self.counts) - 1)

    def index(self, z: np.ndarray) -> np.ndarray:
        """Returns the fractional indices (n, d) of points (n, d), clipped to the grid."""
        index = (self.chart.wrap(z) - self.chart.origin) / self.spacing
        return np.minimum(np.maximum(index, 0), self._last)

    def nearest(self, z: np.ndarray) -> np.ndarray:
        """Returns the flat indices (n,) of the nodes nearest to points (n, d)."""
        index = np.round(self.index(z)).astype(int) % self.counts
        return np.ravel_multi_index(tuple(index.T), self.counts)

    def neighbours(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns all pairs of neighbours along a coordinate, as flat indices (k,), (k,)."""
        index = np.arange(int(np.prod(self.counts))).reshape(self.counts)
        pairs = []
        for axis, periodic in enumerate(self.chart.periodic):
            after = np.roll(index, -1, axis)
            kept = slice(None) if periodic else slice(-1)
            pairs.append([np.moveaxis(i, axis, 0)[kept].ravel() for i in (index, after)])
        first, second = np.concatenate(pairs, axis=1)
        return first, second

    @cached_property
    def _corners(self) -> np.ndarray:
        """The corners (d, 2**d, 1) of a cell: 0 is the lower node along a coordinate, 1 the upper."""
        return np.indices((2,) * len(self.counts)).reshape(len(self.counts), -1, 1)

    def interpolate(self, values: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Returns values at points (n, d) by multilinear interpolation of the nodes' values (N,): (n,)."""
        index = self.index(z).T[:, None]
        below = index.astype(int)
        share = index - below
        weights = reduce(np.multiply, np.where(self._corners, share, 1 - share))
        # On the last node of an axis the upper corner has the weight 0: "wrap" keeps its index valid.
        nodes = np.ravel_multi_index(tuple(below + self._corners), self.counts, mode="wrap")
        # The corners are added in turn: np.sum rounds differently for one point than for many.
        return reduce(np.add, weights * values[nodes])


@dataclass(frozen=True)
class GridSet(StateSet):
    """A set given by its signed distance at the nodes of a grid, interpolated in between.

    Attributes:
        grid: the nodes.
        values: (N,) signed distances, in chart units.
    """

    grid: Grid
    values: np.ndarray

    def __post_init__(self) -> None:
        if self.values.shape != (np.prod(self.grid.counts),):
            raise BadInput(f"{self.values.shape} distances do not fit {self.grid.counts} nodes")
        if not np.isfinite(self.values).all():
            raise BadInput("signed distances must be finite, and some are not")
        self.values.setflags(write=False)

    @staticmethod
    def from_mask(grid: Grid, inside: np.ndarray) -> GridSet:
        """Returns the set with the nodes `inside` (N,) bool; its boundary lies half-way between nodes."""
        from scipy import ndimage  # slow to import

        inside = inside.reshape(grid.counts)
        if inside.all() or not inside.any():
            far = float(np.linalg.norm(grid.chart.sides))
            return GridSet(grid, np.full(inside.size, -far if inside.all() else far))
        wide, middle = _unrolled(grid, inside)
        outward = ndimage.distance_transform_edt(~wide, sampling=grid.spacing)[middle]
        inward = ndimage.distance_transform_edt(wide, sampling=grid.spacing)[middle]
        half = grid.cell / 2
        return GridSet(grid, np.where(inside, half - inward, outward - half).ravel())

    @staticmethod
    def pack(sets: tuple[GridSet, ...]) -> dict[str, np.ndarray]:
        """Returns sets on one grid as the arrays `grid_counts` (d,) and `signed_distance` (k, N)."""
        return {
            "grid_counts": np.array(sets[0].grid.counts),
            "signed_distance": np.stack([members.values for members in sets]),
        }

    @staticmethod
    def unpack(arrays: Mapping[str, np.ndarray], task: Any) -> tuple[GridSet, ...]:
        """Returns the sets from the arrays of `pack`, in the chart of a task."""
        grid = Grid.from_counts(task.chart, arrays["grid_counts"])
        distances = arrays["signed_distance"]
        if len(distances) > MOST_ROWS:
            raise BadInput(f"{len(distances):,} sets are more than {MOST_ROWS:,}")
        return tuple(GridSet(grid, values) for values in distances)

    def __repr__(self) -> str:
        return f"GridSet({self.mask.mean():.1%} of {' x '.join(map(str, self.grid.counts))} nodes)"

    def signed_distance(self, z: np.ndarray) -> np.ndarray:
        return self.grid.interpolate(self.values, z)

    def __or__(self, other: GridSet) -> GridSet:
        return GridSet(self.grid, np.minimum(self.values, other.values))

    def __and__(self, other: GridSet) -> GridSet:
        return GridSet(self.grid, np.maximum(self.values, other.values))

    def __invert__(self) -> GridSet:
        return GridSet(self.grid, -self.values)

    def dilated(self, by: float) -> GridSet:
        """Returns all points within the distance `by` of the set [chart units]."""
        return GridSet(self.grid, self.values - by)

    def eroded(self, by: float) -> GridSet:
        """Returns the points of the set at least `by` from its boundary [chart units]."""
        return GridSet(self.grid, self.values + by)

    def dilated_by_box(self, half: np.ndarray) -> GridSet:
        """Returns all points z + n with z in the set and |n_i| <= half_i (d,), rounded up to nodes."""
        window = np.ceil(half / self.grid.spacing - 1e-6).astype(int)
        if not window.any():
            return self
        mask = self.mask.reshape(self.grid.counts)
        return GridSet.from_mask(self.grid, within_reach(mask, window, self.grid.chart.periodic))

    def eroded_by_box(self, half: np.ndarray) -> GridSet:
        """Returns the points z for which all z + n, |n_i| <= half_i (d,), are in the set or off the chart."""
        return ~(~self).dilated_by_box(half)

    @property
    def mask(self) -> np.ndarray:
        """Whether each node is in the set: (N,) bool."""
        return self.values <= 0

    def pieces(self) -> list[tuple[float, float]]:
        """Returns the first and last node of each piece of a set in one dimension.

        For a piece across the seam of a periodic coordinate, the last is smaller than the first.
        """
        inside, nodes = self.mask, self.grid.nodes[:, 0]
        before, after = np.roll(inside, 1), np.roll(inside, -1)
        if inside.all() or not self.grid.chart.periodic[0]:
            before[0] = after[-1] = False
        begins, ends = np.flatnonzero(inside & ~before), np.flatnonzero(inside & ~after)
        if len(ends) and ends[0] < begins[0]:
            ends = np.roll(ends, -1)
        return list(zip(nodes[begins].tolist(), nodes[ends].tolist(), strict=True))

    @cached_property
    def _nearest_inside(self) -> np.ndarray:
        """Flat index (N,) of the inner node nearest to each node."""
        from scipy import ndimage

        grid, inside = self.grid, self.mask.reshape(self.grid.counts)
        wide, middle = _unrolled(grid, inside)
        at = ndimage.distance_transform_edt(
            ~wide, sampling=grid.spacing, return_distances=False, return_indices=True
        )
        index = tuple(i[middle] - part.start for i, part in zip(at, middle, strict=True))
        return np.ravel_multi_index(index, grid.counts, mode="wrap").ravel()

    def project(self, z: np.ndarray) -> np.ndarray:
        """Returns points (n, d) of the set: z where it is inside, elsewhere the nearest inner node."""
        inside = self.contains(z)
        if inside.all() or not self.mask.any():
            return z
        nearest = self.grid.nodes[self._nearest_inside[self.grid.nearest(z)]]
        return np.where(inside[:, None], z, nearest)


def within_reach(mask: np.ndarray, window: np.ndarray, periodic: tuple[bool, ...]) -> np.ndarray:
    """Returns a mask, shaped as its grid, dilated by `window` (d,) nodes along each axis."""
    from scipy import ndimage

    reached = mask.astype(np.uint8)
    for axis, (w, wraps) in enumerate(zip(window, periodic, strict=True)):
        if w:
            n = mask.shape[axis]
            size = min(2 * w + 1, n) if wraps else 2 * min(int(w), n - 1) + 1
            mode = "wrap" if wraps else "constant"
            reached = ndimage.maximum_filter1d(reached, size, axis, mode=mode)
    return reached.astype(bool)


def _unrolled(grid: Grid, mask: np.ndarray) -> tuple[np.ndarray, tuple[slice, ...]]:
    """Returns the mask with half a period more at both ends of periodic axes, and the slices of the mask.

    The shortest way between any two nodes of the mask then runs inside.
    """
    extra = [n // 2 + 1 if p else 0 for n, p in zip(grid.counts, grid.chart.periodic, strict=True)]
    wide = np.pad(mask, [(k, k) for k in extra], mode="wrap")
    return wide, tuple(slice(k, k + n) for k, n in zip(extra, grid.counts, strict=True))
