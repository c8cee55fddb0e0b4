"""Affine arithmetic: quantities that depend on where in a box the argument lies.

A quantity that depends on a box is centre + sum_k generators[k] * s_k + rest, with |s_k| <= 1 along the k-th
side of the box and |rest| <= remainder (affine forms: Comba and Stolfi, SIBGRAPI 1993). What is linear stays
exact; a smooth function leaves a remainder of second order in the size of the box.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
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
    """

    centre: np.ndarray
    generators: np.ndarray
    remainder: np.ndarray

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

    @property
    def radius(self) -> np.ndarray:
        """The largest distance (n, ...) from the centre."""
        return np.asarray(np.abs(self.generators).sum(axis=0) + self.remainder)

    @property
    def low(self) -> np.ndarray:
        return np.asarray(self.centre - self.radius)

    @property
    def high(self) -> np.ndarray:
        return np.asarray(self.centre + self.radius)

    def each(self, change: Callable[[np.ndarray], np.ndarray]) -> Affine:
        """Returns the form with all its parts changed by a function that only moves entries."""
        d = len(self.generators)
        generators = [change(self.generators[k]) for k in range(d)]
        return Affine(change(self.centre), np.stack(generators), change(self.remainder))


def tidy(x: Affine) -> Affine:
    """Returns a form in which what is not finite has the remainder infinity."""
    sums = np.abs(x.centre) + x.radius
    if np.isfinite(sums).all():
        return x
    wild = ~np.isfinite(sums)
    return Affine(
        np.where(wild, 0.0, x.centre),
        np.where(wild, 0.0, x.generators),
        np.where(wild, np.inf, x.remainder),
    )


def lift(x: Affine, ndim: int) -> Affine:
    """Returns a form with so many dimensions that its generators broadcast like its centre."""
    if x.centre.ndim == ndim:
        return x
    shape = (1,) * (ndim - x.centre.ndim) + x.centre.shape
    return Affine(
        x.centre.reshape(shape),
        x.generators.reshape(len(x.generators), *shape),
        x.remainder.reshape(shape),
    )


def pair(a: Affine, b: Affine) -> tuple[Affine, Affine]:
    ndim = max(a.centre.ndim, b.centre.ndim)
    return lift(a, ndim), lift(b, ndim)


def choose(condition: np.ndarray, a: Affine, b: Affine) -> Affine:
    """Returns a where a condition (n, ...) holds, else b."""
    ndim = max(np.ndim(condition), a.centre.ndim, b.centre.ndim)
    a, b = lift(a, ndim), lift(b, ndim)
    return Affine(
        np.where(condition, a.centre, b.centre),
        np.where(condition, a.generators, b.generators),
        np.where(condition, a.remainder, b.remainder),
    )


# ---- arithmetic


def add(a: Affine, b: Affine) -> Affine:
    a, b = pair(a, b)
    return Affine(a.centre + b.centre, a.generators + b.generators, a.remainder + b.remainder)


def negative(a: Affine) -> Affine:
    return Affine(-a.centre, -a.generators, a.remainder)


def subtract(a: Affine, b: Affine) -> Affine:
    return add(a, negative(b))


def multiply(a: Affine, b: Affine) -> Affine:
    a, b = pair(a, b)
    return Affine(
        a.centre * b.centre,
        a.centre * b.generators + b.centre * a.generators,
        np.abs(a.centre) * b.remainder + np.abs(b.centre) * a.remainder + a.radius * b.radius,
    )


def square(a: Affine) -> Affine:
    r = a.radius
    remainder = 2 * np.abs(a.centre) * a.remainder + r * r / 2
    return Affine(a.centre**2 + r * r / 2, 2 * a.centre * a.generators, remainder)


def divide(a: Affine, b: Affine) -> Affine:
    return multiply(a, _reciprocal(b))


def raised(a: Affine, b: Affine) -> Affine:
    exponents = np.unique(b.centre)
    if b.radius.any() or len(exponents) != 1:
        raise Unbounded("uses np.power with exponents that depend on the state")
    (exponent,) = exponents
    if exponent == 0.5:
        return sqrt(a)
    if exponent != round(exponent) or not 1 <= abs(exponent) <= 16:
        raise Unbounded(f"uses np.power with the exponent {exponent:g}")
    power = reduce(multiply, [square(a)] * int(abs(exponent) // 2), _one(a))
    power = multiply(power, a) if exponent % 2 else power
    return power if exponent > 0 else _reciprocal(power)


def _one(a: Affine) -> Affine:
    return Affine(np.ones_like(a.centre), np.zeros_like(a.generators), np.zeros_like(a.centre))


def matmul(a: Affine, b: Affine) -> Affine:
    if b.radius.any() and a.radius.any():
        raise Unbounded("multiplies matrices that both depend on the state")
    if max(a.centre.ndim, b.centre.ndim) > 2:
        raise Unbounded("multiplies stacks of matrices")
    if b.radius.any():
        return Affine(a.centre @ b.centre, a.centre @ b.generators, np.abs(a.centre) @ b.remainder)
    return Affine(a.centre @ b.centre, a.generators @ b.centre, a.remainder @ np.abs(b.centre))


def total(a: Affine, axis: Any, keepdims: bool) -> Affine:
    return a.each(lambda x: x.sum(axis=axis, keepdims=keepdims))


# ---- functions of one quantity


def smooth(
    value: Callable[[np.ndarray], np.ndarray],
    slope: Callable[[np.ndarray], np.ndarray],
    curvature: Callable[[np.ndarray, np.ndarray], np.ndarray],
    extremes: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> Callable[[Affine], Affine]:
    """Returns the rule of a smooth function: its tangent in the centre, or its extremes if that tells less.

    Args:
        value: the function.
        slope: its derivative.
        curvature: the largest magnitude of its second derivative between two numbers.
        extremes: the least and the greatest value between two numbers.
    """

    def rule(a: Affine) -> Affine:
        r = a.radius
        by = slope(a.centre)
        rest = np.abs(by) * a.remainder + curvature(a.low, a.high) * r * r / 2
        tangent = Affine(value(a.centre), by * a.generators, rest)
        interval = Affine.between(*extremes(a.low, a.high), len(a.generators))
        # The tangent keeps how the value depends on the box; false where it is not a number.
        keeps = rest < interval.radius
        return choose(keeps, tangent, interval)

    return rule


def rising(value: Callable[[np.ndarray], np.ndarray]) -> Callable[..., Any]:
    return lambda low, high: (value(low), value(high))


def unit(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.full_like(low, -1.0), np.full_like(high, 1.0)


def root(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(x, 0.0))


def logarithm(x: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(x, 0.0))


def _inverse_extremes(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    across = (low <= 0) & (high >= 0)
    return np.where(across, -np.inf, 1 / high), np.where(across, np.inf, 1 / low)


sqrt = smooth(root, lambda x: 0.5 / root(x), lambda low, _: 0.25 * root(low) ** -3, rising(root))
_reciprocal = smooth(
    lambda x: 1 / x,
    lambda x: -1 / x**2,
    lambda low, high: np.where(
        low * high > 0, 2 / np.minimum(np.abs(low), np.abs(high)) ** 3, np.inf
    ),
    _inverse_extremes,
)


def absolute(a: Affine) -> Affine:
    across = (a.low < 0) & (a.high > 0)
    interval = Affine.between(
        np.zeros_like(a.centre), np.maximum(-a.low, a.high), len(a.generators)
    )
    return choose(across, interval, choose(a.centre < 0, negative(a), a))


def stepwise(value: Callable[[np.ndarray], np.ndarray]) -> Callable[[Affine], Affine]:
    """Returns the rule of a function that rises in steps."""
    return lambda a: Affine.between(value(a.low), value(a.high), len(a.generators))


# ---- functions of two quantities


def maximum(a: Affine, b: Affine) -> Affine:
    a, b = pair(a, b)
    low, high = np.maximum(a.low, b.low), np.maximum(a.high, b.high)
    either = choose(a.low >= b.high, a, b)
    clear = (a.low >= b.high) | (b.low >= a.high)
    return choose(clear, either, Affine.between(low, high, len(a.generators)))


def minimum(a: Affine, b: Affine) -> Affine:
    return negative(maximum(negative(a), negative(b)))


def arctan2(y: Affine, x: Affine) -> Affine:
    y, x = pair(y, x)
    square = x.centre**2 + y.centre**2
    near = np.hypot(
        np.maximum(np.abs(x.centre) - x.radius, 0), np.maximum(np.abs(y.centre) - y.radius, 0)
    )
    by_y, by_x = x.centre / square, -y.centre / square
    rest = np.abs(by_y) * y.remainder + np.abs(by_x) * x.remainder
    rest = rest + (x.radius**2 + y.radius**2) / (2 * near**2)
    tangent = Affine(
        np.arctan2(y.centre, x.centre), by_y * y.generators + by_x * x.generators, rest
    )
    # The angle jumps where y changes its sign and x is negative.
    jumps = (x.low <= 0) & (y.low <= 0) & (y.high >= 0)
    anything = Affine.between(
        np.full_like(square, -np.pi), np.full_like(square, np.pi), len(x.generators)
    )
    return choose(jumps | ~(tangent.radius < np.pi), anything, tangent)


def remainder(a: Affine, b: Affine) -> Affine:
    a, b = pair(a, b)
    if b.radius.any() or not (b.centre > 0).all():
        raise Unbounded("uses np.remainder with a divisor that is not a positive constant")
    rounding = 1e-15 * (np.abs(a.centre) + a.radius + b.centre)
    a = Affine(a.centre, a.generators, a.remainder + rounding)
    turns = np.floor(a.low / b.centre)
    moved = Affine(a.centre - turns * b.centre, a.generators, a.remainder)
    whole = Affine.between(
        np.zeros_like(moved.centre), b.centre + 0 * moved.centre, len(a.generators)
    )
    return choose(turns == np.floor(a.high / b.centre), moved, whole)
