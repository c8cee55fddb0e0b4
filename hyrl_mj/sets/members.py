"""Sets in a task's chart, by their signed distance in scaled units: negative inside, positive outside."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.files.artifacts import MOST_ROWS
from hyrl_mj.sets.clouds import Cloud, evenly
from hyrl_mj.sets.grids import Grid


class StateSet(Protocol):
    """A closed set of chart points, given by its signed distance."""

    def signed_distance(self, z: np.ndarray) -> np.ndarray:
        """Returns the distance (n,) of points (n, d) to the boundary, negative inside, in scaled units."""

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


Nodes = Grid | Cloud


@dataclass(frozen=True)
class GridSet(StateSet):
    """A set given by its signed distance at the nodes of a grid or a cloud, interpolated in between.

    Attributes:
        grid: the nodes.
        values: (N,) signed distances, in scaled units.
    """

    grid: Nodes
    values: np.ndarray

    def __post_init__(self) -> None:
        if self.values.shape != (self.grid.size,):
            raise BadInput(f"{self.values.shape} distances do not fit {self.grid}")
        if not np.isfinite(self.values).all():
            raise BadInput("signed distances must be finite, and some are not")
        self.values.setflags(write=False)

    @property
    def regular(self) -> Grid:
        """The grid; raises `BadInput` for a cloud."""
        if not isinstance(self.grid, Grid):
            raise BadInput(f"a set on {self.grid} has no grid")
        return self.grid

    @staticmethod
    def from_mask(grid: Nodes, inside: np.ndarray) -> GridSet:
        """Returns the set with the nodes `inside` (N,) bool; its boundary lies half-way between nodes."""
        return GridSet(grid, grid.distances(inside))

    @staticmethod
    def pack(sets: tuple[GridSet, ...]) -> dict[str, np.ndarray]:
        """Returns sets on the same nodes as arrays: those of the nodes, and `signed_distance` (k, N)."""
        return sets[0].grid.pack() | {
            "signed_distance": np.stack([members.values for members in sets]),
        }

    @staticmethod
    def unpack(arrays: Mapping[str, np.ndarray], task: Any) -> tuple[GridSet, ...]:
        """Returns the sets from the arrays of `pack`, in the chart of a task."""
        grid: Nodes
        if "cloud_nodes" in arrays:
            grid = Cloud.unpack(task.chart, arrays)
        else:
            grid = Grid.from_counts(task.chart, arrays["grid_counts"])
        distances = arrays["signed_distance"]
        if len(distances) > MOST_ROWS:
            raise BadInput(f"{len(distances):,} sets are more than {MOST_ROWS:,}")
        return tuple(GridSet(grid, values) for values in distances)

    def __repr__(self) -> str:
        return f"GridSet({self.share:.1%} of {self.grid})"

    def signed_distance(self, z: np.ndarray) -> np.ndarray:
        names = self.grid.chart.names
        if np.ndim(z) != 2 or np.shape(z)[1] != len(names):
            raise BadInput(
                f"points of this set have shape (n, {len(names)}), {', '.join(names)}, got {np.shape(z)}: of "
                "measurements task.z(measured) gives them"
            )
        return self._evaluation(z)

    @cached_property
    def _evaluation(self) -> Callable[[np.ndarray], np.ndarray]:
        """The interpolation of the signed distance."""
        return self.grid.evaluation(self.values)

    def __or__(self, other: GridSet) -> GridSet:
        return GridSet(self.grid, np.minimum(self.values, other.values))

    def __and__(self, other: GridSet) -> GridSet:
        return GridSet(self.grid, np.maximum(self.values, other.values))

    def __invert__(self) -> GridSet:
        return GridSet(self.grid, -self.values)

    def dilated(self, by: float) -> GridSet:
        """Returns all points within the distance `by` of the set [scaled units]."""
        return GridSet(self.grid, self.values - by)

    def eroded(self, by: float) -> GridSet:
        """Returns the points of the set at least `by` from its boundary [scaled units]."""
        return GridSet(self.grid, self.values + by)

    def dilated_by_box(self, half: np.ndarray) -> GridSet:
        """Returns all points z + n with z in the set and |n_i| <= half_i (d,)."""
        wide = self.grid.widened(self.values, half)
        return self if wide is self.values else GridSet(self.grid, wide)

    def eroded_by_box(self, half: np.ndarray) -> GridSet:
        """Returns the points z for which all z + n, |n_i| <= half_i (d,), are in the set or off the chart."""
        return ~(~self).dilated_by_box(half)

    @property
    def mask(self) -> np.ndarray:
        """Whether each node is in the set: (N,) bool."""
        return self.values <= 0

    @property
    def share(self) -> float:
        """The share of the chart that lies in the set."""
        if isinstance(self.grid, Grid):
            return float(self.mask.mean())
        return float(self.contains(evenly(self.grid.chart, 4_000)).mean())

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
    def _landing(self) -> Callable[[np.ndarray], np.ndarray]:
        """The function from points outside to points of the set nearby."""
        return self.grid.landing(self.values)

    def project(self, z: np.ndarray) -> np.ndarray:
        """Returns points (n, d) of the set: z where it is inside, elsewhere one nearby."""
        inside = self.contains(z)
        if inside.all() or not self.mask.any():
            return z
        points = np.array(z, dtype=float)
        points[~inside] = self._landing(points[~inside])
        return points
