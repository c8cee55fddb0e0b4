"""Functions in affine arithmetic: bounds of NumPy's functions over boxes, and where they may be NaN."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from hyrl_mj.judging.proof.affine import (
    Affine,
    Unbounded,
    choose,
    multiply,
    negative,
    pair,
    square,
)

# ---- functions of one quantity


def smooth(
    value: Callable[[np.ndarray], np.ndarray],
    slope: Callable[[np.ndarray], np.ndarray],
    curvature: Callable[[np.ndarray, np.ndarray], np.ndarray],
    extremes: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    nowhere: Callable[[Affine], Any] = lambda a: False,
    nonnegative: bool = False,
) -> Callable[[Affine], Affine]:
    """Returns the rule of a smooth function: its tangent in the centre, or its extremes if that tells less.

    Args:
        value: the function.
        slope: its derivative.
        curvature: the largest magnitude of its second derivative between two numbers.
        extremes: the least and the greatest value between two numbers.
        nowhere: where the function of a form may be NaN though its argument is a number.
        nonnegative: whether no value is less than 0.
    """

    def rule(a: Affine) -> Affine:
        r = a.radius
        by = slope(a.centre)
        rest = np.abs(by) * a.remainder + curvature(a.low, a.high) * r * r / 2
        tangent = Affine(value(a.centre), by * a.generators, rest)
        interval = Affine.between(*extremes(a.low, a.high), len(a.generators))
        # The tangent keeps how the value depends on the box; false where it is not a number.
        keeps = rest < interval.radius
        found = choose(keeps, tangent, interval)
        return replace(found, nan=a.nan | nowhere(a), nonnegative=nonnegative)

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


sqrt = smooth(
    root,
    lambda x: 0.5 / root(x),
    lambda low, _: 0.25 * root(low) ** -3,
    rising(root),
    lambda a: ~a.positive,
    nonnegative=True,
)
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
    found = choose(across, interval, choose(a.centre < 0, negative(a), a))
    return replace(found, nan=a.nan, nonnegative=True)


def stepwise(value: Callable[[np.ndarray], np.ndarray]) -> Callable[[Affine], Affine]:
    """Returns the rule of a function that rises in steps."""

    def rule(a: Affine) -> Affine:
        found = Affine.between(value(a.low), value(a.high), len(a.generators))
        return replace(found, nan=a.nan, nonnegative=a.positive)

    return rule


# ---- functions of two quantities


def maximum(a: Affine, b: Affine) -> Affine:
    low, high = np.maximum(a.low, b.low), np.maximum(a.high, b.high)
    either = choose(a.low >= b.high, a, b)
    clear = (a.low >= b.high) | (b.low >= a.high)
    found = choose(clear, either, Affine.between(low, high, len(a.generators)))
    return replace(found, nan=a.nan | b.nan, nonnegative=a.positive | b.positive)


def minimum(a: Affine, b: Affine) -> Affine:
    found = negative(maximum(negative(a), negative(b)))
    return replace(found, nonnegative=a.positive & b.positive)


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
    found = choose(jumps | ~(tangent.radius < np.pi), anything, tangent)
    return replace(found, nan=y.nan | x.nan)


def remainder(a: Affine, b: Affine) -> Affine:
    a, b = pair(a, b)
    if b.radius.any() or not (b.centre > 0).all():
        raise Unbounded("uses np.remainder with a divisor that is not a positive constant")
    rounding = 1e-15 * (np.abs(a.centre) + a.radius + b.centre)
    nan = a.nan | a.wild
    a = a.wider(rounding)
    turns = np.floor(a.low / b.centre)
    moved = Affine(a.centre - turns * b.centre, a.generators, a.remainder)
    whole = Affine.between(
        np.zeros_like(moved.centre), b.centre + 0 * moved.centre, len(a.generators)
    )
    found = choose(turns == np.floor(a.high / b.centre), moved, whole)
    return replace(found, nan=nan, nonnegative=True)


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
    power = reduce(multiply, [square(a)] * int(abs(exponent) // 2) + [a] * int(exponent % 2))
    power = replace(power, nan=a.nan | b.nan)  # a power of a number is one, also of 0 or infinity
    return power if exponent > 0 else _reciprocal(power)
