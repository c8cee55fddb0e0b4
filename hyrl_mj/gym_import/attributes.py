"""Numbers and words that an environment holds in `info` and attributes: found by name, and set."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from hyrl_mj.gym_import.fingerprint import DEEPEST, FUNCTIONS, has_no_memory


def held(inner: Any, info: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yields name, owner and key of numbers and words in `info` and in attributes, also within objects."""
    seen = {id(inner)}
    for kind, owner in (("info", info), ("attribute", getattr(inner, "__dict__", {}))):
        yield from _within(owner, f"{kind} ", seen, 0)


def _within(owner: Any, path: str, seen: set[int], depth: int) -> Iterator[tuple[str, Any, Any]]:
    """Yields names, owners and keys of what a dictionary or a list holds, as `held` does."""
    for key, value in [*owner.items()] if isinstance(owner, dict) else [*enumerate(owner)]:
        if isinstance(value, str) or numbers_of(value) is not None:
            yield f"{path}{key}", owner, key
        elif depth < DEEPEST and id(value) not in seen:
            seen.add(id(value))
            parts = value
            if isinstance(value, tuple | deque):
                parts = [*value]
            elif not isinstance(value, dict | list):
                passed = isinstance(value, FUNCTIONS) or has_no_memory(value)
                parts = {} if passed else getattr(value, "__dict__", {})
            yield from _within(parts, f"{path}{key}.", seen, depth + 1)


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
            old, new = owner[key], np.where(np.isnan(values[name]), numbers, values[name])
            if isinstance(old, np.ndarray) and old.flags.writeable:
                old[...] = new.reshape(old.shape)  # it may be known by several names
            else:
                owner[key] = like(old, new)


def _numbers(inner: Any) -> Iterator[tuple[str, Any, Any, np.ndarray]]:
    for name, owner, key in held(inner, {}):
        if (numbers := numbers_of(owner[key])) is not None:
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
