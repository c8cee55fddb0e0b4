"""The operations that NumPy code is reduced to, and other functions of NumPy as combinations of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from functools import partial, reduce
from typing import Any

import numpy as np

# Rows of the sample batch that code is traced with. Every dimension of this size counts as the batch, so the
# number is one that no other dimension has.
BATCH = 1009
# Elementwise functions of NumPy that ONNX has, and their names there; onnxruntime has Atan in float32 alone.
ELEMENTWISE = {
    "absolute": "Abs", "negative": "Neg", "sign": "Sign", "sqrt": "Sqrt", "exp": "Exp", "log": "Log",
    "sin": "Sin", "tanh": "Tanh", "floor": "Floor", "ceil": "Ceil", "rint": "Round", "arctan": "Atan",
    "add": "Add", "subtract": "Sub", "multiply": "Mul", "divide": "Div", "power": "Pow",
    "matmul": "MatMul", "maximum": "Max", "minimum": "Min", "isnan": "IsNaN", "logical_not": "Not",
    "logical_and": "And", "logical_or": "Or", "logical_xor": "Xor", "equal": "Equal",
    "greater": "Greater", "greater_equal": "GreaterOrEqual", "less": "Less", "less_equal": "LessOrEqual",
}  # fmt: skip
UFUNCS = {*ELEMENTWISE, "cos", "arctan2", "remainder"}
REDUCTIONS = ("sum", "max", "min", "any", "all", "argmax", "argmin")


# Those that were raised while code is traced.
RAISED: ContextVar[list[BaseException]] = ContextVar("raised")


class Untraceable(BaseException):
    """Code cannot be traced; the text completes "it ...". Code that catches all errors does not hide it."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        RAISED.get([]).append(self)


def _prod(x: Any, axis: Any = None, keepdims: bool = False) -> Any:
    """Multiplies one factor after the other: older onnxruntimes have no product in float64."""
    if axis is None or np.ndim(axis):
        raise Untraceable("uses np.prod other than along one axis")
    product = reduce(np.multiply, (np.take(x, i, axis=axis) for i in range(x.shape[axis])))
    return np.expand_dims(product, axis) if keepdims else product


def _mean(x: Any, axis: Any = None, keepdims: bool = False) -> Any:
    total = np.sum(x, axis=axis, keepdims=keepdims)
    return total * float(np.prod(total.shape) / np.prod(x.shape))


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    if ord not in (None, 2) or axis is None or np.ndim(axis):
        raise Untraceable("uses np.linalg.norm other than the Euclidean one along one axis")
    return np.sqrt(np.sum(x * x, axis=axis, keepdims=keepdims))


def _column_stack(parts: Sequence[Any]) -> Any:
    columns = [part if np.ndim(part) > 1 else np.expand_dims(part, 1) for part in parts]
    return np.concatenate(columns, axis=1)


def _clip(x: Any, a_min: Any = None, a_max: Any = None, *, min: Any = None, max: Any = None) -> Any:
    low, high = a_min if min is None else min, a_max if max is None else max
    x = x if low is None else np.maximum(x, low)
    return x if high is None else np.minimum(x, high)


def _select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0) -> Any:
    pairs = reversed(list(zip(conditions, choices, strict=True)))
    return reduce(lambda rest, pair: np.where(pair[0], pair[1], rest), pairs, default)


def _diff(x: Any, axis: int = -1) -> Any:
    indices = np.arange(x.shape[axis])
    return np.take(x, indices[1:], axis=axis) - np.take(x, indices[:-1], axis=axis)


def _round(x: Any, decimals: int = 0) -> Any:
    return np.rint(x * 10.0**decimals) / 10.0**decimals if decimals else np.rint(x)


def _erf(x: Any) -> Any:
    """Returns SciPy's error function within 2e-7 (Abramowitz and Stegun, 7.1.26), which ONNX lacks."""
    t = 1 / (1 + 0.3275911 * np.absolute(x))
    factors = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)
    polynomial = reduce(lambda rest, factor: (rest + factor) * t, factors, 0.0)
    return np.sign(x) * (1 - polynomial * np.exp(-x * x))


def _reciprocal(x: Any) -> Any:
    if x.dtype.kind != "f":
        raise Untraceable(
            "uses np.reciprocal of integers, which gives integers: divide 1.0 by them"
        )
    return 1 / x


def _of_numbers(extreme: np.ufunc, x: Any, y: Any) -> Any:
    """Does np.fmax or np.fmin, which give the other number where one is NaN."""
    return np.where(np.isnan(x), y, np.where(np.isnan(y), x, extreme(x, y)))


def _of_bools(logical: np.ufunc, *operands: Any) -> Any:
    """Does a bitwise operation, which on bool is a logical one."""
    arrays = (o if hasattr(o, "dtype") else np.asarray(o) for o in operands)
    if any(array.dtype.kind != "b" for array in arrays):
        raise Untraceable("works on the bits of numbers")
    return logical(*operands)


# Functions of NumPy as combinations of others. Elementwise ones by their names: SciPy has some of these, too.
COMPOSED: dict[Any, Callable[..., Any]] = {
    np.mean: _mean,
    np.prod: _prod,
    np.linalg.norm: _norm,
    np.squeeze: lambda x, axis=None: np.reshape(x, np.empty(x.shape).squeeze(axis).shape),
    np.expand_dims: lambda x, axis: np.reshape(x, np.expand_dims(np.empty(x.shape), axis).shape),
    np.atleast_1d: lambda x: x,
    np.atleast_2d: lambda x: x if x.ndim > 1 else x[None],
    np.swapaxes: lambda x, *pair: np.transpose(x, np.empty(range(x.ndim)).swapaxes(*pair).shape),
    np.stack: lambda parts, axis=0: np.concatenate(
        [np.expand_dims(part, axis) for part in parts], axis=axis
    ),
    np.hstack: lambda parts: np.concatenate(parts, axis=1 if np.ndim(parts[0]) > 1 else 0),
    np.vstack: lambda parts: np.concatenate([np.atleast_2d(part) for part in parts]),
    np.column_stack: _column_stack,
    np.clip: _clip,
    np.select: _select,
    np.diff: _diff,
    np.dot: lambda x, y: x @ y,
    **dict.fromkeys(
        (np.zeros_like, np.empty_like), lambda x, dtype=None: np.full_like(x, 0, dtype)
    ),
    np.ones_like: lambda x, dtype=None: np.full_like(x, 1, dtype),
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
    "reciprocal": _reciprocal,
    "hypot": lambda x, y: np.sqrt(x * x + y * y),
    **dict.fromkeys(("radians", "deg2rad"), lambda x: x * (np.pi / 180)),
    **dict.fromkeys(("degrees", "rad2deg"), lambda x: x * (180 / np.pi)),
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
    "fmax": lambda x, y: _of_numbers(np.maximum, x, y),
    "fmin": lambda x, y: _of_numbers(np.minimum, x, y),
    "bitwise_and": partial(_of_bools, np.logical_and),
    "bitwise_or": partial(_of_bools, np.logical_or),
    "bitwise_xor": partial(_of_bools, np.logical_xor),
    "invert": partial(_of_bools, np.logical_not),
}
