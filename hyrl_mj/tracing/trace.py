"""Runs NumPy code on traced arrays, which record the operations from its arguments to its results.

np.empty((len(x), 3)), np.min([x, y], axis=0) and np.take(table, x) ignore NumPy's protocols for foreign
arrays. Replacing them in the module numpy would change the arrays of all threads. So a copy of the code runs,
in which the names `np`, `numpy`, `zeros`, ... stand for something else.
"""

from __future__ import annotations

import builtins
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput, brief
from hyrl_mj.tracing.traced_array import (
    Operation,
    Program,
    Traced,
    apply,
    shared_or_copied,
    take,
)
from hyrl_mj.tracing.vocabulary import BATCH, RAISED, REDUCTIONS, Untraceable


def trace(
    function: Callable[..., Any],
    samples: Mapping[str, np.ndarray],
    name: str,
    purpose: str = "exported",
) -> Program:
    """Returns the operations that a function does with its arguments.

    Args:
        function: takes arrays with one row for each row of the batch; returns one such array or a tuple.
        samples: for each argument `BATCH` rows of possible values.
        name: what messages call the function.
        purpose: what messages say that the function cannot be.

    Raises:
        BadInput: the function cannot be traced.
    """
    inputs = tuple(Operation("input", (key,), {}, value) for key, value in samples.items())
    raised: list[BaseException] = []
    before = RAISED.set(raised)
    try:
        with np.errstate(all="ignore"):
            results = _PrivateCopies().copy_of(function)(*map(Traced, inputs))
        if raised:
            raise raised[0]
        results = results if isinstance(results, tuple) else (results,)
        if not all(isinstance(r, Traced) and r.shape[:1] == (BATCH,) for r in results):
            raise BadInput(
                f"{name} cannot be {purpose}: it must return one row for each row it gets"
            )
        return Program(inputs, tuple(result.operation for result in results))
    except BadInput:
        raise
    except Untraceable as error:
        raise BadInput(f"{name} cannot be {purpose}: it {error}") from error
    except Exception as error:  # code that gets another kind of array fails in many ways
        raise BadInput(
            f"{name} cannot be {purpose}: it raises {brief(error)} when its operations are traced; write "
            "it with NumPy's functions of arrays alone"
        ) from error
    finally:
        RAISED.reset(before)


# ---- replacements of functions that ignore NumPy's protocols for foreign arrays


def _filled(original: Callable[..., np.ndarray], *args: Any, **kwargs: Any) -> Any:
    """Does np.zeros((len(x), 3)), np.tile(row, (len(x), 1)) and the like, of plain arguments.

    Makes an array that traced values can be assigned to.
    """
    array = original(*args, **kwargs)
    if BATCH not in array.shape:
        return array
    filled = np.zeros_like(array) if original is np.empty else array
    fill = filled.flat[0].item()
    if not (filled == fill).all():  # each row of the batch is the first one
        fill = filled[tuple(slice(1) if k == BATCH else slice(None) for k in filled.shape)]
    return apply("full", fill, shape=array.shape, dtype=array.dtype.name)


def _stacked(x: Any) -> Any:
    """Returns a list with traced values as one array, as NumPy makes of it; anything else as it is."""
    is_list = isinstance(x, list | tuple) and any(isinstance(part, Traced) for part in x)
    return np.stack(x) if is_list else x


def _converted(original: Callable[..., Any], x: Any, dtype: Any = None, **kwargs: Any) -> Any:
    """Does np.asarray(x), np.array([x, y]) and the like."""
    x = _stacked(x)
    if not isinstance(x, Traced):
        return original(x, dtype, **kwargs)
    if kwargs.keys() - {"copy"}:
        raise Untraceable(f"uses np.{original.__name__} with {', '.join(kwargs)}")
    if original is np.ascontiguousarray:
        x = shared_or_copied(x, x)
    copy = original is np.array and kwargs.get("copy", True)
    return x.astype(x.dtype if dtype is None else dtype, copy=bool(copy))


def _of_list(original: Callable[..., Any], x: Any, *args: Any, **kwargs: Any) -> Any:
    """Does np.min([x, y], axis=0) and the like."""
    return original(_stacked(x), *args, **kwargs)


def _take(x: Any, indices: Any, *args: Any, **kwargs: Any) -> Any:
    return (take if isinstance(indices, Traced) else np.take)(x, indices, *args, **kwargs)


class _Reducing:
    """Stands for a ufunc, whose method `reduce` is a function of arrays, as that of np.maximum is np.max."""

    def __init__(self, ufunc: np.ufunc, reduction: Callable[..., Any]) -> None:
        self._ufunc, self._reduction = ufunc, reduction

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._ufunc(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ufunc, name)

    def reduce(self, x: Any, axis: Any = 0, **kwargs: Any) -> Any:
        x = _stacked(x)
        reduction = self._reduction if isinstance(x, Traced) else self._ufunc.reduce
        return reduction(x, axis=axis, **kwargs)


REDUCING: dict[np.ufunc, Any] = {
    np.maximum: np.max, np.minimum: np.min, np.add: np.sum, np.multiply: np.prod,
    np.logical_and: np.all, np.logical_or: np.any,
}  # fmt: skip
OF_LISTS = (*(getattr(np, name) for name in REDUCTIONS), np.amax, np.amin, np.mean, np.prod)
REPEATING = (np.tile, np.broadcast_to, np.repeat)
REPLACEMENTS: dict[Any, Callable[..., Any]] = {
    **{make: partial(_filled, make) for make in (np.empty, np.zeros, np.ones, np.full, *REPEATING)},
    **{
        convert: partial(_converted, convert)
        for convert in (np.array, np.asarray, np.asanyarray, np.ascontiguousarray)
    },
    **{function: partial(_of_list, function) for function in (*OF_LISTS, np.linalg.norm)},
    **{ufunc: _Reducing(ufunc, reduction) for ufunc, reduction in REDUCING.items()},
    np.take: _take,
}


# ---- private copies of code


class _PrivateCopies:
    """Copies of functions, and of the functions and methods that they call, with `REPLACEMENTS`.

    Methods are copied of the object whose bound method is copied, and of objects of this package, such as
    charts, also of those in dictionaries that are their attributes. Methods of other objects run as they are.
    """

    def __init__(self) -> None:
        # Original and copy by the id of the original, which is kept so that its id stays its own.
        self._copies: dict[int, tuple[Any, Any]] = {}
        for original, replacement in REPLACEMENTS.items():
            self._keep(original, replacement)
        for module in (np.linalg, np):
            view = self._keep(module, ModuleType(module.__name__))
            vars(view).update(
                {n: self._copies.get(id(v), (v, v))[1] for n, v in vars(module).items()}
            )

    def _keep(self, original: Any, copy: Any) -> Any:
        self._copies[id(original)] = original, copy
        return copy

    def copy_of(self, x: Any) -> Any:
        """Returns the copy of a function, a method, a module or an object; anything else itself."""
        if id(x) in self._copies:
            return self._copies[id(x)][1]
        if isinstance(x, MethodType):
            owner = self._object(x.__self__)  # first: its methods refer to its class
            return MethodType(self.copy_of(x.__func__), owner)
        if isinstance(x, staticmethod | classmethod):
            return type(x)(self.copy_of(x.__func__))
        if isinstance(x, partial):
            given = {name: self.copy_of(value) for name, value in x.keywords.items()}
            return partial(self.copy_of(x.func), *map(self.copy_of, x.args), **given)
        if isinstance(x, FunctionType) and _is_copied(x.__globals__.get("__name__")):
            return self._function(x)
        if type(x).__module__.startswith("hyrl_mj."):
            return self._object(x)
        if isinstance(x, ModuleType) and _is_copied(x.__name__):
            view = self._keep(x, ModuleType(x.__name__))
            view.__getattr__ = lambda name: self.copy_of(getattr(x, name))
            return view
        return x

    def _function(self, original: FunctionType) -> FunctionType:
        """Returns a copy whose global names, closure and imports lead to copies."""
        names = original.__globals__
        if id(names) not in self._copies:
            own_builtins = {**vars(builtins), "__import__": self._import}
            if not str(names.get("__name__")).startswith("hyrl_mj."):
                own_builtins["isinstance"] = _is_instance
            self._keep(names, {**names, "__builtins__": own_builtins})
        namespace = self._copies[id(names)][1]
        cells = tuple(CellType() for _ in original.__closure__ or ())
        defaults = tuple(map(self.copy_of, original.__defaults__ or ()))
        copy = FunctionType(original.__code__, namespace, original.__name__, defaults, cells)
        copy.__kwdefaults__ = original.__kwdefaults__
        # Kept before the functions that it calls are copied: it may call itself.
        self._keep(original, copy)
        for cell, original_cell in zip(cells, original.__closure__ or (), strict=True):
            with suppress(ValueError):  # an empty cell stays empty
                cell.cell_contents = self.copy_of(original_cell.cell_contents)
        namespace.update(
            {n: self.copy_of(names[n]) for n in _names(original.__code__) & names.keys()}
        )
        return copy

    def _import(self, *args: Any, **options: Any) -> Any:
        return self.copy_of(builtins.__import__(*args, **options))

    def _object(self, original: Any) -> Any:
        """Returns a stand-in for an object, with copies of its methods and its own properties."""
        if id(original) in self._copies:
            return self._copies[id(original)][1]
        if not _is_copied(type(original).__module__):
            return original
        last: type = object
        # Each class inherits from the next one in the method resolution order, so that super() finds copies.
        for base in reversed(type(original).__mro__):
            if _is_copied(base.__module__):
                last = self._keep(base, type(base.__name__, (last,), {}))
                # These would act when the class is created, or an object of it is deleted.
                acting = {"__init_subclass__", "__del__", "__abstractmethods__", "_abc_impl"}
                for name, member in vars(base).items():
                    # Properties are computed by the original: they do not see the arguments of methods.
                    is_method = isinstance(member, FunctionType | staticmethod | classmethod)
                    if name not in acting and (is_method or not hasattr(member, "__get__")):
                        setattr(last, name, self.copy_of(member))
        members = {
            "__class__": property(lambda _: type(original)),  # for isinstance()
            "__getattr__": lambda _, name: getattr(original, name),
        }
        stand_in: Any = object.__new__(type("StandIn", (last,), members))
        self._keep(original, stand_in)
        attributes = getattr(original, "__dict__", {})
        for name, value in attributes.items():
            parts = {k: self.copy_of(v) for k, v in value.items()} if type(value) is dict else value
            vars(stand_in)[name] = self.copy_of(parts)
        return stand_in


def _is_instance(x: Any, kinds: Any) -> bool:
    """Does isinstance() in users' code, to which a traced array is one of NumPy's."""
    return isinstance(np.empty(0) if isinstance(x, Traced) else x, kinds)


def _is_copied(module: str | None) -> bool:
    """Returns whether code is copied; other code accepts no foreign arrays, or handles them itself."""
    top = (module or "").partition(".")[0]
    return top not in ("numpy", "scipy", "mujoco", "torch") and top not in sys.stdlib_module_names


def _names(code: CodeType) -> set[str]:
    """Returns the global names that code reads, nested functions included, and names of attributes."""
    inner = (_names(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inner)
