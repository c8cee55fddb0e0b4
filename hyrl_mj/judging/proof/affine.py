"""Affine arithmetic: quantities that depend on where in a box the argument lies.

A quantity that depends on a box is centre + sum_k generators[k] * s_k + rest, with |s_k| <= 1 along the k-th
side of the box and |rest| <= remainder (affine forms: Comba and Stolfi, SIBGRAPI 1993). What is linear stays
exact; a smooth function leaves a remainder of second order in the size of the box.

A form bounds the numbers that NumPy computes. Whether NumPy may also give NaN somewhere in the box, as for
the square root of a negative number, stands beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np


class Unbounded(Exception):
    """Code cannot be bounded; the text completes "it ..."."""


@dataclass(frozen=True, eq=False)
class Affine:
    """An array of quantities that depend on the boxes.

    Attributes:
        centre: (n, ...) values in the middle of the boxes.
        generators: (d, n, ...) by how much half a side of the box changes them.
        remainder: (n, ...) >= 0, everything else.
        nan: (n, ...) bool, whether NumPy may give NaN somewhere in the box.
        nonnegative: (n, ...) bool, whether the quantity is known to be >= 0 where it is a number, even where
            its lower bound is less: a square, say.
    """

    centre: np.ndarray
    generators: np.ndarray
    remainder: np.ndarray
    nan: Any = False
    nonnegative: Any = False

    def __post_init__(self) -> None:
        shape = np.shape(self.centre)
        for name in ("nan", "nonnegative"):
            object.__setattr__(self, name, np.broadcast_to(getattr(self, name), shape))

    @staticmethod
    def box(centre: np.ndarray, half: np.ndarray) -> Affine:
        """Returns the points (n, d) of boxes with these centres (n, d) and half sides (d,) or (n, d)."""
        d = centre.shape[1]
        generators = np.eye(d)[:, None, :] * np.broadcast_to(half, centre.shape)
        return Affine(centre, generators, np.zeros(centre.shape))

    @staticmethod
    def between(low: np.ndarray, high: np.ndarray, d: int) -> Affine:
        """Returns quantities of which only lower and upper bounds (n, ...) are known."""
        with np.errstate(invalid="ignore"):
            centre, remainder = (low + high) / 2, (high - low) / 2
        return tidy(Affine(centre, np.zeros((d, *np.shape(centre))), remainder))

    @cached_property
    def radius(self) -> np.ndarray:
        """The largest distance (n, ...) from the centre."""
        return np.asarray(np.abs(self.generators).sum(axis=0) + self.remainder)

    @property
    def low(self) -> np.ndarray:
        return np.asarray(self.centre - self.radius)

    @property
    def high(self) -> np.ndarray:
        return np.asarray(self.centre + self.radius)

    @property
    def wild(self) -> np.ndarray:
        """Where it may be infinite: (n, ...) bool."""
        return ~np.isfinite(self.centre) | np.isinf(self.remainder)

    @property
    def positive(self) -> np.ndarray:
        """Where it is surely >= 0, or NaN: (n, ...) bool."""
        return self.nonnegative | (self.low >= 0)

    @property
    def may_vanish(self) -> np.ndarray:
        """Where it may be 0: (n, ...) bool."""
        return (self.low <= 0) & (self.high >= 0)

    def wider(self, by: np.ndarray) -> Affine:
        """Returns the form with a larger remainder."""
        return replace(self, remainder=self.remainder + by)


def rearranged(change: Callable[..., np.ndarray], *forms: Affine) -> Affine:
    """Returns the form whose parts are those of forms, changed by a function that only moves entries."""
    generators = [change(*parts) for parts in zip(*(x.generators for x in forms), strict=True)]
    centre, *others = (
        change(*(getattr(x, name) for x in forms))
        for name in ("centre", "remainder", "nan", "nonnegative")
    )
    return Affine(centre, np.stack(generators), *others)


def tidy(x: Affine) -> Affine:
    """Returns a form in which what is not finite has the remainder infinity."""
    wild = ~np.isfinite(np.abs(x.centre) + x.radius)
    if not wild.any():
        return x
    return replace(
        x,
        centre=np.where(wild, 0.0, x.centre),
        generators=np.where(wild, 0.0, x.generators),
        remainder=np.where(wild, np.inf, x.remainder),
    )


def pair(a: Affine, b: Affine) -> tuple[Affine, Affine]:
    """Returns forms with so many dimensions that their generators broadcast like their centres."""
    ndim = max(a.centre.ndim, b.centre.ndim)
    a, b = (
        rearranged(lambda part: part.reshape((1,) * (ndim - part.ndim) + part.shape), x)
        for x in (a, b)
    )
    return a, b


def choose(condition: np.ndarray, a: Affine, b: Affine) -> Affine:
    """Returns a where a condition (n, ...) holds, else b."""
    return rearranged(lambda x, y: np.asarray(np.where(condition, x, y)), a, b)


# ---- arithmetic


def add(a: Affine, b: Affine) -> Affine:
    a, b = pair(a, b)
    return Affine(
        a.centre + b.centre,
        a.generators + b.generators,
        a.remainder + b.remainder,
        a.nan | b.nan | (a.wild & b.wild),  # infinity minus infinity
        a.positive & b.positive,
    )


def negative(a: Affine) -> Affine:
    return Affine(-a.centre, -a.generators, a.remainder, a.nan)


def subtract(a: Affine, b: Affine) -> Affine:
    return add(a, negative(b))


def multiply(a: Affine, b: Affine) -> Affine:
    a, b = pair(a, b)
    return Affine(
        a.centre * b.centre,
        a.centre * b.generators + b.centre * a.generators,
        np.abs(a.centre) * b.remainder + np.abs(b.centre) * a.remainder + a.radius * b.radius,
        a.nan | b.nan | (a.wild & b.may_vanish) | (a.may_vanish & b.wild),  # 0 times infinity
        a.positive & b.positive,
    )


def square(a: Affine) -> Affine:
    r = a.radius
    remainder = 2 * np.abs(a.centre) * a.remainder + r * r / 2
    return Affine(a.centre**2 + r * r / 2, 2 * a.centre * a.generators, remainder, a.nan, True)


def matmul(a: Affine, b: Affine) -> Affine:
    if b.radius.any() and a.radius.any():
        raise Unbounded("multiplies matrices that both depend on the state")
    if max(a.centre.ndim, b.centre.ndim) > 2:
        raise Unbounded("multiplies stacks of matrices")
    # Whatever is no number, or infinite and perhaps multiplied by 0, spoils all sums that it is in.
    spoils_a, spoils_b = ((x.nan | x.wild).astype(float) for x in (a, b))
    nan = spoils_a @ np.ones_like(b.centre) + np.ones_like(a.centre) @ spoils_b > 0
    if b.radius.any():
        rest = np.abs(a.centre) @ b.remainder
        return Affine(a.centre @ b.centre, a.centre @ b.generators, rest, nan)
    rest = a.remainder @ np.abs(b.centre)
    return Affine(a.centre @ b.centre, a.generators @ b.centre, rest, nan)


def total(a: Affine, axis: Any, keepdims: bool) -> Affine:
    options = {"axis": axis, "keepdims": keepdims}
    return Affine(
        a.centre.sum(**options),
        np.stack([part.sum(**options) for part in a.generators]),
        a.remainder.sum(**options),
        (a.nan | a.wild).any(**options),
        a.positive.all(**options),
    )
