"""Numbers and texts that an environment holds in attributes: found by name, and set."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import suppress
from numbers import Number
from typing import Any

import numpy as np

from hyrl_mj.gym_import.fingerprint import (
    DEEPEST,
    FUNCTIONS,
    attributes_of,
    has_no_memory,
    is_of_torch,
)
from hyrl_mj.gym_import.opening import physics_of


def held(inner: Any) -> Iterator[tuple[str, Any, Any, np.ndarray, list[str]]]:
    """Yields numbers (k,) and texts in attributes, also within objects, with their names, owners and keys.

    Views of MuJoCo's arrays are left out, as what they show is its state.
    """
    seen, (_, data) = {id(inner)}, physics_of(inner) or (None, None)
    begins = data.qpos.ctypes.data if data else 0
    state = range(begins, begins + (data.nbuffer if data else 0))  # where MuJoCo keeps it
    yield from _within(inner, attributes_of(inner), "", seen, state)


def _within(
    owner: Any, parts: Mapping[Any, Any], path: str, seen: set[int], state: range, depth: int = 0
) -> Iterator[tuple[str, Any, Any, np.ndarray, list[str]]]:
    """Yields what `held` does, of the parts of an owner by their keys."""
    for key, value in parts.items():
        if isinstance(value, np.ndarray) and value.ctypes.data in state:
            continue
        if (found := taken_apart(value)) is not None:
            holder = vars(owner) if key in getattr(owner, "__dict__", ()) else owner
            yield f"{path}{key}", holder, key, *found
        elif depth < DEEPEST and id(value) not in seen:
            seen.add(id(value))
            within: Mapping[Any, Any] = {}
            if isinstance(value, tuple | deque):
                value = [*value]
            if isinstance(value, dict):
                within = dict(value)
            elif isinstance(value, list):
                within = dict(enumerate(value))
            elif not (isinstance(value, FUNCTIONS) or has_no_memory(value)):
                within = attributes_of(value)
            yield from _within(value, within, f"{path}{key}.", seen, state, depth + 1)


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


def taken_apart(value: Any) -> tuple[np.ndarray, list[str]] | None:
    """Returns the numbers (k,) and the texts that a value holds; None of what holds something else."""
    found = list[Any]()
    try:
        _take(value, found)
        numbers = np.array([part for part in found if not isinstance(part, str)], dtype=float)
    except Exception:  # it is more, or whatever a foreign class raises
        return None
    return numbers, [part for part in found if isinstance(part, str)]


def _take(value: Any, found: list[Any]) -> None:
    """Adds the numbers and texts of a value to a list; raises TypeError if it holds something else."""
    if is_of_torch(value, "Tensor"):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biufcSU":
        value = value.ravel().tolist()
    if isinstance(value, dict):
        found += [key for key in value if isinstance(key, str)]
        value = [*value.values()]
    if isinstance(value, list | tuple | deque):
        for part in value:
            _take(part, found)
    elif isinstance(value, Set):
        found += sorted(part for part in value if isinstance(part, str))
    elif isinstance(value, complex):
        found += value.real, value.imag
    elif isinstance(value, str | Number):
        found.append(value)
    elif not isinstance(value, bytes | None | np.bool_):
        raise TypeError


def settings_of(env: Any) -> dict[str, bytes]:
    """Returns the numbers and texts that attributes of an environment and its wrappers hold, by name.

    They are written down to be compared, also on another machine: numbers are rounded, and names of files
    are left out.
    """
    found = {}
    for name, _, _, numbers, texts in held(env):
        words = [text for text in texts if os.sep not in text]
        with np.errstate(over="ignore"):
            found[name] = ascii(words).encode() + numbers.astype("<f4").tobytes()
    return found


def numbers_of(value: Any) -> np.ndarray | None:
    """Returns the numbers (k,) that a value holds; None if it holds none, or is more than a value."""
    parts = taken_apart(value)
    return parts[0] if parts is not None and len(parts[0]) else None


def numbers_in(inner: Any) -> dict[str, np.ndarray]:
    """Returns the numbers (k,) that attributes of an environment hold, by name."""
    return {name: numbers for name, _, _, numbers, _ in held(inner) if len(numbers)}


def set_numbers(inner: Any, values: Mapping[str, np.ndarray]) -> None:
    """Sets attributes of an environment to numbers (k,), by name; what is NaN stays as it is."""
    for name, owner, key, numbers, _ in [*held(inner)]:
        if name in values:
            put_numbers(owner, key, np.where(np.isnan(values[name]), numbers, values[name]))


def put_numbers(owner: Any, key: Any, numbers: np.ndarray) -> None:
    """Puts numbers (k,) into the value that `value_at` finds, which keeps its form."""
    old = value_at(owner, key)
    if isinstance(old, np.ndarray) and old.flags.writeable and old.dtype.kind == "f":
        old[...] = numbers.reshape(old.shape)  # it may be known by several names
    else:
        put_at(owner, key, like(old, numbers))


def like(old: Any, numbers: Iterable[Any]) -> Any:
    """Returns what has the form of a value, of the next of some numbers."""
    numbers = iter(numbers)
    if isinstance(old, dict):
        return {key: like(part, numbers) for key, part in old.items()}
    if isinstance(old, list | tuple | deque):
        parts = [like(part, numbers) for part in old]
        return type(old)(*parts) if hasattr(old, "_fields") else type(old)(parts)
    if is_of_torch(old, "Tensor"):
        return old.new_tensor(like(old.detach().cpu().numpy(), numbers))
    if isinstance(old, np.ndarray):
        values = np.array(like(old.ravel().tolist(), numbers)).reshape(old.shape)
        return values if _are_parts(values, old.dtype) else values.astype(old.dtype)
    if isinstance(old, complex):
        return type(old)(complex(next(numbers), next(numbers)))
    if not isinstance(old, Number):
        return old
    number: Any = next(numbers)
    kind: Any = type(old)
    return number if _are_parts(number, kind) else kind(number)


def _are_parts(numbers: Any, kind: Any) -> bool:
    """Returns whether numbers are not those that a kind of whole numbers holds."""
    return np.issubdtype(kind, np.integer) and not np.array_equal(numbers, np.rint(numbers))
