"""Runs Python code with some functions of NumPy replaced for that code alone.

np.empty((len(x), 3)), np.array([x, y]) and np.take(table, x) ignore NumPy's protocols for foreign arrays.
Replacing them in the module numpy would change the arrays of all threads. So a copy of the code runs, in
which the names `np`, `numpy`, `zeros`, ... stand for something else.
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

# Packages whose code is not copied: it does not take foreign arrays, or needs no help.
LEFT_AS_THEY_ARE = {*sys.stdlib_module_names, "numpy", "scipy", "mujoco", "torch"}
# Members that a copy of a class must not have: they would act when it is created or deleted.
NOT_COPIED = {"__init_subclass__", "__del__", "__abstractmethods__", "_abc_impl"}


class PrivateCopies:
    """Copies of functions, and of the functions and methods that they call.

    Methods are copied of the object whose bound method is copied, and of objects of this package, such as
    charts. Methods of other objects run as they are.

    Args:
        replacements: what copies call instead of functions of NumPy, by the names of these.
    """

    def __init__(self, replacements: Mapping[str, Callable[..., Any]]) -> None:
        numpy = ModuleType("numpy")
        vars(numpy).update(vars(np), **replacements)
        # Original and copy by the id of the original, which is kept so that its id stays its own.
        self._copies: dict[int, tuple[Any, Any]] = {id(np): (np, numpy)}
        for name, replacement in replacements.items():
            self._keep(getattr(np, name), replacement)

    def _keep(self, original: Any, copy: Any) -> Any:
        self._copies[id(original)] = original, copy
        return copy

    def of(self, x: Any) -> Any:
        """Returns the copy of a function, a method, a module or an object; anything else itself."""
        if id(x) in self._copies:
            return self._copies[id(x)][1]
        if isinstance(x, MethodType):
            owner = self._object(x.__self__)  # first: its methods refer to its class
            return MethodType(self.of(x.__func__), owner)
        if isinstance(x, staticmethod | classmethod):
            return type(x)(self.of(x.__func__))
        if isinstance(x, partial):
            return partial(self.of(x.func), *x.args, **x.keywords)
        if isinstance(x, FunctionType) and _is_copied(x.__globals__.get("__name__")):
            return self._function(x)
        if _package(type(x).__module__) == _package(__name__):
            return self._object(x)
        if isinstance(x, ModuleType) and _is_copied(x.__name__):
            view = self._keep(x, ModuleType(x.__name__))
            view.__getattr__ = lambda name: self.of(getattr(x, name))
            return view
        return x

    def _function(self, original: FunctionType) -> FunctionType:
        """Returns a copy whose global names, closure and imports lead to copies."""
        names = original.__globals__
        if id(names) not in self._copies:
            own_builtins = {**vars(builtins), "__import__": self._import}
            self._keep(names, {**names, "__builtins__": own_builtins})
        namespace = self._copies[id(names)][1]
        cells = tuple(CellType() for _ in original.__closure__ or ())
        defaults = tuple(map(self.of, original.__defaults__ or ()))
        copy = FunctionType(original.__code__, namespace, original.__name__, defaults, cells)
        copy.__kwdefaults__ = original.__kwdefaults__
        # Kept before the functions that it calls are copied: it may call itself.
        self._keep(original, copy)
        for cell, original_cell in zip(cells, original.__closure__ or (), strict=True):
            with suppress(ValueError):  # an empty cell stays empty
                cell.cell_contents = self.of(original_cell.cell_contents)
        namespace.update({n: self.of(names[n]) for n in _names(original.__code__) & names.keys()})
        return copy

    def _import(self, *args: Any, **options: Any) -> Any:
        return self.of(builtins.__import__(*args, **options))

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
                for name, member in vars(base).items():
                    # Properties are computed by the original: they do not see the arguments of methods.
                    is_method = isinstance(member, FunctionType | staticmethod | classmethod)
                    if name not in NOT_COPIED and (is_method or not hasattr(member, "__get__")):
                        setattr(last, name, self.of(member))
        members = {
            "__class__": property(lambda _: type(original)),  # for isinstance()
            "__getattr__": lambda _, name: getattr(original, name),
        }
        stand_in: Any = object.__new__(type("StandIn", (last,), members))
        self._keep(original, stand_in)
        attributes = getattr(original, "__dict__", {})
        vars(stand_in).update({name: self.of(value) for name, value in attributes.items()})
        return stand_in


def _package(module: str | None) -> str:
    return (module or "").partition(".")[0]


def _is_copied(module: str | None) -> bool:
    """Whether code of a module is copied."""
    return _package(module) not in LEFT_AS_THEY_ARE


def _names(code: CodeType) -> set[str]:
    """The global names that code reads, nested functions included; and some names of attributes."""
    inner = (_names(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inner)
