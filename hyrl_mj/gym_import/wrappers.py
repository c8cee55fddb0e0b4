"""Trials of wrappers: by which ways, past the noise, they observe the place of the robot."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.fingerprint import DEEPEST, FUNCTIONS, differing, has_no_memory
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, PLACES, SAMPLES

# What changes by this share of a displacement follows the place [share].
FOLLOWS = 0.01

# What an environment tells beside its observation, by name.
Told = dict[str, Any]


class Seen(NamedTuple):
    """A sample of a run: the observation (o,), the report (r,), and what the environment told wrappers."""

    observation: np.ndarray
    report: np.ndarray
    told: Told


def changes_by_reset(spec: EnvironmentSpec) -> bool:
    """Returns whether the start of a run is another one after a reset before, as with running statistics."""
    found = []
    for resets in (0, 0, 1):
        instance = Instance(spec)
        for _ in range(resets):
            instance.reset()
        observation = instance.put(spec.state)
        found.append((observation, instance.remembered()))
    usual = set(differing(found[0][1], found[1][1]))  # such as names of files
    changed = set(differing(found[0][1], found[2][1])) - usual
    return bool(changed) or not np.array_equal(found[0][0], found[2][0], equal_nan=True)


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
    for z in rng.uniform(spec.start_low, spec.start_high, (6, spec.dimension)):
        inputs, none = [usual.drawn(rng) for _ in range(2)], np.zeros((3, spec.dimension))
        state, displaced = spec.state_at(np.array([z, z + step]))
        plain = _run(usual, state, inputs, none)
        elsewhere = _run(other, displaced, inputs, none)
        if len(plain) != len(elsewhere):
            continue
        follow = [
            {name: there.told[name] for name in here.told if _far(name, here, there, least)}
            for here, there in zip(plain, elsewhere, strict=True)
        ]
        if not any(follow):
            continue
        changed = _run(Instance(spec), state, inputs, none, changes=follow)
        for seen, now, names in zip(plain, changed, follow, strict=False):
            if not np.array_equal(seen.observation, now.observation, equal_nan=True):
                raise BadInput(
                    f"a wrapper of {spec.name} observes {' or '.join(names)}, which follows the place and "
                    "which noise does not reach: let it observe what the environment observes"
                )
            if names:
                break  # from here on the run may be another one


def senses(spec: EnvironmentSpec, step: np.ndarray) -> bool:
    """Returns whether wrappers read MuJoCo's state for what they observe.

    The same runs under noise are played twice, once with the true state shown to the wrappers, and once with
    the state where the noise shows the robot.

    Args:
        spec: what is known of the environment.
        step: (d,) the bound of the noise on the coordinates of the chart.

    Raises:
        BadInput: wrappers do, and tell from that state as well how the episode goes.
    """
    rng, differ = np.random.default_rng(6), {"observation": False, "report": False}
    places = rng.uniform(spec.start_low, spec.start_high, (PLACES, spec.dimension))
    starts = [(spec.state, min(SAMPLES, spec.max_steps))] * EPISODES
    starts += [(state, min(3, spec.max_steps)) for state in spec.state_at(places)]
    both = [Instance(replace(spec, sensing=sensing)) for sensing in (False, True)]
    for seed, (start, samples) in enumerate(starts):
        noises = rng.uniform(-step, step, (samples + 1, len(step)))
        drawn = [both[0].drawn(rng) for _ in range(samples)]
        inputs = [drawn[k - k % HELD] for k in range(samples)]
        true, shown = (_run(one, start, inputs, noises, seed % EPISODES) for one in both)
        for what in differ:
            differ[what] |= any(
                not np.array_equal(getattr(a, what), getattr(b, what), equal_nan=True)
                for a, b in zip(true, shown, strict=False)  # one may have ended before
            )
    if all(differ.values()):
        raise BadInput(
            f"a wrapper of {spec.name} reads MuJoCo's state for what it observes, which noise moves, and for "
            "its reward, its info or the end of an episode, which it must not: let it observe what the "
            "environment gives it, or let only the environment judge"
        )
    return differ["observation"]


def _run(
    instance: Instance,
    start: np.ndarray,
    inputs: Sequence[np.ndarray],
    noises: np.ndarray,
    seed: int | None = None,
    changes: Sequence[Told] | None = None,
) -> list[Seen]:
    """Returns what is seen at the start of a run, and after each sample to its end.

    Args:
        instance: plays the run.
        start: MuJoCo's state (S,).
        inputs: (k, m) of the samples.
        noises: (k + 1, d) on the coordinates of the chart.
        seed: of the reset, by default the one that all runs begin from.
        changes: what the environment is made to tell instead, by sample.
    """
    told: list[Told] = []

    def tamper(rest: tuple[Any, ...]) -> tuple[Any, ...]:
        new = {} if changes is None else changes[len(told)]
        told.append(_told(instance.inner, rest[-1]))
        info = dict(rest[-1])
        for name, owner, key in [*_held(instance.inner, info)] if new else ():
            if name in new:
                owner[key] = copy.deepcopy(new[name])
        return (*rest[:-1], info)

    instance.quit()
    instance.tamper(tamper)
    instance.begin(start, seed)
    instance.sense(noises[0])
    found = [Seen(instance.observation, np.empty(0), told[-1])]
    for u, noise in zip(inputs, noises[1:], strict=True):
        instance.act(u)
        instance.sense(noise)
        report = np.array(instance.report, dtype=float)
        found.append(Seen(instance.observation, report, told[-1]))
        if instance.report[1] or instance.report[2]:
            break
    return found


def _told(inner: Any, info: Any) -> Told:
    """Returns the numbers in `info` and in attributes of an environment, also within objects, by name."""
    return {name: copy.deepcopy(owner[key]) for name, owner, key in _held(inner, dict(info))}


def _held(inner: Any, info: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yields the name, the owner and the key of all numbers that an environment tells beside observing."""
    seen = {id(inner)}
    for kind, owner in (("info", info), ("attribute", getattr(inner, "__dict__", {}))):
        yield from _within(owner, f"{kind} ", seen, 0)


def _within(owner: Any, path: str, seen: set[int], depth: int) -> Iterator[tuple[str, Any, Any]]:
    """Yields names, owners and keys of the numbers in a dictionary or a list, and in what it holds."""
    for key, value in [*owner.items()] if isinstance(owner, dict) else [*enumerate(owner)]:
        if _numbers(value) is not None:
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


def _numbers(value: Any) -> np.ndarray | None:
    """Returns the numbers (k,) that a value is, or all parts of a collection are; None if it holds others."""
    if isinstance(value, dict):
        value = [*value.values()]
    if isinstance(value, list | tuple | deque):
        parts = [_numbers(part) for part in value]
        numbers = [part for part in parts if part is not None]
        return np.concatenate(numbers) if 0 < len(numbers) == len(parts) else None
    if not isinstance(value, int | float | np.number | np.ndarray):
        return None
    array = np.asarray(value)
    return array.ravel().astype(float) if array.dtype.kind in "iuf" else None


def _far(name: str, here: Seen, there: Seen, least: float) -> bool:
    """Returns whether what is told at two places differs by as much as what follows the place does."""
    a, b = _numbers(here.told[name]), _numbers(there.told.get(name))
    if a is None or b is None or len(a) != len(b):
        return False
    return bool(np.abs(a - b).max(initial=0.0) >= least)
