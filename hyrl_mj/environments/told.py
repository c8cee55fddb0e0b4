"""A trial of wrappers: whether they observe the place of the robot by a way that noise does not take."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from hyrl_mj.environments.instance import Instance
from hyrl_mj.environments.specification import EnvironmentSpec
from hyrl_mj.errors import BadInput

# Places on the chart, and samples of the runs from there.
PLACES, SAMPLES = 6, 2
# What changes by this share of a displacement follows the place [share].
FOLLOWS = 0.01

# What an environment tells beside its observation, by name.
Told = dict[str, Any]


def check_told(spec: EnvironmentSpec, step: np.ndarray) -> None:
    """Raises `BadInput` if wrappers observe what `info` or attributes of the environment tell of the place.

    Runs are played from places on the chart, and from places that are displaced. What the environment tells
    in the latter is then put into the former, whose observation has to stay the same.

    Args:
        spec: what is known of the environment.
        step: (d,) displacement of the chart's coordinates.
    """
    rng = np.random.default_rng(9)
    least = FOLLOWS * float(step[step > 0].min(initial=np.inf))
    usual, other = Instance(spec), Instance(spec)
    for z in rng.uniform(spec.start_low, spec.start_high, (PLACES, spec.dimension)):
        inputs = [usual.drawn(rng) for _ in range(SAMPLES)]
        state, displaced = spec.state_at(np.array([z, z + step]))
        plain, displacedly = (
            _run(one, at, inputs) for one, at in ((usual, state), (other, displaced))
        )
        if len(plain) != len(displacedly):
            continue
        follow = [
            {name: there[name] for name in here if _far(here[name], there.get(name), least)}
            for (_, here), (_, there) in zip(plain, displacedly, strict=True)
        ]
        if not any(follow):
            continue
        changed = _run(Instance(spec), state, inputs, follow)
        for (seen, _), (now, _), names in zip(plain, changed, follow, strict=False):
            if not np.array_equal(seen, now, equal_nan=True):
                raise BadInput(
                    f"a wrapper of {spec.name} observes {' or '.join(names)}, which follows the place and "
                    "which noise does not reach: let it observe what the environment observes"
                )
            if names:
                break  # from here on the run may be another one


def _run(
    instance: Instance,
    start: np.ndarray,
    inputs: list[np.ndarray],
    changes: list[Told] | None = None,
) -> list[tuple[np.ndarray, Told]]:
    """Returns what is observed (o,) and told at the start of a run and after each sample.

    Args:
        instance: plays the run.
        start: MuJoCo's state (S,).
        inputs: (m,) of each sample.
        changes: what the environment is made to tell instead, by sample.
    """
    told: list[Told] = []

    def tamper(rest: tuple[Any, ...]) -> tuple[Any, ...]:
        found = _told(instance.inner, rest[-1])
        new = {} if changes is None else changes[len(told)]
        told.append(found)
        info = dict(rest[-1])
        for name, value in new.items():
            kind, key = name.split(" ", 1)
            if kind == "info":
                info[key] = copy.deepcopy(value)
            else:
                setattr(instance.inner, key, copy.deepcopy(value))
        return (*rest[:-1], info)

    instance.quit()
    instance.tamper(tamper)
    none, found = np.zeros(instance.spec.dimension), []
    instance.begin(start)
    instance.sense(none)
    found.append((instance.observation, told[-1]))
    for u in inputs:
        if instance.report[1] or instance.report[2]:
            break
        instance.act(u)
        instance.sense(none)
        found.append((instance.observation, told[-1]))
    return found


def _told(inner: Any, info: Any) -> Told:
    """Returns the numbers in `info` and in attributes of an environment, not those of its objects."""
    attributes = dict(getattr(inner, "__dict__", {}))
    found = {f"info {key}": value for key, value in dict(info).items()}
    found |= {f"attribute {key}": value for key, value in attributes.items()}
    return {name: copy.deepcopy(value) for name, value in found.items() if _is_numeric(value)}


def _is_numeric(value: Any) -> bool:
    """Returns whether a value is a number, an array of them, or a dictionary of such values."""
    if isinstance(value, dict):
        return bool(value) and all(map(_is_numeric, value.values()))
    if not isinstance(value, int | float | np.number | np.ndarray | list | tuple):
        return False
    try:
        return np.asarray(value).dtype.kind in "iuf"
    except ValueError:  # lists of different lengths
        return False


def _far(here: Any, there: Any, least: float) -> bool:
    """Returns whether two values differ by as much as what follows the place does."""
    if isinstance(here, dict):
        same = isinstance(there, dict) and here.keys() == there.keys()
        return same and any(_far(value, there[key], least) for key, value in here.items())
    if there is None or isinstance(there, dict) or np.shape(here) != np.shape(there):
        return False
    return bool(np.abs(np.subtract(here, there, dtype=float)).max(initial=0.0) >= least)
