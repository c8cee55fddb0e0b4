"""Clouds: scattered nodes that cover a chart of many dimensions, dense where its sets have their edges."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.sets import planes
from hyrl_mj.sets.chart import Chart

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# The runs from more nodes than this do not fit into the memory of a small machine.
MOST_NODES = 2**19
# Nodes that a plane is fitted to, and between which distances are interpolated, a dimension.
LINKS, BLENDED = 8, 3
# Neighbours a dimension: the pairs that a search for decisions goes through.
NEIGHBOURS = 2
# Least distance of a point from a node, and least weight of a node, as shares.
LEAST = 1e-9  # also in the template of an exported controller


@dataclass(frozen=True)
class Cloud:
    """Scattered nodes of a chart, in the place of a `Grid`.

    A set is given by signed distances at the nodes. Between nodes inside and nodes outside it, its edge is
    taken for a plane: so few nodes as six dimensions allow tell well on which side of it a point lies, and
    badly how far away the next node is.

    Attributes:
        chart: the chart.
        nodes: (N, d) the nodes.
        shares: (d,) share of the noise bound that acts on each coordinate; points are moved along noisy ones.
        cell: how finely the nodes resolve a set's edge, in scaled units.
    """

    chart: Chart
    nodes: np.ndarray
    shares: np.ndarray
    cell: float

    def __post_init__(self) -> None:
        n, d = len(self.nodes), self.chart.dimension
        if self.nodes.shape != (n, d) or self.shares.shape != (d,):
            raise BadInput(
                f"nodes of shape {self.nodes.shape} with shares of shape {self.shares.shape} do not fit "
                f"chart {self.chart.names}"
            )
        if not LINKS * d < n <= MOST_NODES:
            raise BadInput(
                f"a cloud of {n:,} nodes cannot be used: give more than {LINKS * d}, and at most "
                f"{MOST_NODES:,}"
            )
        finite = all(np.isfinite(a).all() for a in (self.nodes, self.shares, self.cell))
        if not finite or (self.shares < 0).any() or not self.cell > 0:
            raise BadInput("a cloud's nodes have to be finite, its shares >= 0, and its cell > 0")

    @staticmethod
    def even(chart: Chart, count: int, shares: np.ndarray) -> Cloud:
        """Returns `count` nodes that cover a chart evenly, always the same."""
        nodes = evenly(chart, count)
        side = float(np.prod(chart.scaled_sides) / count) ** (1 / chart.dimension)
        return Cloud(chart, nodes, np.asarray(shares, dtype=float), side / 2)

    def beside(self, points: np.ndarray, count: int, reach: np.ndarray, cell: float) -> Cloud:
        """Returns this cloud with more nodes on both sides of points of M*, along the noisy coordinates.

        Args:
            points: (k, d) of M*.
            count: number of the new nodes; points are left out, evenly, if there are more than half as many.
            reach: (d,) how far away the farthest of them lie, along each coordinate.
            cell: how far away the nearest of them lie, in scaled units.
        """
        rng, chart = np.random.default_rng(0), self.chart
        chosen = points[rng.permutation(len(points))]
        chosen = chosen[np.arange(max(count // 2, 1)) % len(points)]
        away = rng.normal(size=chosen.shape) * (reach > 0)
        away /= np.maximum(
            np.abs(away / np.maximum(reach, 1e-300)).max(axis=1, keepdims=True), 1e-9
        )
        away[:, reach == 0] = 0.0
        least = cell / max(float((reach / chart.scale).max()), cell)
        away *= least ** rng.uniform(0, 1, (len(chosen), 1))
        nodes = np.vstack([self.nodes, chosen + away, chosen - away])
        nodes = np.where(chart.periodic, chart.wrap(nodes), np.clip(nodes, chart.low, chart.high))
        nodes = np.unique(nodes, axis=0)
        return Cloud(chart, nodes, self.shares, cell)

    @staticmethod
    def unpack(chart: Chart, arrays: Mapping[str, np.ndarray]) -> Cloud:
        """Returns the cloud from the arrays of `pack`."""
        nodes, shares = (np.array(arrays[f"cloud_{k}"], dtype=float) for k in ("nodes", "shares"))
        return Cloud(chart, nodes, shares, float(arrays["cloud_cell"]))

    def pack(self) -> dict[str, np.ndarray]:
        """Returns the arrays `cloud_nodes` (N, d), `cloud_shares` (d,) and `cloud_cell`."""
        cell = np.array(self.cell)
        return {"cloud_nodes": self.nodes, "cloud_shares": self.shares, "cloud_cell": cell}

    def __str__(self) -> str:
        return f"{self.size:,} scattered nodes"

    @property
    def size(self) -> int:
        """N, the number of nodes."""
        return len(self.nodes)

    @cached_property
    def spacing(self) -> np.ndarray:
        """Distance between nodes far from M* along each coordinate (d,), if they lay on a grid."""
        side = float(np.prod(self.chart.scaled_sides) / self.size) ** (1 / self.chart.dimension)
        return side * np.array(self.chart.scale)

    @cached_property
    def _tree(self) -> cKDTree:
        """The search tree of the nodes, for `_scaled` points; one without periods is faster."""
        from scipy.spatial import cKDTree  # slow to import

        if any(self.chart.periodic):
            return self.chart.tree(self.nodes)
        return cKDTree(self._scaled(self.nodes))

    def _scaled(self, z: np.ndarray) -> np.ndarray:
        """Returns points (n, d) in the coordinates of the search tree."""
        return self.chart.in_box(z) if any(self.chart.periodic) else z / self.chart.scale

    @cached_property
    def _links(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N, k) and index (N, k) of the nodes nearest to each node."""
        k = LINKS * self.chart.dimension
        distance, index = self._tree.query(self._scaled(self.nodes), k + 1)
        # A node is its own nearest, unless another one lies on it.
        return distance[:, 1:], index[:, 1:]

    def nearest(self, z: np.ndarray) -> np.ndarray:
        """Returns the indices (n,) of the nodes nearest to points (n, d)."""
        return np.asarray(self._tree.query(self._scaled(z))[1])

    def neighbours(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns pairs of close nodes, as indices (k,), (k,)."""
        near = self._links[1][:, : NEIGHBOURS * self.chart.dimension]
        pairs = np.stack([np.repeat(np.arange(self.size), near.shape[1]), near.ravel()])
        first, second = np.unique(np.sort(pairs, axis=0), axis=1)
        return first, second

    def around(self, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draws points (n, d) between the nodes of indices `at` (n,) and their neighbours."""
        near = self._links[1][at, rng.integers(NEIGHBOURS * self.chart.dimension, size=len(at))]
        share = rng.uniform(0, 0.5, (len(at), 1))
        away = self.chart.difference(self.nodes[near], self.nodes[at])
        return self.chart.wrap(self.nodes[at] + share * away)

    # ---- signed distances

    def _offsets(self, at: np.ndarray, to: np.ndarray) -> np.ndarray:
        """Returns the scaled differences (..., d) from points `at` to points `to`."""
        return self.chart.difference(to, at) / self.chart.scale

    def slopes(self, values: np.ndarray) -> np.ndarray:
        """Returns the slopes (N, d) of values (N,) at the nodes, in scaled units."""
        distance, index = self._links
        found = np.empty(self.nodes.shape)
        for part in planes.batches(self.size):
            x = self._offsets(self.nodes[part, None], self.nodes[index[part]])
            rises = values[index[part]] - values[part, None]
            found[part] = planes.slopes(x, rises, planes.closeness(distance[part]))
        return found

    def _blended(self, values: np.ndarray, slopes: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Returns values (n,) at points (n, d) from those of the nodes nearby and their slopes (N, d).

        Each node continues its value along its slope, and counts by its closeness (Shepard's method).
        """
        return self._continued(values, slopes, z)[0]

    def _continued(
        self, values: np.ndarray, slopes: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns values (n,) as `_blended`, and slopes (n, d), at points (n, d)."""
        value, slope = np.empty(len(z)), np.empty(np.shape(z))
        for part in planes.batches(len(z)):
            distance, index = self._tree.query(
                self._scaled(z[part]), BLENDED * self.chart.dimension
            )
            # The farthest has no weight, so that values do not jump where another one takes its place.
            radius = distance[:, -1:]
            weight = np.maximum(radius - distance, 0) / np.maximum(distance, LEAST * radius)
            weight = weight**2 + LEAST
            weight /= weight.sum(axis=1, keepdims=True)
            away, steep = self._offsets(self.nodes[index], z[part, None]), slopes[index]
            at = values[index] + np.einsum("nkd,nkd->nk", steep, away)
            value[part] = np.einsum("nk,nk->n", weight, at)
            slope[part] = np.einsum("nk,nkd->nd", weight, steep)
        return value, slope

    def exported(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Returns what the template of an exported controller needs of a set beside its `values` (N,)."""
        count = np.array(BLENDED * self.chart.dimension)
        return {"nodes": self.nodes, "slopes": self.slopes(values), "nearest": count}

    def evaluation(self, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Returns the function from points (n, d) to interpolated values (n,)."""
        return partial(self._blended, values, self.slopes(values))

    def distances(self, inside: np.ndarray) -> np.ndarray:
        """Returns signed distances (N,) of the nodes `inside` (N,) bool: of their edge with the others.

        Where nodes inside and outside lie close together, their edge is the plane that separates them best.
        """
        if inside.all() or not inside.any():
            far = float(np.linalg.norm(self.chart.scaled_sides))
            return np.full(self.size, -far if inside.all() else far)
        sign = np.where(inside, -1.0, 1.0)
        other = np.empty(self.size)  # the distance from the nearest node on the other side
        for side in (inside, ~inside):
            other[side], _ = self.chart.nearest(self.nodes[~side], self.nodes[side])
        mixed = np.flatnonzero((inside[self._links[1]] != inside[:, None]).any(axis=1))
        value, normal = self._planes(mixed, sign)
        # Other nodes see the plane of the nearest of these.
        if len(mixed):
            _, at = self.chart.nearest(self.nodes[mixed], self.nodes)
            away = self._offsets(self.nodes[mixed[at]], self.nodes)
            depth = sign * (value[at] + (normal[at] * away).sum(axis=1))
        else:
            depth = other
        least = np.minimum(self.cell, other) / 20
        return np.asarray(sign * np.clip(depth, least, other))

    def _planes(self, at: np.ndarray, sign: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Separates nodes of sign -1 from nodes of sign +1 (N,) around nodes `at` (k,) by planes.

        Returns:
            The signed distances (k,) of the nodes from their planes, and the unit normals (k, d).
        """
        distance, index = (array[at] for array in self._links)
        value, normal = np.empty(len(at)), np.empty((len(at), self.chart.dimension))
        for part in planes.batches(len(at)):
            near = np.hstack([at[part, None], index[part]])
            radius = distance[part, -1:]
            x = self._offsets(self.nodes[at[part], None], self.nodes[near]) / radius[..., None]
            weight = np.hstack([np.ones_like(radius), planes.closeness(distance[part])])
            value[part], normal[part] = planes.separating(x, sign[near], weight)
            value[part] *= radius[:, 0]
        return value, normal

    def widened(self, values: np.ndarray, half: np.ndarray) -> np.ndarray:
        """Returns the signed distances (N,) of a set of `values` (N,) dilated by a box of half sides (d,)."""
        if not np.any(half):
            return values
        slopes = self.slopes(values)
        steep = np.linalg.norm(slopes, axis=1)
        # Of a distance the slope is 1; between planes it comes out as less.
        slopes = slopes / np.where(steep > 0, steep, 1.0)[:, None]
        return np.asarray(values - np.abs(slopes) @ (half / self.chart.scale))

    def landing(self, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Returns a function from points (n, d) to points (n, d) of a set (N,) near them.

        They are reached along the noisy coordinates where that is possible; else they are nodes.
        """
        inside = self.nodes[values <= 0]
        return partial(self._land, values, self.slopes(values), inside, self.chart.tree(inside))

    def _land(
        self,
        values: np.ndarray,
        slopes: np.ndarray,
        inside: np.ndarray,
        tree: cKDTree,
        z: np.ndarray,
    ) -> np.ndarray:
        """Returns points (n, d) of a set, given by values and slopes at all nodes and by the nodes inside."""
        chart, points, left = self.chart, z.copy(), np.arange(len(z))
        along = self.shares / chart.scale
        for _ in range(4):
            value, slope = self._continued(values, slopes, points[left])
            outside = value > 0
            left, value, slope = left[outside], value[outside, None], slope[outside] * along
            if not len(left):
                return points
            # Where the slope is gentle the step is cut short; it leads a tenth of a cell into the set.
            size = np.maximum((slope**2).sum(axis=1, keepdims=True), 0.01)
            step = (value + 0.1 * self.cell) * slope / size * self.shares
            moved = points[left] - step
            points[left] = np.where(chart.periodic, moved, np.clip(moved, chart.low, chart.high))
        left = left[self._blended(values, slopes, points[left]) > 0]
        if len(left):
            points[left] = inside[tree.query(chart.in_box(z[left]))[1]]
        return points


def evenly(chart: Chart, count: int) -> np.ndarray:
    """Returns `count` points (count, d) that cover a chart evenly: Roberts' sequence of low discrepancy."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (chart.dimension + 1))
    steps = ratio ** -np.arange(1.0, chart.dimension + 1)
    places = (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0
    return np.asarray(chart.origin + places * chart.sides)
