"""Charts: the coordinates in which decisions fall, some of them on a circle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.errors import BadInput, counted, has_controls

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


LONGEST = 80  # characters of a name


@dataclass(frozen=True)
class Chart:
    """The coordinates z in which the critical set and all sets live.

    Attributes:
        names: one a coordinate.
        units: one a coordinate.
        low, high: (d,) ends of the charted box; for a periodic coordinate one period.
        periodic: (d,) whether a coordinate lives on a circle.
        section: of a chart that is cut out of a larger one, where: "heading = 0 rad".
        scale: (d,) by how much a coordinate changes over a distance of one: all distances are between points
            divided by it. By default 1 each. Sensible is the share of the noise bound that acts on it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    periodic: tuple[bool, ...]
    section: str = ""
    scale: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("names", "units", "low", "high", "periodic", "scale"):
            # Charts are compared, and are keys: arrays and lists are taken as tuples.
            if isinstance(values := getattr(self, name), np.ndarray | list):
                object.__setattr__(self, name, tuple(np.asarray(values).tolist()))
        for name in (*self.names, *self.units, self.section):
            if len(str(name)) > LONGEST or has_controls(str(name)):
                raise BadInput(
                    f"a coordinate cannot have the name or the unit {str(name)[:LONGEST]!r}: give at most "
                    f"{LONGEST} characters that can be printed"
                )
        if not len(self.scale):
            object.__setattr__(self, "scale", (1.0,) * len(self.names))

    @property
    def dimension(self) -> int:
        return len(self.names)

    @property
    def unit(self) -> str:
        """The unit of distances: that of the coordinates with scale 1."""
        own = dict.fromkeys(u for u, s in zip(self.units, self.scale, strict=True) if s == 1)
        return ", ".join(own) or "scaled units"

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Returns random points (n, d) all over the charted box."""
        return rng.uniform(self.low, self.high, (n, self.dimension))

    @cached_property
    def origin(self) -> np.ndarray:
        """The lower ends (d,), as an array."""
        return np.array(self.low)

    @cached_property
    def sides(self) -> np.ndarray:
        """Length of the charted box along each coordinate (d,)."""
        return np.subtract(self.high, self.low)

    @cached_property
    def scaled_sides(self) -> np.ndarray:
        """Length of the charted box along each coordinate (d,), in scaled units."""
        return self.sides / self.scale

    def wrap(self, z: np.ndarray) -> np.ndarray:
        """Returns points (n, d) with periodic coordinates brought into [low, high); z itself without any."""
        if not any(self.periodic):
            return z
        turned = np.mod(z - self.origin, self.sides)
        # The remainder of a tiny negative number rounds up to the period itself.
        turned = np.where(turned < self.sides, turned, 0.0)
        return np.where(self.periodic, self.origin + turned, z)

    def difference(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Returns a - b (n, d), the short way round in periodic coordinates."""
        delta = np.subtract(a, b)
        return np.where(self.periodic, delta - self.sides * np.round(delta / self.sides), delta)

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Returns how far points a and b (..., d) are apart (...), the short way round, in scaled units."""
        return np.asarray(np.linalg.norm(self.difference(a, b) / self.scale, axis=-1))

    def near(self, z: np.ndarray, to: np.ndarray) -> np.ndarray:
        """Returns points z (n, d) with periodic coordinates brought next to points `to` (n, d)."""
        if not any(self.periodic):
            return z
        turns = np.round(np.subtract(to, z) / self.sides)
        return np.where(self.periodic, z + turns * self.sides, z)

    def contains(self, z: np.ndarray) -> np.ndarray:
        """Returns (n,) bool: whether points (n, d) lie in the charted box."""
        inside = (z >= self.low) & (z <= self.high)
        return np.asarray((inside | self.periodic).all(axis=-1))

    def check(self, z: ArrayLike, owner: str) -> np.ndarray:
        """Returns points as a float array (n, d); `owner` names the task in messages.

        Raises:
            BadInput: wrong shape, not finite, or outside the chart.
        """
        wanted = f"{owner} is {counted(self.dimension, 'number')} ({', '.join(self.names)})"
        try:
            z = np.atleast_2d(np.asarray(z, dtype=float))
        except (TypeError, ValueError):
            raise BadInput(f"a state of {wanted}, got {z!r}") from None
        if z.size == 0:
            raise BadInput(f"no start is given: a state of {wanted}")
        if z.ndim != 2 or z.shape[1] != self.dimension:
            got = z.shape[1] if z.ndim == 2 else f"shape {z.shape}"
            raise BadInput(f"a state of {wanted}, got {got}")
        bad = ~(np.isfinite(z).all(axis=1) & self.contains(z))
        if bad.any():
            axes = zip(self.names, self.units, self.low, self.high, strict=True)
            sides = [f"{low:g} <= {name} <= {high:g} {unit}" for name, unit, low, high in axes]
            box = ", ".join(s for s, wraps in zip(sides, self.periodic, strict=True) if not wraps)
            raise BadInput(
                f"state {np.argmax(bad)} ({self.format(z[bad][0])}) is outside {owner}: "
                f"{box or 'give finite numbers'}"
            )
        return z

    def tree(self, points: np.ndarray) -> cKDTree:
        """Returns a search tree of points (n, d) that heeds periods and scale; query it with `in_box`."""
        from scipy.spatial import cKDTree  # slow to import

        # Coordinates that are not periodic get a box so large that its other side is never near.
        size = np.where(self.periodic, self.scaled_sides, 1e6 * self.scaled_sides)
        return cKDTree(self.in_box(points), boxsize=size)

    def nearest(
        self, points: np.ndarray, z: np.ndarray, count: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns distance and index, (n,) or (n, count), of those of points (N, d) nearest to z (n, d)."""
        distance, index = self.tree(points).query(self.in_box(z), count)
        return distance, index

    def in_box(self, z: np.ndarray) -> np.ndarray:
        """Returns points (n, d) in the coordinates of `tree`, which are scaled and never negative."""
        inside = self.wrap(z) - self.origin + np.where(self.periodic, 0.0, 1e3 * self.sides)
        turned = inside / self.scale
        # Rounding may bring a point just below a period onto it.
        return np.where(self.periodic & (turned >= self.scaled_sides), 0.0, turned)

    def format(self, z: np.ndarray) -> str:
        """Returns the text of a point (d,): "x = 0.1 m, y = -0.2 m"."""
        return ", ".join(
            f"{n} = {v:.4g} {u}" for n, v, u in zip(self.names, z, self.units, strict=True)
        )
