"""What an environment remembers outside of MuJoCo: attributes that change from step to step.

They are found by comparison, and become columns of numbers, so that many copies can take turns in one
environment.
"""

from __future__ import annotations

import math
import pickle
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from types import FunctionType, GeneratorType, MethodType, ModuleType
from typing import Any

import numpy as np

from hyrl_mj.environments.opening import layers
from hyrl_mj.errors import BadInput

# Objects of these modules hold no memory of an environment, or it is in MuJoCo's state.
PASSED = (
    "mujoco", "dm_control.mujoco", "dm_control.mjcf", "dm_control.rl.specs", "dm_env", "OpenGL",
    "gymnasium.spaces", "gymnasium.envs.registration", "gymnasium.envs.mujoco.mujoco_rendering", "torch",
    "lxml", "xml", "hyrl_mj.plant", "hyrl_mj.tasks",
)  # fmt: skip
# Attributes that hold the arguments of a constructor.
COPIES = ("_ezpickle_args", "_ezpickle_kwargs", "_saved_kwargs")
# How deep attributes of attributes are looked at, and how long a sequence may be.
DEEPEST, LONGEST = 8, 1_000
Path = tuple[tuple[str, Any], ...]


class _Opaque:
    """A value that is no number: it can be compared, as far as it can be written down, but not be set."""

    def __init__(self, value: Any):
        self.kind = type(value).__name__
        try:
            self.content: Any = pickle.dumps(value)
        except Exception:  # whatever a foreign class raises
            self.content = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Opaque) and (self.kind, self.content) == (
            other.kind,
            other.content,
        )

    __hash__ = None  # type: ignore[assignment]


class _Generator(_Opaque):
    """A generator of random numbers."""

    def __init__(self, value: Any):
        self.kind, bits = type(value).__name__, getattr(value, "bit_generator", None)
        self.content = pickle.dumps(value.get_state() if bits is None else bits.state)


Value = None | float | np.ndarray | str | _Opaque


def remembered(root: Any) -> dict[Path, Value]:
    """Returns the values of all attributes of an environment, and of what they hold, by their paths."""
    found: dict[Path, Value] = {}
    seen: set[int] = set()
    for path, value in _walk(root, (), seen):
        found[path] = value
    return found


def generators(root: Any) -> list[Path]:
    """Returns the paths of the generators of random numbers that an environment has."""
    return [path for path, value in remembered(root).items() if isinstance(value, _Generator)]


def state_of_generator(root: Any, path: Path) -> bytes | None:
    """Returns the state of the generator at a path, to compare it; None if there is none now."""
    value = _get(*_place(root, path))
    return None if value is None else _Generator(value).content


def hiding(env: Any) -> list[str]:
    """Returns the attributes of an environment and its wrappers that may hold a memory that cannot be read.

    These are generators, and functions with variables of their own.
    """
    return [
        name
        for layer in layers(env)
        for name, value in vars(layer).items()
        if isinstance(value, GeneratorType) or getattr(value, "__closure__", None)
    ]


def name_of(path: Path) -> str:
    """Returns the name of a path as one writes it in Python, without the environment: "goal[0]"."""
    words = [f".{key}" if kind == "attribute" else f"[{key!r}]" for kind, key in path]
    return "".join(words).removeprefix(".")


def _walk(value: Any, path: Path, seen: set[int]) -> Iterator[tuple[Path, Value]]:
    if value is None or isinstance(value, str):
        yield path, value
    elif isinstance(value, bool | int | float | np.number | np.bool_):
        yield path, float(value)
    elif isinstance(value, np.ndarray):
        yield path, value.copy() if value.dtype.kind in "biuf" else _Opaque(value)
    elif isinstance(value, np.random.Generator | np.random.RandomState):
        yield path, _Generator(value)
    elif _has_no_memory(value) or id(value) in seen or len(path) > DEEPEST:
        return
    elif isinstance(value, tuple) and _are_numbers(value):
        yield path, np.array(value, dtype=float)
    elif isinstance(value, list | tuple | deque):
        seen.add(id(value))
        yield (*path, ("length", "len")), float(len(value))
        for i, item in enumerate(list(value)[:LONGEST]):
            yield from _walk(item, (*path, ("item", i)), seen)
    elif isinstance(value, Mapping):
        seen.add(id(value))
        yield (*path, ("length", "len")), float(len(value))
        for key, item in list(value.items())[:LONGEST]:
            yield from _walk(item, (*path, ("item", key)), seen)
    elif hasattr(value, "__dict__"):
        seen.add(id(value))
        for name, item in list(vars(value).items()):
            if name in COPIES:
                continue
            yield from _walk(item, (*path, ("attribute", name)), seen)
    else:
        yield path, _Opaque(value)


def _has_no_memory(value: Any) -> bool:
    kinds = (type, FunctionType, MethodType, ModuleType, property, staticmethod, classmethod)
    module = type(value).__module__ or ""
    return isinstance(value, kinds) or any(
        module == name or module.startswith(f"{name}.") for name in PASSED
    )


def _are_numbers(values: Sequence[Any]) -> bool:
    return bool(values) and all(isinstance(v, bool | int | float | np.number) for v in values)


def same(a: Value, b: Value) -> bool:
    """Returns whether two values are equal; numbers that are not finite equal themselves."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (a != a and b != b)
    return type(a) is type(b) and bool(a == b)


@dataclass(frozen=True)
class Slot:
    """An attribute that changes from step to step.

    Attributes:
        path: where it is.
        shape: of its numbers.
        may_be_none: whether it is None at times, as before the first step.
    """

    path: Path
    shape: tuple[int, ...]
    may_be_none: bool

    @cached_property  # asked for in each step of each copy
    def size(self) -> int:
        return math.prod(self.shape) + self.may_be_none

    def read(self, root: Any) -> np.ndarray:
        """Returns its value in an environment as numbers (size,)."""
        value = _get(*_place(root, self.path))
        if value is None:
            return np.zeros(self.size)
        numbers = np.ravel(value)
        return np.append(numbers, 1.0) if self.may_be_none else numbers

    def write(self, root: Any, row: np.ndarray) -> None:
        """Gives it the value of numbers (size,) in an environment."""
        holder, step = _place(root, self.path)
        old = _get(holder, step)
        if self.may_be_none and not row[-1]:
            if old is not None:
                _set(holder, step, None)
            return
        values = row[: self.size - self.may_be_none]
        if isinstance(old, np.ndarray) and old.flags.writeable and old.shape == self.shape:
            old[...] = values.reshape(self.shape)
        elif isinstance(old, tuple):
            _set(holder, step, tuple(type(a)(b) for a, b in zip(old, values, strict=True)))
        elif not self.shape:
            kind = float if old is None else type(old)
            _set(holder, step, kind(values[0]))
        else:
            _set(holder, step, values.reshape(self.shape).copy())


def _place(root: Any, path: Path) -> tuple[Any, tuple[str, Any]]:
    holder = root
    for step in path[:-1]:
        holder = _get(holder, step)
    return holder, path[-1]


def _get(holder: Any, step: tuple[str, Any]) -> Any:
    kind, key = step
    return vars(holder)[key] if kind == "attribute" else holder[key]


def _set(holder: Any, step: tuple[str, Any], value: Any) -> None:
    kind, key = step
    if kind == "attribute":
        vars(holder)[key] = value
    else:
        holder[key] = value


def changing(episodes: Sequence[Sequence[dict[Path, Value]]], owner: str) -> tuple[Slot, ...]:
    """Returns the attributes that change during episodes, given what was remembered after each step.

    Raises:
        BadInput: one of them is no number, or does not keep its shape; or numbers are drawn at random.
    """
    slots: dict[Path, Slot] = {}
    paths = dict.fromkeys(path for episode in episodes for moment in episode for path in moment)
    for path in paths:
        values = [[moment.get(path) for moment in episode] for episode in episodes]
        if all(same(a, b) for row in values for a, b in pairwise(row)):
            continue
        flat = [value for row in values for value in row]
        name = name_of(tuple(step for step in path if step[0] != "length"))
        numbers = [np.asarray(v) for v in flat if isinstance(v, float | np.ndarray)]
        shapes = {value.shape for value in numbers}
        other = [
            value for value in flat if not (value is None or isinstance(value, float | np.ndarray))
        ]
        if other or len(shapes) != 1 or path[-1][0] == "length":
            kind = next(
                (v.kind for v in other if isinstance(v, _Opaque)), "a value that changes its shape"
            )
            raise BadInput(
                f"{owner} remembers something in {name} ({kind}) that cannot be copied, so its state does "
                "not tell what comes next: leave the wrapper out, or let it keep numbers or arrays"
            )
        slots[path] = Slot(path, shapes.pop(), len(numbers) < len(flat))
    return tuple(slots.values())
