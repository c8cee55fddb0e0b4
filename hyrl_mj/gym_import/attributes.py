"""Numbers and words that an environment holds in `info` and attributes: found by name, and set."""

from __future__ import annotations

import copyreg
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from hyrl_mj.gym_import.fingerprint import DEEPEST, FUNCTIONS, has_no_memory


def held(inner: Any, info: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yields name, owner and key of numbers and words in `info` and in attributes, also within objects.

    What an owner holds, `value_at` gives.
    """
    seen = {id(inner)}
    for kind, owner in (("info", info), ("attribute", getattr(inner, "__dict__", {}))):
        yield from _within(owner, f"{kind} ", seen, 0)


def _within(owner: Any, path: str, seen: set[int], depth: int) -> Iterator[tuple[str, Any, Any]]:
    """Yields names, owners and keys of what a dictionary, a list, or an object with slots holds."""
    if isinstance(owner, dict):
        parts = [*owner.items()]
    elif isinstance(owner, list):
        parts = [*enumerate(owner)]
    else:
        parts = [(name, getattr(owner, name)) for name in _slots(owner) if hasattr(owner, name)]
    for key, value in parts:
        if isinstance(value, str) or numbers_of(value) is not None:
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
                yield from _within(within, f"{path}{key}.", seen, depth + 1)


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


def numbers_of(value: Any) -> np.ndarray | None:
    """Returns the numbers (k,) that a value is, or all parts of a collection are; None if it holds others."""
    if isinstance(value, dict):
        value = [*value.values()]
    if isinstance(value, list | tuple | deque):
        parts = [numbers_of(part) for part in value]
        numbers = [part for part in parts if part is not None]
        return np.concatenate(numbers) if 0 < len(numbers) == len(parts) else None
    if not isinstance(value, int | float | np.generic | np.ndarray):
        return None
    array = np.asarray(value)
    return array.ravel().astype(float) if array.dtype.kind in "biuf" else None


def numbers_in(inner: Any) -> dict[str, np.ndarray]:
    """Returns the numbers (k,) that attributes of an environment hold, by name."""
    return {name: numbers for name, _, _, numbers in _numbers(inner)}


def set_numbers(inner: Any, values: Mapping[str, np.ndarray]) -> None:
    """Sets attributes of an environment to numbers (k,), by name; what is NaN stays as it is."""
    for name, owner, key, numbers in [*_numbers(inner)]:
        if name in values:
            old, new = value_at(owner, key), np.where(np.isnan(values[name]), numbers, values[name])
            if isinstance(old, np.ndarray) and old.flags.writeable:
                old[...] = new.reshape(old.shape)  # it may be known by several names
            else:
                put_at(owner, key, like(old, new))


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
    if isinstance(old, np.ndarray):
        values = np.array([next(numbers) for _ in range(old.size)]).reshape(old.shape)
        return values if _are_parts(values, old.dtype) else values.astype(old.dtype)
    number = next(numbers)
    return number if _are_parts(number, type(old)) else type(old)(number)


def _are_parts(numbers: Any, kind: Any) -> bool:
    """Returns whether numbers are not those that a kind of whole numbers holds."""
    return np.issubdtype(kind, np.integer) and not np.array_equal(numbers, np.rint(numbers))
