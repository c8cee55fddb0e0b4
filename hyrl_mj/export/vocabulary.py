"""The operations that NumPy code is reduced to, and other functions of NumPy put together from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

# Rows of the batch that goes through the code while it is followed. A dimension of this size is taken for
# that of the batch, so it is a number that nothing else has.
BATCH = 1009
# Elementwise functions of NumPy that ONNX has, and their names there.
ELEMENTWISE = {
    "absolute": "Abs", "negative": "Neg", "sign": "Sign", "sqrt": "Sqrt", "exp": "Exp", "log": "Log",
    "sin": "Sin", "tanh": "Tanh", "floor": "Floor", "ceil": "Ceil", "rint": "Round",
    "add": "Add", "subtract": "Sub", "multiply": "Mul", "divide": "Div", "power": "Pow",
    "matmul": "MatMul", "maximum": "Max", "minimum": "Min", "isnan": "IsNaN", "logical_not": "Not",
    "logical_and": "And", "logical_or": "Or", "logical_xor": "Xor", "equal": "Equal",
    "greater": "Greater", "greater_equal": "GreaterOrEqual", "less": "Less", "less_equal": "LessOrEqual",
}  # fmt: skip
UFUNCS = {*ELEMENTWISE, "cos", "arctan2", "remainder"}
REDUCTIONS = ("sum", "max", "min", "any", "all", "argmax", "argmin")


class Untraceable(Exception):
    """Code does what cannot be followed; the text completes "it ..."."""


def _prod(x: Any, axis: Any = None, keepdims: bool = False) -> Any:
    """One factor after the other: older versions of onnxruntime have no product in float64."""
    if np.ndim(axis) or (axis is None and x.ndim > 1):
        raise Untraceable("uses np.prod other than along one axis")
    axis = axis or 0
    if x.shape[axis] == BATCH:
        raise Untraceable("uses np.prod over the rows of a batch: each must stand for itself")
    factors = (np.take(x, np.array([i]), axis=axis) for i in range(x.shape[axis]))
    product = reduce(np.multiply, factors)
    return product if keepdims else np.squeeze(product, axis=axis)


def _mean(x: Any, axis: Any = None, keepdims: bool = False) -> Any:
    total = np.sum(x, axis=axis, keepdims=keepdims)
    return total * float(np.prod(total.shape) / np.prod(x.shape))


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    if ord not in (None, 2) or (axis is None and x.ndim > 1) or np.ndim(axis):
        raise Untraceable("uses np.linalg.norm other than the Euclidean one along one axis")
    return np.sqrt(np.sum(x * x, axis=axis, keepdims=keepdims))


def _swapaxes(x: Any, first: int, second: int) -> Any:
    axes = list(range(x.ndim))
    axes[first], axes[second] = axes[second], axes[first]
    return np.transpose(x, axes)


def _expand_dims(x: Any, axis: int) -> Any:
    item: list[Any] = [slice(None)] * np.ndim(x)
    item.insert(axis % (len(item) + 1), None)
    return (x if hasattr(x, "shape") else np.array(x))[tuple(item)]


def _squeeze(x: Any, axis: Any = None) -> Any:
    axes = np.flatnonzero(np.array(x.shape) == 1) if axis is None else np.atleast_1d(axis) % x.ndim
    return x[tuple(0 if a in axes else slice(None) for a in range(x.ndim))]


def _stack(parts: Sequence[Any], axis: int = 0) -> Any:
    axis %= np.ndim(parts[0]) + 1
    return np.concatenate([_expand_dims(part, axis) for part in parts], axis=axis)


def _at_least_2d(x: Any, new_axis: int = 0) -> Any:
    return x if np.ndim(x) > 1 else _expand_dims(x, new_axis)


def _clip(x: Any, a_min: Any = None, a_max: Any = None, *, min: Any = None, max: Any = None) -> Any:
    low, high = a_min if min is None else min, a_max if max is None else max
    x = x if low is None else np.maximum(x, low)
    return x if high is None else np.minimum(x, high)


def _select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0) -> Any:
    pairs = reversed(list(zip(conditions, choices, strict=True)))
    return reduce(lambda other, pair: np.where(pair[0], pair[1], other), pairs, default)


def _diff(x: Any, axis: int = -1) -> Any:
    indices = np.arange(x.shape[axis])
    return np.take(x, indices[1:], axis=axis) - np.take(x, indices[:-1], axis=axis)


def _round(x: Any, decimals: int = 0) -> Any:
    return np.rint(x * 10.0**decimals) / 10.0**decimals if decimals else np.rint(x)


def _erf(x: Any) -> Any:
    """SciPy's error function within 2e-7 (Abramowitz and Stegun, 7.1.26); NumPy and ONNX have none."""
    t = 1 / (1 + 0.3275911 * np.absolute(x))
    factors = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)
    polynomial = reduce(lambda rest, factor: (rest + factor) * t, factors, 0.0)
    return np.sign(x) * (1 - polynomial * np.exp(-x * x))


def _of_bools(logical: np.ufunc, *operands: Any) -> Any:
    """An operation on bits, for operands that are bool."""
    if any(np.dtype(getattr(o, "dtype", type(o))) != bool for o in operands):
        raise Untraceable("works on the bits of numbers")
    return logical(*operands)


# By the functions themselves, elementwise ones by their names: SciPy has some of these, too.
COMPOSED: dict[Any, Callable[..., Any]] = {
    np.mean: _mean,
    np.prod: _prod,
    np.linalg.norm: _norm,
    np.ravel: lambda x: np.reshape(x, -1),
    np.stack: _stack,
    np.hstack: lambda parts: np.concatenate(parts, axis=1 if np.ndim(parts[0]) > 1 else 0),
    np.vstack: lambda parts: np.concatenate([_at_least_2d(p) for p in parts]),
    np.column_stack: lambda parts: np.concatenate([_at_least_2d(p, 1) for p in parts], axis=1),
    np.atleast_1d: lambda x: x,
    np.atleast_2d: _at_least_2d,
    np.expand_dims: _expand_dims,
    np.squeeze: _squeeze,
    np.swapaxes: _swapaxes,
    np.clip: _clip,
    np.select: _select,
    np.diff: _diff,
    np.dot: lambda x, y: x @ y,
    np.zeros_like: lambda x, dtype=None: np.full_like(x, 0, dtype=dtype),
    np.empty_like: lambda x, dtype=None: np.full_like(x, 0, dtype=dtype),
    np.ones_like: lambda x, dtype=None: np.full_like(x, 1, dtype=dtype),
    np.round: _round,
    np.shape: lambda x: x.shape,
    np.ndim: lambda x: x.ndim,
    "positive": np.copy,
    "not_equal": lambda x, y: np.logical_not(np.equal(x, y)),
    "isfinite": lambda x: np.absolute(x) < np.inf,
    "tan": lambda x: np.sin(x) / np.cos(x),
    # As an angle of a point: onnxruntime has these functions in float32 alone.
    "arctan": lambda x: np.arctan2(x, 1),
    "arcsin": lambda x: np.arctan2(x, np.sqrt((1 - x) * (1 + x))),
    "arccos": lambda x: np.arctan2(np.sqrt((1 - x) * (1 + x)), x),
    "fabs": np.absolute,
    "square": lambda x: x * x,
    "reciprocal": lambda x: 1 / x,
    "hypot": lambda x, y: np.sqrt(x * x + y * y),
    "radians": lambda x: x * (np.pi / 180),
    "deg2rad": lambda x: x * (np.pi / 180),
    "degrees": lambda x: x * (180 / np.pi),
    "rad2deg": lambda x: x * (180 / np.pi),
    "exp2": lambda x: np.exp(x * np.log(2)),
    "expm1": lambda x: np.exp(x) - 1,
    "log1p": lambda x: np.log(1 + x),
    "log2": lambda x: np.log(x) / np.log(2),
    "log10": lambda x: np.log(x) / np.log(10),
    "logaddexp": lambda x, y: np.maximum(x, y) + np.log(1 + np.exp(-np.absolute(x - y))),
    "sinh": lambda x: (np.exp(x) - np.exp(-x)) / 2,
    "cosh": lambda x: (np.exp(x) + np.exp(-x)) / 2,
    "trunc": lambda x: np.sign(x) * np.floor(np.absolute(x)),
    "float_power": np.power,
    "erf": _erf,
    "fmax": np.maximum,
    "fmin": np.minimum,
    "bitwise_and": partial(_of_bools, np.logical_and),
    "bitwise_or": partial(_of_bools, np.logical_or),
    "bitwise_xor": partial(_of_bools, np.logical_xor),
    "invert": partial(_of_bools, np.logical_not),
}
