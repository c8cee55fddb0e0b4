"""Values that an environment holds in `info` and attributes: found by name, and set."""

from __future__ import annotations

import copyreg
import os
import pickle
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import suppress
from numbers import Number
from types import BuiltinFunctionType
from typing import Any

import numpy as np

from hyrl_mj.gym_import.fingerprint import (
    DEEPEST,
    FUNCTIONS,
    GENERATORS,
    has_no_memory,
    is_of_torch,
)
from hyrl_mj.gym_import.opening import physics_of


def held(inner: Any, info: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yields name, owner and key of values in `info` and in attributes, also within objects.

    Views of MuJoCo's arrays are left out, as what they show is its state.
    What an owner holds, `value_at` gives.
    """
    seen, (_, data) = {id(inner)}, physics_of(inner) or (None, None)
    begins = data.qpos.ctypes.data if data else 0
    state = range(begins, begins + (data.nbuffer if data else 0))  # where MuJoCo keeps it
    for kind, owner in (("info", info), ("attribute", getattr(inner, "__dict__", {}))):
        yield from _within(owner, f"{kind} ", seen, state, 0)


def _within(
    owner: Any, path: str, seen: set[int], state: range, depth: int
) -> Iterator[tuple[str, Any, Any]]:
    """Yields names, owners and keys of what a dictionary, a list, or an object with slots holds."""
    if isinstance(owner, dict):
        parts = [*owner.items()]
    elif isinstance(owner, list):
        parts = [*enumerate(owner)]
    else:
        parts = [(name, getattr(owner, name)) for name in _slots(owner) if hasattr(owner, name)]
    for key, value in parts:
        if isinstance(value, np.ndarray) and value.ctypes.data in state:
            continue
        if taken_apart(value) is not None:
            yield f"{path}{key}", owner, key
        elif depth < DEEPEST and id(value) not in seen:
            seen.add(id(value))
            owners = [value]
            if isinstance(value, tuple | deque):
                owners = [[*value]]
            elif not isinstance(value, dict | list):
                passed = isinstance(value, FUNCTIONS) or has_no_memory(value)
                owners = [] if passed else [getattr(value, "__dict__", {}), value]
            for within in owners:
                yield from _within(within, f"{path}{key}.", seen, state, depth + 1)


def _slots(value: Any) -> list[str]:
    """Returns the names of the attributes of an object that its `__dict__` does not hold."""
    return copyreg._slotnames(type(value))  # type: ignore[attr-defined]


def value_at(owner: Any, key: Any) -> Any:
    """Returns what a dictionary, a list or an object holds under a key or a name."""
    return owner[key] if isinstance(owner, dict | list) else getattr(owner, key)


def put_at(owner: Any, key: Any, value: Any) -> None:
    """Puts a value where `value_at` finds it; what does not change stays."""
    if isinstance(owner, dict | list):
        owner[key] = value
    else:
        with suppress(AttributeError):  # it is frozen
            setattr(owner, key, value)


def taken_apart(value: Any) -> tuple[np.ndarray, Any] | None:
    """Returns the numbers (k,) that a value holds, and what is left of it, to compare it.

    None of what holds an object with attributes, a function, or something that cannot be written down.
    """
    numbers = list[np.ndarray]()
    try:
        rest = _rest(value, numbers)
    except Exception:  # whatever a foreign class raises
        return None
    return np.concatenate([np.empty(0), *numbers]), rest


def _rest(value: Any, numbers: list[np.ndarray]) -> Any:
    """Returns what is left of a value without its numbers, which are added to a list of arrays (k,)."""
    if is_of_torch(value, "Tensor"):
        value = value.detach().cpu().numpy()
    if isinstance(value, Number) and not isinstance(value, complex | np.generic):
        value = np.array(float(value))  # type: ignore[arg-type]
    if isinstance(value, complex | np.generic | np.ndarray):
        array = np.asarray(value)
        if array.dtype.kind in "biufc":
            is_complex = array.dtype.kind == "c"
            flat = np.stack([array.real, array.imag], axis=-1) if is_complex else array
            numbers.append(flat.ravel().astype(float))
            return array.shape
        return [array.shape, _rest(array.ravel().tolist(), numbers)]
    if isinstance(value, dict):
        return [(_rest([key], []), key, _rest(part, numbers)) for key, part in value.items()]
    if isinstance(value, list | tuple | deque):
        return [_rest(part, numbers) for part in value]
    if isinstance(value, Set):
        return [frozenset(value), _rest([*value], [])]
    has_more = isinstance(value, (FUNCTIONS, BuiltinFunctionType, *GENERATORS)) or _slots(value)
    if has_more or hasattr(value, "__dict__") or has_no_memory(value):
        raise TypeError("it is more than a value")
    return value if isinstance(value, str | bytes | None) else pickle.dumps(value)


def settings_of(env: Any) -> dict[str, bytes]:
    """Returns the numbers and texts that attributes of an environment and its wrappers hold, by name.

    They are written down to be compared, also on another machine: numbers are rounded, and names of files
    are left out.
    """
    found = {}
    for name, owner, key in held(env, {}):
        numbers, rest = taken_apart(value_at(owner, key)) or (np.empty(0), None)
        with np.errstate(over="ignore"):
            found[name] = ascii(_texts(rest)).encode() + numbers.astype("<f4").tobytes()
    return found


def _texts(rest: Any) -> list[str]:
    """Returns the texts in what is left of a value, but for names of files."""
    if isinstance(rest, str):
        return [] if os.sep in rest else [rest]
    return [t for part in rest for t in _texts(part)] if isinstance(rest, list | tuple) else []


def numbers_of(value: Any) -> np.ndarray | None:
    """Returns the numbers (k,) that a value holds; None if it holds none, or is more than a value."""
    parts = taken_apart(value)
    return parts[0] if parts is not None and len(parts[0]) else None


def numbers_in(inner: Any) -> dict[str, np.ndarray]:
    """Returns the numbers (k,) that attributes of an environment hold, by name."""
    return {name: numbers for name, _, _, numbers in _numbers(inner)}


def set_numbers(inner: Any, values: Mapping[str, np.ndarray]) -> None:
    """Sets attributes of an environment to numbers (k,), by name; what is NaN stays as it is."""
    for name, owner, key, numbers in [*_numbers(inner)]:
        if name in values:
            put_numbers(owner, key, np.where(np.isnan(values[name]), numbers, values[name]))


def put_numbers(owner: Any, key: Any, numbers: np.ndarray) -> None:
    """Puts numbers (k,) into the value that `value_at` finds, which keeps its form."""
    old = value_at(owner, key)
    if isinstance(old, np.ndarray) and old.flags.writeable and old.dtype.kind == "f":
        old[...] = numbers.reshape(old.shape)  # it may be known by several names
    else:
        put_at(owner, key, like(old, numbers))


def _numbers(inner: Any) -> Iterator[tuple[str, Any, Any, np.ndarray]]:
    for name, owner, key in held(inner, {}):
        if (numbers := numbers_of(value_at(owner, key))) is not None:
            yield name.removeprefix("attribute "), owner, key, numbers


def like(old: Any, numbers: Iterable[Any]) -> Any:
    """Returns what has the form of a value, of the next of some numbers."""
    numbers = iter(numbers)
    if isinstance(old, dict):
        return {key: like(part, numbers) for key, part in old.items()}
    if isinstance(old, tuple) and hasattr(old, "_fields"):
        return type(old)(*(like(part, numbers) for part in old))
    if isinstance(old, list | tuple | deque):
        return type(old)(like(part, numbers) for part in old)
    if is_of_torch(old, "Tensor"):
        return old.new_tensor(like(old.detach().cpu().numpy(), numbers))
    if isinstance(old, np.ndarray):
        if old.dtype.kind not in "biufc":
            found = old.copy()
            found.ravel()[:] = like(old.ravel().tolist(), numbers)
            return found
        values = np.array([like(one, numbers) for one in old.ravel().tolist()]).reshape(old.shape)
        return values if _are_parts(values, old.dtype) else values.astype(old.dtype)
    if isinstance(old, complex | np.complexfloating):
        return type(old)(complex(next(numbers), next(numbers)))
    if not isinstance(old, Number):
        return old
    number: Any = next(numbers)
    kind: Any = type(old)
    return number if _are_parts(number, kind) else kind(number)


def _are_parts(numbers: Any, kind: Any) -> bool:
    """Returns whether numbers are not those that a kind of whole numbers holds."""
    return np.issubdtype(kind, np.integer) and not np.array_equal(numbers, np.rint(numbers))
