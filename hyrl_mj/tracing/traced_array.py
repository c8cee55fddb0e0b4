"""Operations on arrays, and an array that records them while it goes through NumPy code.

It implements NumPy's protocols for foreign arrays, so that `np.cos(x)`, `x[:, 0]` or `a @ x` end up here.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from hyrl_mj.tracing.vocabulary import BATCH, COMPOSED, REDUCTIONS, UFUNCS, Untraceable

# Operations that NumPy has as methods of arrays, or as functions with other arguments.
EVALUATED: dict[str, Callable[..., Any]] = {
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
            transpose, take, full), a method of its arrays (astype), or "input".
        operands: other operations, plain arrays or numbers; for "concatenate" all its parts.
        options: further arguments by name, such as axis=1.
        value: its result for the sample batch.
        number: grows from one operation to the next.
    """

    name: str
    operands: tuple[Any, ...]
    options: Mapping[str, Any]
    value: np.ndarray = field(repr=False)
    number: int = field(default_factory=itertools.count().__next__, init=False)


@dataclass(frozen=True)
class Program:
    """The operations of some code, from its arguments to its results."""

    inputs: tuple[Operation, ...]
    outputs: tuple[Operation, ...]

    def operations(self) -> list[Operation]:
        """Returns all operations but the inputs, in the order in which they were done."""
        reached: set[Operation] = set()
        waiting = list(self.outputs)
        while waiting:
            operation = waiting.pop()
            if operation not in reached:
                reached.add(operation)
                waiting += [o for o in operation.operands if isinstance(o, Operation)]
        return sorted(reached.difference(self.inputs), key=lambda operation: operation.number)


def apply(name: str, *operands: Any, **options: Any) -> Traced:
    """Does one operation and records it; its value has to be an array of numbers or bool."""
    operands = tuple(o.operation if isinstance(o, Traced) else o for o in operands)
    operands = tuple(np.asarray(o) if isinstance(o, list | tuple) else o for o in operands)
    values = [o.value if isinstance(o, Operation) else o for o in operands]
    value = np.asarray((EVALUATED.get(name) or getattr(np, name))(*values, **options))
    if value.dtype.kind not in "bif":
        raise Untraceable(f"makes an array of {value.dtype}: use numbers or bool")
    return Traced(Operation(name, operands, options, value))


class Traced(NDArrayOperatorsMixin):
    """An array that records the operations it results from.

    In NumPy a part of an array, or the array in another shape, shares its memory. Here such a part is taken
    anew where the whole was written to; once a part was written to, the whole cannot be used any more.
    """

    def __init__(self, operation: Operation) -> None:
        self._operation = operation
        # Of which it is a part, as that was when it was taken, and what takes it.
        self._whole: tuple[Traced, Operation, Callable[[], Traced] | None] | None = None
        self._written: Traced | None = None  # the part of it that was written to
        value = operation.value
        # Operations in place change none of these.
        self.shape, self.ndim, self.dtype = value.shape, value.ndim, value.dtype

    @property
    def operation(self) -> Operation:
        """The last operation, whose result it is."""
        if self._written is not None:
            raise Untraceable(
                "writes to a part of an array by a name of its own, and goes on with the array: write to the "
                "array, as x[:, 0] -= 1"
            )
        if self._whole is not None:
            whole, then, again = self._whole
            if whole._written is not self and whole.operation is not then:
                if again is None:
                    raise Untraceable(
                        "writes to an array of which there may be a copy, as np.ravel and "
                        "np.ascontiguousarray make of some: say x.copy()"
                    )
                self._operation = again().operation
                self.part_of(whole, again)
        return self._operation

    def part_of(self, whole: Traced, again: Callable[[], Traced] | None) -> Traced:
        """Returns itself, as what shares its memory with another array, of which it can be taken `again`.

        Without that nobody knows whether it shares it: it cannot be used any more once the other is written.
        """
        if self is not whole:
            self._whole = whole, whole._operation, again
        return self

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[Traced]:
        if self.shape[0] == BATCH:
            raise Untraceable("loops over the rows of a batch: take all at once")
        return (self[i] for i in range(len(self)))

    def astype(self, dtype: Any, copy: bool = True, **_: Any) -> Any:
        if (name := np.dtype(dtype).name) != self.dtype.name:
            return apply("astype", self, dtype=name)
        return np.copy(self) if copy else self

    def flatten(self) -> Any:
        return np.copy(np.ravel(self))

    def reshape(self, *shape: Any, **options: Any) -> Traced:
        return _call(np.reshape, self, shape[0] if len(shape) == 1 else shape, **options)

    def transpose(self, *axes: Any) -> Traced:
        order = np.empty(range(self.ndim)).transpose(*axes).shape
        return apply("transpose", self, axes=order).part_of(self, lambda: self.transpose(*axes))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # NumPy looks for its own protocols
            raise AttributeError(name)
        function = getattr(np, name, None)
        if function not in FUNCTIONS:
            raise Untraceable(f"uses .{name} of an array, which cannot be traced")
        return partial(_call, function, self)

    def __copy__(self, _: Any = None) -> Any:
        return np.copy(self)

    T, __deepcopy__ = property(transpose), __copy__

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
        if method != "__call__" or options or name not in UFUNCS | COMPOSED.keys():
            how = f".{method}" if method != "__call__" else ""
            how += f" with {', '.join(options)}" if options else ""
            raise Untraceable(f"uses np.{name}{how}, which cannot be traced")
        result = COMPOSED.get(name, partial(apply, name))(*inputs)
        if out is None:
            return result
        if not isinstance(out, Traced):
            self._plain()
        return out._become(result)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function not in FUNCTIONS:
            name = f"{function.__module__}.{function.__name__}".replace("numpy", "np", 1)
            raise Untraceable(f"uses {name}, which cannot be traced")
        return _call(function, *args, **kwargs)

    def __getitem__(self, index: Any) -> Any:
        entries = list(index) if isinstance(index, tuple) else [index]
        if any(isinstance(entry, Traced) for entry in entries):
            raise Untraceable("picks by an index that depends on values: use np.where or np.take")
        at = next((k for k, entry in enumerate(entries) if entry is Ellipsis), len(entries))
        left = self.ndim - sum(entry is not None and entry is not Ellipsis for entry in entries)
        entries[at : at + 1] = [slice(None)] * left
        picking = [entry for entry in entries if not (entry is None or isinstance(entry, slice))]
        if len(picking) > 1 and any(map(np.ndim, picking)):
            raise Untraceable("picks by several arrays at once: take one axis after the other")
        picked: Any = self
        axis = 0
        for entry in entries:
            if entry is None:
                picked = np.expand_dims(picked, axis)
            elif not _is_whole(entry):
                indices = np.arange(picked.shape[axis])[entry]
                picked = take(picked, indices if indices.ndim else int(indices), axis)
                axis += indices.ndim - 1
            axis += 1
        if any(map(np.ndim, picking)):
            return picked
        return picked.part_of(self, lambda: self[index])

    def __setitem__(self, index: Any, value: Any) -> None:
        if value is self._written:  # as the second half of x[:, 0] -= 1
            self._written = None
        rows, *columns = index if isinstance(index, tuple) else (index,)
        condition: Any = np.ones(self.shape[1:], dtype=bool)
        if not all(map(_is_whole, columns)):
            if self.ndim != 2 or len(columns) != 1 or isinstance(columns[0], Traced):
                raise Untraceable("assigns to parts of an array other than columns")
            chosen = np.arange(self.shape[1])[columns[0]]
            condition = np.isin(np.arange(self.shape[1]), chosen)
            if chosen.ndim == 0 and np.ndim(value) == 1:
                value = np.expand_dims(value, 1)
            elif np.ndim(value) and np.shape(value)[-1] == chosen.size:
                # Each chosen column gets its own column of the value; what the others get does not count.
                source = np.zeros(self.shape[1], dtype=int)
                source[chosen] = np.arange(chosen.size)
                value = np.take(value, source, axis=-1)
        if isinstance(rows, Traced) and rows.dtype == bool:
            if np.shape(value)[:1] == (BATCH,) and np.ndim(value) >= rows.ndim:
                raise Untraceable("assigns row by row under a condition: use np.where")
            condition = rows.reshape(rows.shape + (1,) * (self.ndim - rows.ndim)) & condition
        elif not (rows is Ellipsis or _is_whole(rows)):
            raise Untraceable("assigns to single rows of a batch: use np.where")
        self._become(np.where(condition, value, self))

    def _become(self, result: Any) -> Traced:
        """Takes over the result of an operation in place."""
        if result.shape != self.shape:
            raise Untraceable("assigns an array of another shape")
        self._operation, part = result.astype(self.dtype).operation, self
        while part._whole is not None:
            part._whole[0]._written, part = part, part._whole[0]
        return self


def _is_whole(index: Any) -> bool:
    return isinstance(index, slice) and index == slice(None)


# ---- functions that are operations, or choose the options of one


def _call(function: Any, *args: Any, **kwargs: Any) -> Any:
    """Calls what `FUNCTIONS` has for a function of NumPy."""
    replacement = FUNCTIONS[function]
    try:
        inspect.signature(replacement).bind(*args, **kwargs)
    except TypeError:
        raise Untraceable(
            f"uses np.{function.__name__} with arguments that cannot be traced"
        ) from None
    return replacement(*args, **kwargs)


def _reduce(name: str, x: Any, axis: Any = None, keepdims: bool = False) -> Traced:
    axes = tuple((np.atleast_1d(range(x.ndim) if axis is None else axis) % x.ndim).tolist())
    if any(x.shape[a] == BATCH for a in axes):
        raise Untraceable(f"uses np.{name} over the rows of a batch: each must stand for itself")
    options = {"axis": axes[0] if name.startswith("arg") else axes, "keepdims": bool(keepdims)}
    return apply(name, x, **options)


def _reshape(x: Any, shape: Any) -> Traced:
    shape = np.reshape(x.operation.value, shape).shape
    if BATCH not in shape:
        raise Untraceable("joins the rows of a batch: each must stand for itself")
    if shape == x.shape:
        return x
    sizes, before = ([k for k in sizes if k != 1] for sizes in (shape, x.shape))
    again = (lambda: _reshape(x, shape)) if sizes == before else None
    return apply("reshape", x, shape=shape).part_of(x, again)


def shared_or_copied(x: Traced, whole: Traced) -> Traced:
    """Returns an array of which nobody knows whether it shares its memory with another one."""
    return Traced(x.operation).part_of(whole, None)


def take(x: Any, indices: Any, axis: int | None = None) -> Traced:
    """Does np.take along an axis, by indices that are plain or traced."""
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
    np.ravel: lambda x: shared_or_copied(_reshape(x, -1), x),
    np.transpose: lambda x, axes=None: x.transpose(axes),
    np.concatenate: lambda parts, axis=0: apply(
        "concatenate", *parts, axis=axis % np.ndim(parts[0])
    ),
    np.take: take,
    np.where: lambda condition, x, y: apply("where", condition, x, y),
    np.full_like: _full_like,
    np.copy: lambda x: Traced(x.operation),
}
