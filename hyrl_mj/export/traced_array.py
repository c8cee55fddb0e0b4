"""Operations on arrays, and an array that keeps those it comes from when it goes through NumPy code.

It answers NumPy's protocols for arrays of another kind, so that `np.cos(x)`, `x[:, 0]` or `a @ x` come here.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from hyrl_mj.export.vocabulary import BATCH, COMPOSED, REDUCTIONS, UFUNCS, Untraceable

# How operations are done that are methods of arrays, or functions that take their arguments in another way.
EVALUATED: dict[str, Callable[..., Any]] = {
    "getitem": lambda x, item: x[item],
    "astype": lambda x, dtype: x.astype(dtype),
    "reshape": lambda x, shape: x.reshape(shape),
    "concatenate": lambda *parts, axis: np.concatenate(parts, axis),
    "full": lambda x, shape, dtype: np.broadcast_to(np.array(x, dtype), shape),
}


@dataclass(frozen=True, eq=False)
class Operation:
    """One operation on arrays.

    Attributes:
        name: one of `UFUNCS` or `REDUCTIONS`, another function of NumPy (where, concatenate, reshape,
            transpose, take, full), a method of its arrays (getitem, astype), or "input".
        operands: other operations, plain arrays or numbers; of "concatenate" all its parts.
        options: further arguments by name, as axis=1; "item" of "getitem" has an entry for each axis.
        value: what it gives for the rows that it was followed with.
        number: grows from one operation to the next.
    """

    name: str
    operands: tuple[Any, ...]
    options: Mapping[str, Any]
    value: np.ndarray = field(repr=False)
    number: int = field(default_factory=itertools.count().__next__, init=False)


@dataclass(frozen=True)
class Program:
    """What code does, from its arguments to its results."""

    inputs: tuple[Operation, ...]
    outputs: tuple[Operation, ...]

    def operations(self) -> list[Operation]:
        """All operations but the inputs, in the order in which they were done."""
        by_number: dict[int, Operation] = {}
        waiting = list(self.outputs)
        while waiting:
            operation = waiting.pop()
            if operation.number not in by_number and operation.name != "input":
                by_number[operation.number] = operation
                waiting += [o for o in operation.operands if isinstance(o, Operation)]
        return [by_number[number] for number in sorted(by_number)]


def apply(name: str, *operands: Any, **options: Any) -> Traced:
    """Do one operation, and keep it; its value has to be an array of numbers or bool."""
    operands = tuple(o.operation if isinstance(o, Traced) else o for o in operands)
    values = [o.value if isinstance(o, Operation) else o for o in operands]
    value = np.asarray((EVALUATED.get(name) or getattr(np, name))(*values, **options))
    if value.dtype.kind not in "bif":
        raise Untraceable(f"makes an array of {value.dtype}: use numbers or bool")
    return Traced(Operation(name, operands, options, value))


class Traced(NDArrayOperatorsMixin):
    """An array that remembers where it comes from."""

    def __init__(self, operation: Operation) -> None:
        self.operation = operation
        value = operation.value
        # Nothing that is done in place changes these.
        self.shape, self.ndim, self.dtype = value.shape, value.ndim, value.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[Traced]:
        if self.shape[0] == BATCH:
            raise Untraceable("loops over the rows of a batch: take all at once")
        return (self[i] for i in range(len(self)))

    def astype(self, dtype: Any, **_: Any) -> Traced:
        return apply("astype", self, dtype=np.dtype(dtype).name)

    def reshape(self, *shape: Any, **options: Any) -> Traced:
        return _call(np.reshape, self, shape[0] if len(shape) == 1 else shape, **options)

    def transpose(self, *axes: Any) -> Any:
        return _transpose(self, axes[0] if len(axes) == 1 else axes or None)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # NumPy asks for protocols of its own
            raise AttributeError(name)
        function = getattr(np, {"flatten": "ravel"}.get(name, name), None)
        if function not in FUNCTIONS:
            raise Untraceable(f"uses .{name} of an array, which has no exported form")
        return partial(_call, function, self)

    T = property(transpose)

    def __bool__(self) -> bool:
        raise Untraceable("branches on values: use np.where")

    def _plain(self, *_: Any, **__: Any) -> Any:
        raise Untraceable(
            "turns an array into plain numbers, as float(), math functions, foreign libraries, and "
            "np.array or np.empty in methods of other objects do: use NumPy's functions of arrays"
        )

    __array__ = __float__ = __int__ = __index__ = _plain

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        name, out = ufunc.__name__, options.pop("out", (None,))[0]
        if method != "__call__" or options or (name not in UFUNCS and name not in COMPOSED):
            how = f".{method}" if method != "__call__" else ""
            how += f" with {', '.join(options)}" if options else ""
            raise Untraceable(f"uses np.{name}{how}, which has no exported form")
        result = COMPOSED.get(name, partial(apply, name))(*inputs)
        if out is None:
            return result
        if not isinstance(out, Traced):
            self._plain()
        return out._become(result)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function not in FUNCTIONS:
            name = f"{function.__module__}.{function.__name__}".replace("numpy", "np", 1)
            raise Untraceable(f"uses {name}, which has no exported form")
        return _call(function, *args, **kwargs)

    def __getitem__(self, index: Any) -> Traced:
        item = _item(index, self.shape)
        return self if all(map(_is_whole, item)) else apply("getitem", self, item=item)

    def __setitem__(self, index: Any, value: Any) -> None:
        rows, *columns = index if isinstance(index, tuple) else (index,)
        condition: Any = np.ones(self.shape[1:], dtype=bool)
        if not all(map(_is_whole, columns)):
            if self.ndim != 2 or len(columns) != 1 or isinstance(columns[0], Traced):
                raise Untraceable("assigns to parts of an array other than columns")
            chosen = np.arange(self.shape[1])[columns[0]]
            condition = np.isin(np.arange(self.shape[1]), chosen)
            if chosen.ndim == 0 and np.ndim(value) == 1:
                value = np.expand_dims(value, 1)
            elif chosen.ndim and np.ndim(value) and np.shape(value)[-1] == len(chosen) > 1:
                # To each of all columns the one that goes there, to the others any.
                source = np.zeros(self.shape[1], dtype=int)
                source[chosen] = np.arange(len(chosen))
                value = np.take(value, source, axis=-1)
        if isinstance(rows, Traced) and rows.dtype == bool:
            if np.shape(value)[:1] == (BATCH,) and np.ndim(value) >= rows.ndim:
                raise Untraceable("assigns row by row under a condition: use np.where")
            condition = rows.reshape(rows.shape + (1,) * (self.ndim - rows.ndim)) & condition
        elif not (rows is Ellipsis or _is_whole(rows)):
            raise Untraceable("assigns to single rows of a batch: use np.where")
        self._become(np.where(condition, value, self))

    def _become(self, result: Any) -> Traced:
        """Take over what an operation in place gives."""
        if result.shape != self.shape:
            raise Untraceable("assigns an array of another shape")
        same = result.dtype == self.dtype
        self.operation = (result if same else result.astype(self.dtype)).operation
        return self


def _is_whole(index: Any) -> bool:
    return isinstance(index, slice) and index == slice(None)


def _item(index: Any, shape: tuple[int, ...]) -> tuple[Any, ...]:
    """An index with one entry for each axis, and None for each new one: slices, int, one int array."""
    entries = list(index) if isinstance(index, tuple) else [index]
    if any(isinstance(entry, Traced) for entry in entries):
        raise Untraceable("picks by an index that depends on values: use np.where or np.take")
    at = next((k for k, entry in enumerate(entries) if entry is Ellipsis), len(entries))
    left = len(shape) - sum(entry is not None and entry is not Ellipsis for entry in entries)
    entries[at : at + 1] = [slice(None)] * left
    item: list[Any] = []
    sizes = iter(shape)
    for entry in entries:
        if entry is not None and next(sizes) == BATCH and not _is_whole(entry):
            raise Untraceable("picks single rows of a batch")
        if entry is not None and not isinstance(entry, slice):
            entry = np.asarray(entry)
            entry = np.flatnonzero(entry) if entry.dtype == bool else entry
            entry = entry if entry.ndim else int(entry)
        item.append(entry)
    arrays = [i for i in item if isinstance(i, np.ndarray)]
    if arrays and (len(arrays) > 1 or arrays[0].ndim > 1 or any(isinstance(i, int) for i in item)):
        raise Untraceable("picks by several arrays at once: take one axis after the other")
    return tuple(item)


# ---- functions that are operations, or decide what the operation is


def _call(function: Any, *args: Any, **kwargs: Any) -> Any:
    """Do a function of NumPy as `FUNCTIONS` says."""
    replacement = FUNCTIONS[function]
    try:
        inspect.signature(replacement).bind(*args, **kwargs)
    except TypeError:
        raise Untraceable(
            f"uses np.{function.__name__} with arguments that have no exported form"
        ) from None
    return replacement(*args, **kwargs)


def _reduce(name: str, x: Any, axis: Any = None, keepdims: bool = False) -> Traced:
    axes = range(x.ndim) if axis is None else np.atleast_1d(axis).tolist()
    axes = tuple(int(a) % x.ndim for a in axes)
    if any(x.shape[a] == BATCH for a in axes):
        raise Untraceable(f"uses np.{name} over the rows of a batch: each must stand for itself")
    options = {"axis": axes[0] if name.startswith("arg") else axes, "keepdims": bool(keepdims)}
    return apply(name, x, **options)


def _reshape(x: Any, shape: Any) -> Traced:
    shape = np.reshape(x.operation.value, shape).shape
    if BATCH in x.shape and BATCH not in shape:
        raise Untraceable("joins the rows of a batch: each must stand for itself")
    return x if shape == x.shape else apply("reshape", x, shape=shape)


def _transpose(x: Any, axes: Any = None) -> Any:
    axes = tuple(range(x.ndim))[::-1] if axes is None else tuple(a % x.ndim for a in axes)
    return apply("transpose", x, axes=axes) if x.ndim > 1 else x


def _concatenate(parts: Sequence[Any], axis: int = 0) -> Traced:
    parts = [part if isinstance(part, Traced) else np.asarray(part) for part in parts]
    return apply("concatenate", *parts, axis=axis % parts[0].ndim)


def take(x: Any, indices: Any, axis: int | None = None) -> Traced:
    """np.take of an array along an axis, by indices that are plain or traced."""
    if axis is None and np.ndim(x) != 1:
        raise Untraceable("uses np.take without an axis")
    axis = (axis or 0) % np.ndim(x)
    if isinstance(x, Traced) and x.shape[axis] == BATCH:
        raise Untraceable("picks single rows of a batch")
    return apply("take", x, indices, axis=axis)


def _full_like(x: Any, fill_value: Any, dtype: Any = None) -> Traced:
    name = np.dtype(x.dtype if dtype is None else dtype).name
    return apply("full", fill_value, shape=x.shape, dtype=name)


FUNCTIONS: dict[Any, Callable[..., Any]] = {
    **COMPOSED,
    **{getattr(np, name): partial(_reduce, name) for name in REDUCTIONS},
    np.amax: partial(_reduce, "max"),
    np.amin: partial(_reduce, "min"),
    np.reshape: _reshape,
    np.transpose: _transpose,
    np.concatenate: _concatenate,
    np.take: take,
    np.where: lambda condition, x, y: apply("where", condition, x, y),
    np.full_like: _full_like,
    np.copy: lambda x: Traced(x.operation),
}
