"""Observations as vectors, and what computes them in an environment."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

# The names under which environments compute their observations.
OBSERVER = re.compile(r"_?((get|compute|make|build)_?)?(ob|obs|observe|observation)s?")


def parts_of(space: spaces.Space[Any]) -> dict[str, Any]:
    """Returns the parts of a space of observations by name, in their order; of a vector it is one part."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}


def columns_of(space: spaces.Space[Any]) -> dict[str, slice]:
    """Returns the columns of each part of a space of observations, by name."""
    found, at = {}, 0
    for name, part in parts_of(space).items():
        size = int(spaces.flatdim(part))
        found[name], at = slice(at, at + size), at + size
    return found


def flat(observation: Any, space: spaces.Space[Any]) -> np.ndarray:
    """Returns an observation as a vector, as SB3 does: the parts of a Dict in the order of its space.

    That of an environment within wrappers may be a Tuple, or have parts within parts.
    """
    if parts := _keyed(space):
        return np.concatenate([flat(observation[k], part) for k, part in parts], dtype=float)
    return np.array(observation, dtype=float).ravel()


def unlike(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns where two observations differ, (o,) bool; NaN does not differ from NaN."""
    return np.asarray((a != b) & ~(np.isnan(a) & np.isnan(b)))


def _keyed(space: spaces.Space[Any]) -> list[tuple[Any, Any]]:
    """Returns the parts of a Dict or a Tuple with the keys by which observations hold them."""
    if isinstance(space, spaces.Dict):
        return [*space.spaces.items()]
    return [*enumerate(space.spaces)] if isinstance(space, spaces.Tuple) else []


def shaped(vector: np.ndarray, like: Any, space: spaces.Space[Any]) -> Any:
    """Returns a vector as an observation of the shape and types of another one."""
    if not (parts := _keyed(space)):
        array = np.asarray(like)
        values = vector.astype(array.dtype).reshape(array.shape)
        return type(like)(values.tolist()) if type(like) in (list, tuple) else values
    ends = np.cumsum([flat(like[key], part).size for key, part in parts])
    vectors = np.split(vector, ends[:-1])
    found = {key: shaped(v, like[key], part) for v, (key, part) in zip(vectors, parts, strict=True)}
    if isinstance(space, spaces.Tuple):
        return tuple(found.values())
    return {key: found[key] for key in like if key in found}


def observers(env: gym.Env) -> dict[str, Callable[[], Any]]:
    """Returns functions that may compute the observation of the innermost environment, by name."""
    inner: Any = env.unwrapped
    found: dict[str, Callable[[], Any]] = {}
    for name, get in _observers_of(inner).items():
        found[name] = get
        # An environment around another one, as PointMaze: it takes what the inner one observes.
        for part_name, part in vars(inner).items():
            if isinstance(part, gym.Env):
                for own_name, own in _observers_of(part).items():
                    found[f"{name}({part_name}.{own_name})"] = partial(_through, get, own)
    control: Any = getattr(inner, "_env", None)  # of dm_control
    if hasattr(getattr(control, "task", None), "get_observation"):
        found["task.get_observation"] = lambda: control.task.get_observation(control.physics)
    return found


def _observers_of(owner: Any) -> dict[str, Callable[..., Any]]:
    names = sorted(name for name in dir(type(owner)) if OBSERVER.fullmatch(name))
    return {name: get for name in names if callable(get := getattr(owner, name, None))}


def _through(get: Callable[[Any], Any], own: Callable[[], Any]) -> Any:
    """Returns what an environment observes of what the one within it does, which may come with an info."""
    result = own()
    return get(result[0] if isinstance(result, tuple) else result)
