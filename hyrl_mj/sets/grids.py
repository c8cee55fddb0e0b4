"""Grids: nodes that cover a chart, equally spaced along each coordinate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial, reduce

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.sets.chart import Chart
from hyrl_mj.sets.clouds import MOST_NODES


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
        """Returns a grid with square cells in scaled units, `cells` of them along the longest side.

        Raises:
            BadInput: it would have more than `MOST_NODES` nodes.
        """
        sides = chart.scaled_sides
        number = np.maximum(np.round(cells * sides / sides.max()).astype(int), 2)
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

    @cached_property
    def _steps(self) -> np.ndarray:
        """Distance between nodes along each coordinate (d,), in scaled units."""
        return self.spacing / self.chart.scale

    @property
    def cell(self) -> float:
        """The shortest side of a cell in scaled units: that along the coordinates that matter most."""
        return float(self._steps.min())

    @property
    def size(self) -> int:
        """N, the number of nodes."""
        return math.prod(self.counts)

    def __str__(self) -> str:
        return f"{' x '.join(map(str, self.counts))} nodes"

    @cached_property
    def nodes(self) -> np.ndarray:
        """All nodes (N, d); the last coordinate varies fastest."""
        index = np.stack([*np.indices(self.counts)], axis=-1).reshape(-1, len(self.counts))
        return self.chart.origin + self.spacing * index

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

    def corners(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the nodes (2**d, n) around points (n, d), and their weights (2**d, n) in interpolations."""
        index = self.index(z).T[:, None]
        below = index.astype(int)
        share = index - below
        weights = reduce(np.multiply, np.where(self._corners, share, 1 - share))
        # On the last node of an axis the upper corner has the weight 0: "wrap" keeps its index valid.
        nodes = np.ravel_multi_index(tuple(below + self._corners), self.counts, mode="wrap")
        return nodes, weights

    def interpolate(self, values: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Returns values at points (n, d) by multilinear interpolation of the nodes' values (N,): (n,)."""
        nodes, weights = self.corners(z)
        # The corners are added in turn: np.sum rounds differently for one point than for many.
        return reduce(np.add, weights * values[nodes])

    def around(self, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draws points (n, d) in the cells around the nodes of indices `at` (n,)."""
        nodes, chart = self.nodes[at], self.chart
        z = nodes + rng.uniform(-0.5, 0.5, nodes.shape) * self.spacing
        return np.where(chart.periodic, z, np.clip(z, chart.low, chart.high))

    def distances(self, inside: np.ndarray) -> np.ndarray:
        """Returns signed distances (N,) of the nodes `inside` (N,) bool: 0 half-way between nodes."""
        from scipy import ndimage  # slow to import

        inside = inside.reshape(self.counts)
        if inside.all() or not inside.any():
            far = float(np.linalg.norm(self.chart.scaled_sides))
            return np.full(inside.size, -far if inside.all() else far)
        wide, middle = _unrolled(self, inside)
        outward = ndimage.distance_transform_edt(~wide, sampling=self._steps)[middle]
        inward = ndimage.distance_transform_edt(wide, sampling=self._steps)[middle]
        half = self.cell / 2
        return np.asarray(np.where(inside, half - inward, outward - half).ravel())

    def widened(self, values: np.ndarray, half: np.ndarray) -> np.ndarray:
        """Returns the signed distances (N,) of a set of `values` (N,) dilated by a box of half sides (d,).

        The box is rounded up to nodes.
        """
        window = np.ceil(half / self.spacing - 1e-6).astype(int)
        if not window.any():
            return values
        mask = (values <= 0).reshape(self.counts)
        return self.distances(within_reach(mask, window, self.chart.periodic))

    def landing(self, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Returns a function from points (n, d) to the nodes (n, d) nearest to them of a set (N,)."""
        from scipy import ndimage

        wide, middle = _unrolled(self, (values <= 0).reshape(self.counts))
        at = ndimage.distance_transform_edt(
            ~wide, sampling=self._steps, return_distances=False, return_indices=True
        )
        index = tuple(i[middle] - part.start for i, part in zip(at, middle, strict=True))
        nearest = np.ravel_multi_index(index, self.counts, mode="wrap").ravel()
        return partial(self._at, nearest)

    def _at(self, chosen: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Returns the nodes (n, d) that are `chosen` (N,) for the nodes nearest to points (n, d)."""
        return np.asarray(self.nodes[chosen[self.nearest(z)]])

    def exported(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Returns what the template of an exported controller needs of a set beside its `values` (N,)."""
        return {"counts": np.array(self.counts), "spacing": self.spacing}

    def evaluation(self, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Returns the function from points (n, d) to interpolated values (n,)."""
        return partial(self.interpolate, values)

    def pack(self) -> dict[str, np.ndarray]:
        """Returns the array `grid_counts` (d,)."""
        return {"grid_counts": np.array(self.counts)}


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


def shortest_ways(
    chart: Chart,
    nodes: np.ndarray,
    neighbours: tuple[np.ndarray, np.ndarray],
    free: np.ndarray,
    ends: np.ndarray,
    farthest: float = np.inf,
    weight: np.ndarray | None = None,
) -> np.ndarray:
    """Returns the length of the shortest way from each node to the nearest of some: (N,) in scaled units.

    It is infinite where no way leads, or only one longer than `farthest`.

    Args:
        chart: measures the lengths.
        nodes: (N, d).
        neighbours: (k,), (k,) indices of nodes that lie next to each other; ways lead from one to the other.
        free: (N,) bool, the nodes that ways may lead through.
        ends: indices of the nodes where ways end.
        farthest: length beyond which ways are not followed, in scaled units.
        weight: (N,) how many times the length counts beside each node; by default once.
    """
    from scipy.sparse import csr_array  # slow to import
    from scipy.sparse.csgraph import dijkstra

    a, b = (side[free[neighbours[0]] & free[neighbours[1]]] for side in neighbours)
    lengths = chart.distance(nodes[a], nodes[b])
    if weight is not None:
        lengths *= (weight[a] + weight[b]) / 2
    graph = csr_array((lengths, (a, b)), shape=(len(nodes), len(nodes)))
    return np.asarray(dijkstra(graph, directed=False, indices=ends, min_only=True, limit=farthest))


def _unrolled(grid: Grid, mask: np.ndarray) -> tuple[np.ndarray, tuple[slice, ...]]:
    """Returns the mask with half a period more at both ends of periodic axes, and the slices of the mask.

    The shortest way between any two nodes of the mask then runs inside.
    """
    extra = [n // 2 + 1 if p else 0 for n, p in zip(grid.counts, grid.chart.periodic, strict=True)]
    wide = np.pad(mask, [(k, k) for k in extra], mode="wrap")
    return wide, tuple(slice(k, k + n) for k, n in zip(extra, grid.counts, strict=True))
