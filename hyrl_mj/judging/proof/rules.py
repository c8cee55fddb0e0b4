"""Bounds of traced NumPy code over boxes of arguments: a rule of affine arithmetic for each operation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hyrl_mj.errors import brief
from hyrl_mj.judging.proof import affine, functions
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.tracing import BATCH, Operation, Program

# Rounding errors of NumPy's functions and of ours, in units in the last place.
ROUNDING = 8
# Operations that NumPy takes for others if all operands are bool.
OF_BOOLS = {
    "add": "logical_or",
    "maximum": "logical_or",
    "multiply": "logical_and",
    "minimum": "logical_and",
    "max": "any",
    "min": "all",
}


@dataclass(frozen=True, eq=False)
class Truth:
    """Conditions that depend on the boxes.

    Attributes:
        surely: (n, ...) bool, true everywhere in the box.
        possibly: (n, ...) bool, true somewhere in the box.
    """

    surely: np.ndarray
    possibly: np.ndarray


def bounds(program: Program, boxes: Affine) -> Affine | Truth:
    """Returns the result of a program with one argument and one result over boxes.

    Raises:
        Unbounded: the program has an operation without a rule.
    """
    (argument,), (result,) = program.inputs, program.outputs
    values: dict[Operation, Affine | Truth] = {argument: boxes}
    n, d = boxes.centre.shape[0], len(boxes.generators)
    with np.errstate(all="ignore"):
        for operation in program.operations():
            try:
                values[operation] = _apply(operation, values, n, d)
            except (ValueError, TypeError, IndexError) as error:  # shapes that no rule has foreseen
                raise Unbounded(
                    f"uses np.{operation.name} in a way for which there are no bounds ({brief(error)})"
                ) from error
    return values[result]


def _apply(
    operation: Operation, values: Mapping[Operation, Affine | Truth], n: int, d: int
) -> Affine | Truth:
    name, options = operation.name, dict(operation.options)
    rule: Callable[..., Any] | None = RULES.get(name)
    if rule is None:
        raise Unbounded(f"uses np.{name}, for which there are no bounds")
    if "shape" in options:
        options["shape"] = tuple(n if k == BATCH else k for k in options["shape"])
    operands: list[Any] = [
        values[o] if isinstance(o, Operation) else o for o in _as_computed(operation)
    ]
    dtype = operation.value.dtype
    if dtype.kind == "b" and name in OF_BOOLS and all(map(_is_condition, operands)):
        name = OF_BOOLS[name]
        rule = RULES[name]
    if name.startswith("logical_"):
        return rule(*map(_truth, operands))
    takes_both = name in ("where", "astype", "any", "all")  # conditions and numbers as they are
    forms = [o if takes_both and _is_condition(o) else as_form(o, d) for o in operands]
    found: Affine | Truth
    if name == "multiply" and operands[0] is operands[1] and isinstance(operands[0], Affine):
        found = affine.square(operands[0])
    else:
        found = rule(*forms, **options)
    if not isinstance(found, Affine):
        return found
    # What only moves entries leaves conditions as they are.
    if dtype.kind == "b" and name in ("reshape", "transpose", "concatenate", "take"):
        return Truth(found.low > 0.5, found.high > 0.5)
    if dtype.kind == "b":
        raise Unbounded(f"uses np.{name} of conditions, for which there are no bounds")
    return _in_type(affine.tidy(found.wider(_rounding(operation, found, forms))), dtype)


def _as_computed(operation: Operation) -> list[Any]:
    """Returns the operands; constants as NumPy takes them beside numbers of single precision, say."""
    operands = list(operation.operands)
    if operation.name == "take":  # its constants may be indices
        return operands
    dtype = np.result_type(*(o.value if isinstance(o, Operation) else o for o in operands))
    if dtype.kind != "f" or dtype.itemsize >= np.dtype(float).itemsize:
        return operands
    return [
        o if isinstance(o, Operation) or np.asarray(o).dtype.kind == "b" else np.asarray(o, dtype)
        for o in operands
    ]


def _in_type(found: Affine, dtype: np.dtype[Any]) -> Affine:
    """Returns a form of numbers of a type: what is too large for it is infinite, or of integers unknown."""
    if dtype.kind == "f":
        if dtype.itemsize >= np.dtype(float).itemsize:
            return found
        over = np.abs(found.centre) + found.radius > np.finfo(dtype).max
        return replace(found, remainder=np.where(over, np.inf, found.remainder))
    # Beyond 2**53 our own numbers are not exact.
    least, most = max(np.iinfo(dtype).min, -(2**53)), min(np.iinfo(dtype).max, 2**53)
    if not ((found.low >= least) & (found.high <= most)).all():
        raise Unbounded(f"computes with numbers of the type {dtype} that may be too large for it")
    return found


def _rounding(operation: Operation, found: Affine, operands: list[Any]) -> np.ndarray:
    """Returns the largest rounding error (n, ...) of an operation, of NumPy's and of ours."""
    if operation.value.dtype.kind != "f":
        return np.zeros(found.centre.shape)
    size = np.abs(found.centre) + found.radius
    # The errors of sums go with their operands, not with their result.
    if operation.name in ("add", "subtract", "sum", "matmul"):
        sizes = [as_form(np.abs(o.centre) + o.radius, len(o.generators)) for o in operands]
        terms = max(2, *(int(np.prod(o.centre.shape[1:], dtype=int)) for o in operands))
        whole = RULES["add" if operation.name == "subtract" else operation.name]
        size = terms * whole(*sizes, **operation.options).centre
    kind = np.finfo(operation.value.dtype)
    # Near 0 numbers of less than double precision are coarser than their size tells.
    least = kind.smallest_subnormal if kind.bits < np.finfo(float).bits else 0.0
    return np.asarray(ROUNDING * (kind.eps * size + float(least)))


def as_form(x: Any, d: int) -> Affine:
    """Returns an operand as an affine form."""
    if isinstance(x, Affine):
        return x
    if isinstance(x, Truth):
        return Affine.between(x.surely.astype(float), x.possibly.astype(float), d)
    centre = np.asarray(x, dtype=float)
    nan = np.isnan(centre)
    centre = np.where(nan, 0.0, centre)
    return Affine(centre, np.zeros((d, *centre.shape)), np.zeros(centre.shape), nan)


def _is_condition(x: Any) -> bool:
    return isinstance(x, Truth) or np.asarray(x).dtype == bool


def _truth(x: Any) -> Truth:
    if isinstance(x, Truth):
        return x
    if isinstance(x, Affine):
        # NaN counts as true.
        return Truth((x.low > 0) | (x.high < 0), (x.radius > 0) | (x.centre != 0) | x.nan)
    return Truth(np.asarray(x, dtype=bool), np.asarray(x, dtype=bool))


# ---- conditions and shapes


def _greater(a: Affine, b: Affine) -> Truth:
    return Truth((a.low > b.high) & ~(a.nan | b.nan), a.high > b.low)


def _greater_equal(a: Affine, b: Affine) -> Truth:
    return Truth((a.low >= b.high) & ~(a.nan | b.nan), a.high >= b.low)


def _equal(a: Affine, b: Affine) -> Truth:
    point = (a.radius == 0) & (b.radius == 0) & ~(a.nan | b.nan)
    return Truth(point & (a.centre == b.centre), (a.low <= b.high) & (b.low <= a.high))


def _where(condition: Any, a: Any, b: Any) -> Affine | Truth:
    c = _truth(condition)
    if not isinstance(a, Affine) and not isinstance(b, Affine):
        a, b = _truth(a), _truth(b)
        surely = np.where(c.surely, a.surely, np.where(c.possibly, a.surely & b.surely, b.surely))
        possibly = np.where(
            c.surely, a.possibly, np.where(c.possibly, a.possibly | b.possibly, b.possibly)
        )
        return Truth(surely, possibly)
    d = len((a if isinstance(a, Affine) else b).generators)
    a, b = as_form(a, d), as_form(b, d)
    hull = replace(
        Affine.between(np.minimum(a.low, b.low), np.maximum(a.high, b.high), d),
        nan=a.nan | b.nan,
        nonnegative=a.positive & b.positive,
    )
    return affine.choose(c.surely, a, affine.choose(c.possibly, hull, b))


def _astype(a: Any, dtype: str) -> Any:
    if np.dtype(dtype).kind == "b":
        return _truth(a)
    kind = np.dtype(dtype)
    if kind.kind == "u" or (kind.kind == "i" and kind.itemsize < 4):
        raise Unbounded(f"makes numbers of the type {dtype}, which wrap")
    if kind.kind == "f" or not isinstance(a, Affine):
        return a
    if (a.nan | a.wild).any():
        raise Unbounded(f"makes numbers of the type {dtype} of what may be NaN or infinite")
    whole = Affine.between(np.trunc(a.low), np.trunc(a.high), len(a.generators))
    return replace(whole, nonnegative=a.positive)


def _concatenate(*parts: Affine, axis: int) -> Affine:
    return affine.rearranged(lambda *arrays: np.concatenate(arrays, axis), *parts)


def _take(a: Affine, indices: Affine, axis: int) -> Affine:
    if indices.radius.any() or indices.nan.any():
        raise Unbounded("looks up values by an index that depends on the state")
    at = indices.centre.astype(int)
    return affine.rearranged(lambda x: np.take(x, at, axis), a)


def _reduced(name: str) -> Callable[..., Affine]:
    function = getattr(np, name)

    def rule(a: Affine, axis: Any, keepdims: bool) -> Affine:
        options = {"axis": axis, "keepdims": keepdims}
        low, high = (function(x, **options) for x in (a.low, a.high))
        found = Affine.between(low, high, len(a.generators))
        return replace(found, nan=a.nan.any(**options), nonnegative=a.positive.all(**options))

    return rule


RULES: dict[str, Callable[..., Any]] = {
    "add": affine.add,
    "subtract": affine.subtract,
    "negative": affine.negative,
    "multiply": affine.multiply,
    "divide": functions.divide,
    "power": functions.raised,
    "matmul": affine.matmul,
    "sqrt": functions.sqrt,
    "exp": functions.smooth(
        np.exp,
        np.exp,
        lambda _, high: np.exp(high),
        functions.rising(np.exp),
        nonnegative=True,
    ),
    "log": functions.smooth(
        functions.logarithm,
        lambda x: 1 / x,
        lambda low, _: np.where(low > 0, low, 0.0) ** -2,
        functions.rising(functions.logarithm),
        lambda a: ~a.positive,
    ),
    "sin": functions.smooth(
        np.sin,
        np.cos,
        lambda low, _: np.ones_like(low),
        functions.unit,
        lambda a: a.wild,
    ),
    "cos": functions.smooth(
        np.cos,
        lambda x: -np.sin(x),
        lambda low, _: np.ones_like(low),
        functions.unit,
        lambda a: a.wild,
    ),
    "tanh": functions.smooth(
        np.tanh,
        lambda x: 1 - np.tanh(x) ** 2,
        lambda low, _: np.full_like(low, 0.77),
        functions.rising(np.tanh),
    ),
    "arctan2": functions.arctan2,
    "absolute": functions.absolute,
    "sign": functions.stepwise(np.sign),
    "floor": functions.stepwise(np.floor),
    "ceil": functions.stepwise(np.ceil),
    "rint": functions.stepwise(np.rint),
    "maximum": functions.maximum,
    "minimum": functions.minimum,
    "remainder": functions.remainder,
    "sum": affine.total,
    "max": _reduced("max"),
    "min": _reduced("min"),
    "greater": _greater,
    "greater_equal": _greater_equal,
    "less": lambda a, b: _greater(b, a),
    "less_equal": lambda a, b: _greater_equal(b, a),
    "equal": _equal,
    "isnan": lambda a: Truth(np.zeros(a.centre.shape, bool), a.nan),
    "logical_and": lambda a, b: Truth(a.surely & b.surely, a.possibly & b.possibly),
    "logical_or": lambda a, b: Truth(a.surely | b.surely, a.possibly | b.possibly),
    "logical_not": lambda a: Truth(~a.possibly, ~a.surely),
    "logical_xor": lambda a, b: Truth(
        (a.surely & ~b.possibly) | (b.surely & ~a.possibly),
        ~((a.surely & b.surely) | (~a.possibly & ~b.possibly)),
    ),
    "any": lambda a, **options: Truth(*(np.any(x, **options) for x in _sides(a))),
    "all": lambda a, **options: Truth(*(np.all(x, **options) for x in _sides(a))),
    "where": _where,
    "astype": _astype,
    "concatenate": _concatenate,
    "reshape": lambda a, shape: affine.rearranged(lambda x: x.reshape(shape), a),
    "transpose": lambda a, axes: affine.rearranged(lambda x: x.transpose(axes), a),
    "take": _take,
    "full": lambda a, shape, dtype: _astype(
        affine.rearranged(lambda x: np.broadcast_to(x, shape), a), dtype
    ),
}


def _sides(a: Any) -> tuple[np.ndarray, np.ndarray]:
    a = _truth(a)
    return a.surely, a.possibly
