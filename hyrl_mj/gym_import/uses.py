"""Trials of what tells an environment or its wrappers the place of the robot, past the noise.

Its own `step` may use what it observes, and go by where its reset led to. Wrappers may look at `info`, at
attributes, and at MuJoCo's state.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, Literal

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.fingerprint import DEEPEST, FUNCTIONS, differing, has_no_memory
from hyrl_mj.gym_import.instance import Instance, Seen, check_unveiled
from hyrl_mj.gym_import.observations import flat
from hyrl_mj.gym_import.specification import Derived, EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, PLACES, SAMPLES

# What changes by this share of a displacement follows the place [share].
FOLLOWS = 0.01
# In how many samples what is told is changed, the start being the first, and for how many it is looked
# whether wrappers read MuJoCo's state seldom.
TOLD, SELDOM = 3, 200

# What an environment tells beside its observation, by name.
Told = dict[str, Any]


class _Sensor:
    """An environment whose observer sees the robot elsewhere, as noise has it.

    Attributes:
        offset: (d,) on the coordinates of the chart.
        given: what was observed since it was emptied, as vectors (o,).
    """

    def __init__(self, spec: EnvironmentSpec):
        self.instance = Instance(spec)
        self.offset, self.given = np.zeros(spec.dimension), list[np.ndarray]()
        self._own, self._within = getattr(self.instance.inner, spec.observer), False

    def put(self, state: np.ndarray) -> bool:
        """Begins at a state (S,) of MuJoCo; returns whether that is free of walls, and can be observed."""
        instance = self.instance
        vars(instance.inner).pop(instance.spec.observer, None)
        instance.reset()
        instance.arrive(state)
        setattr(instance.inner, instance.spec.observer, self._observe)
        return instance.physics.depth(instance.spec.solid) <= instance.spec.depth

    def step(self, action: Any, offset: np.ndarray) -> tuple[np.ndarray, Any]:
        """Returns what is observed (o,) after an action of the innermost environment, and its result."""
        self.offset, self.given = offset, []
        result = self.instance.inner.step(action)
        return flat(result[0], self.instance.inner.observation_space), result

    def _observe(self, *arguments: Any, **options: Any) -> Any:
        instance = self.instance
        if self._within:
            return self._own(*arguments, **options)
        self._within = True
        instance.physics.leave()
        try:
            instance.physics.write(instance.moved(instance.physics.read(), self.offset))
            seen = self._own(*arguments, **options)
        finally:
            instance.physics.come_back()
            self._within = False
        self.given.append(flat(seen, instance.inner.observation_space))
        return seen


def check_use(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if step() changes what is observed under noise, or moves the robot by it.

    The same runs are played with an observer that sees the true place, and with one that sees others, all
    over the chart. What the latter gives has to be returned, and both runs have to go the same way. Wrappers
    give the actions of a run without noise.
    """
    wrapped = Instance(spec)
    inner, step = wrapped.inner, wrapped.inner.step
    if not hasattr(type(inner), spec.observer) or spec.observer in getattr(
        inner, "__dict__", {spec.observer: None}
    ):  # it is made of several methods, or put in already, or the environment allows no attributes
        return
    true, noisy, actions = _Sensor(spec), _Sensor(spec), list[Any]()

    def noting(action: Any) -> Any:
        actions.append(copy.copy(action))
        return step(action)

    inner.step = noting
    rng, half = np.random.default_rng(10), spec.chart.sides * (np.array(spec.noisy) > 0) / 2
    for state in spec.state_at(spec.anywhere(rng, EPISODES)):
        wrapped.reset()
        wrapped.arrive(state)
        clear = [one.put(state) for one in (true, noisy)]  # both, so that they are reset as often
        if not all(clear):
            continue
        for k in range(min(SAMPLES, spec.max_steps)):
            if k % HELD == 0:
                u = wrapped.drawn(rng)
            actions.clear()
            ended = any(wrapped.stepped(u)[2:4])
            if len(actions) != 1:  # of wrappers which step several times, or not at all
                return
            try:
                seen, result = true.step(copy.copy(actions[0]), 0 * half)
                moved, other = noisy.step(copy.copy(actions[0]), rng.uniform(-half, half))
            except (Exception, SystemExit):  # step() may not be able to work with such observations
                break
            before, after = (one.instance.physics.read() for one in (true, noisy))
            if not np.array_equal(before, after, equal_nan=True):
                raise BadInput(
                    f"step() of {spec.name} moves the robot by what {spec.observer}() gives, where noise "
                    "does not come: let it read MuJoCo's state, or put the controller into a wrapper, which "
                    "sees the noise"
                )
            if _holds(true.given, seen) and not _holds(noisy.given, moved):
                raise BadInput(
                    f"step() of {spec.name} changes what {spec.observer}() gives where noise may show the "
                    "robot, as where it clips: let that method compute all that is observed"
                )
            if ended or any([*result[2:4], *other[2:4]]):
                break


def _holds(given: list[np.ndarray], seen: np.ndarray) -> bool:
    return any(np.array_equal(one, seen, equal_nan=True) for one in given)


# ---- wrappers


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


def check_episodes(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if what outlasts resets changes what is observed or done in later episodes.

    Each episode is played by an environment that is like new, and its user's goes on with what it remembers,
    here after one episode, and after several that begin all over the chart, too, where some may succeed.
    """
    rng, names = np.random.default_rng(13), dict[str, None]()
    once, several = Instance(spec), Instance(spec)
    for old, episodes in ((once, 1), (several, 3)):
        for _ in range(episodes):
            old.reset()
            deque(old.wander(rng, SAMPLES, HELD), maxlen=0)
    for state in spec.state_at(spec.anywhere(rng, 2 * EPISODES)):
        several.put(state)
        if several.physics.depth(spec.solid) <= spec.depth:
            deque(several.wander(rng, SAMPLES, HELD), maxlen=0)
    for old in (once, several):
        names |= dict.fromkeys(_outlasting(spec, old, rng))
    if names:
        spec.found["episodes"] = (
            "each is played by a new environment, because of what outlasts resets "
            f"({', '.join([*names][:4])}); no trial of {3 + 2 * EPISODES} episodes shows that what comes "
            "next depends on it"
        )


def _outlasting(spec: EnvironmentSpec, old: Instance, rng: np.random.Generator) -> list[str]:
    """Returns the names of what outlasts the resets of an instance; raises `BadInput` if a run depends on it.

    A run begins as the reset of each instance leaves MuJoCo's state, at one place.
    """
    new, twin = Instance(spec), Instance(spec)
    inputs, none = [new.drawn(rng) for _ in range(SAMPLES)], np.zeros((SAMPLES + 1, spec.dimension))
    starts, columns = [], new.physics.columns
    for one in (new, twin, old):
        one.reset()
        starts.append(one.physics.read())
        for at in (spec.places, columns["warmstart"]):
            starts[-1][at] = spec.state[at]
    runs = [
        one.play(start, inputs, none) for one, start in zip((new, twin, old), starts, strict=True)
    ]
    seen = [next(run) for run in runs]
    remembered = [one.memory() for one in (new, twin, old)]
    usual = {*differing(*remembered[:2])}  # such as names of files
    names = [name for name in differing(remembered[2], remembered[0]) if name not in usual]
    names += [n for n, at in columns.items() if not np.array_equal(starts[2][at], starts[0][at])]
    if drawn := [name for name in names if name in remembered[0].generators]:
        raise BadInput(
            f"{spec.name} draws random numbers in reset(), from a generator that its seed does not decide "
            f"({drawn[0]}): let it draw from self.np_random"
        )
    first = 0 if "reward" in spec.criterion.asked else 1  # of the report, by which it is judged
    while len(seen) == len(runs):
        told = [
            np.concatenate([one.state[spec.places], one.observation, one.report[first:]])
            for one in seen
        ]
        if not np.array_equal(told[0], told[1], equal_nan=True):
            break  # it goes another way each time, as is found elsewhere
        most, known = 1e-6 * np.maximum(np.abs(told[0]), 1.0), np.isfinite(told[0])
        if not (np.abs(told[2] - told[0]) <= most).all(where=known):
            what = ", ".join(names[:4]) or "no attribute tells what"
            how = "let reset() set it back"
            if what.startswith("NormalizeObservation"):
                how = "load its statistics (obs_rms) and set update_running_mean = False where it is made"
            elif names and names[0] in columns:
                how = "let reset() call mj_resetData"
            raise BadInput(
                f"{spec.name} changes from episode to episode: what is observed or done depends on what "
                f"outlasts resets ({what}), and here each episode is played by a new environment; {how}"
            )
        seen = [] if any(seen[0].report[1:3]) else [one for run in runs for one in islice(run, 1)]
    return names


def check_told(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if wrappers observe what `info`, rewards or attributes tell of the place.

    Runs are played from places on the chart, and from places that are displaced a little, or are elsewhere.
    What the environment tells in the latter is then put into the former, whose observation has to stay the
    same: of a displacement all that follows it, and of another place truths, words and whole numbers, as a
    velocity may differ there.
    """
    rng, step = np.random.default_rng(9), spec.nudge
    least = FOLLOWS * float(step[step > 0].min(initial=np.inf))
    usual, other = Instance(spec), Instance(spec)
    none = np.zeros((HELD + 1, spec.dimension))
    for i, z in enumerate(spec.anywhere(rng, 4 * EPISODES)):
        inputs = [usual.drawn(rng)] * HELD
        far = spec.anywhere(rng, 1)[0]
        state, elsewhere = spec.state_at(np.array([z, far if i % 4 else z + step]))
        here = _run(usual, state, inputs, none)
        there = _run(other, elsewhere, inputs[: TOLD - 1], none[:TOLD])
        differs = _jumps if i % 4 else partial(_far, least=least)
        follow = [
            {name: b[name] for name in a if name in b and differs(a[name], b[name])}
            for (_, a), (_, b) in zip(here, there, strict=False)
        ]
        if not any(follow):
            continue
        try:
            changed = _run(Instance(spec), state, inputs, none, changes=follow)
        except BadInput:  # it fails with values that it does not know
            continue
        names = list(dict.fromkeys(name for told in follow for name in told))
        for (seen, _), (now, _) in zip(here, changed, strict=False):
            if not np.array_equal(seen.state, now.state, equal_nan=True):
                break  # what is told moves the robot
            if not np.array_equal(seen.observation, now.observation, equal_nan=True):
                raise BadInput(
                    f"a wrapper of {spec.name} observes {' or '.join(names[:4])}, which follows the place "
                    "and which noise does not reach: let it observe what the environment observes"
                )


def senses(spec: EnvironmentSpec) -> Derived | Literal[""]:
    """Returns how wrappers that read MuJoCo's state for what they observe are shown it under noise.

    The same runs under noise are played with the true state shown to the wrappers, with the state where the
    noise shows the robot, and with that state before the wrappers step the environment, too.

    Raises:
        BadInput: wrappers do, and tell from that state as well how the episode goes, or they observe where
            the robot was before they stepped the environment, where noise does not come.
    """
    rng, differ = np.random.default_rng(6), {"observation": False, "report": False}
    places, step = spec.anywhere(rng, PLACES), spec.nudge
    starts = [(spec.state, min(SAMPLES, spec.max_steps))] * EPISODES
    starts += [(state, min(3, spec.max_steps)) for state in spec.state_at(places)]
    # Some measure now and then.
    starts += [(state, min(SELDOM, spec.max_steps)) for state in spec.state_at(places[:2])]
    plain, shown, veiled = (Instance(replace(spec, sensing=how)) for how in ("", "now", "now"))
    veiled.veiled = True
    for seed, (start, samples) in enumerate(starts):
        noises = rng.uniform(-step, step, (samples + 1, len(step)))
        drawn = [plain.drawn(rng) for _ in range(samples)]
        inputs = [drawn[k - k % HELD] for k in range(samples)]
        runs = [_run(one, start, inputs, noises, seed % EPISODES) for one in (plain, shown, veiled)]
        for what in differ:
            differ[what] |= any(
                not np.array_equal(getattr(a, what), getattr(b, what), equal_nan=True)
                for (a, _), (b, _) in zip(*runs[:2], strict=False)  # one may have ended before
            )
        check_unveiled(spec.name, *([seen[:2] for seen, _ in run] for run in runs[1:]))
    if all(differ.values()):
        raise BadInput(
            f"a wrapper of {spec.name} reads MuJoCo's state for what it observes, which noise moves, and for "
            "its reward, its info or the end of an episode, which it must not: let it observe what the "
            "environment gives it, or let only the environment judge"
        )
    return _as_of(spec) if differ["observation"] else ""


def _as_of(spec: EnvironmentSpec) -> Derived:
    """Returns from when the derived quantities are that wrappers read, "now" if it is not known.

    A run without noise is compared with runs whose noise is too small to matter.
    """
    rng, none = np.random.default_rng(14), np.zeros((SAMPLES + 1, spec.dimension))
    inputs, little = [Instance(spec).drawn(rng)] * SAMPLES, none + 1e-9 * spec.nudge
    ways: dict[Derived | Literal[""], np.ndarray] = {"": none, "now": little, "earlier": little}
    seen = []
    for how, noises in ways.items():
        run = _run(Instance(replace(spec, sensing=how)), spec.state, inputs, noises)
        seen.append(np.array([one.observation for one, _ in run]))
    n = min(map(len, seen))
    off = [float(np.abs(one[:n] - seen[0][:n]).max()) for one in seen[1:]]
    if min(off) > 1e-6 * max(1.0, float(np.abs(seen[0]).max())):
        spec.found["lag"] = (
            "wrappers observe quantities of MuJoCo from before the end of a step, and under noise those of "
            f"its end, which differ by up to {off[0]:.3g}"
        )
        return "now"
    return "now" if off[0] <= off[1] else "earlier"


def _run(
    instance: Instance,
    start: np.ndarray,
    inputs: Sequence[np.ndarray],
    noises: np.ndarray,
    seed: int | None = None,
    changes: Sequence[Told] | None = None,
) -> list[tuple[Seen, Told]]:
    """Returns what is seen, and what wrappers are told, at the start of a run and after each of its samples.

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
        new: Told = dict(*(changes or [])[len(told) :][:1])
        info, reward = dict(rest[-1]), dict(zip(("the reward",), rest[:-1], strict=False))
        places = held(instance.inner, info)
        told.append({name: copy.deepcopy(owner[key]) for name, owner, key in places} | reward)
        for name, owner, key in [*held(instance.inner, info)] if new else ():
            if name in new:
                owner[key] = copy.deepcopy(new[name])
        return (*(new.get("the reward", first) for first in rest[:-1][:1]), *rest[1:-1], info)

    instance.tamper, found = tamper, []
    for seen in instance.play(start, inputs, noises, seed):
        found.append((seen, told[-1]))
        if any(seen.report[1:3]):
            break
    return found


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


def _far(here: Any, there: Any, least: float) -> bool:
    """Returns whether what is told at two places differs by as much as what follows the place does."""
    a, b = numbers_of(here), numbers_of(there)
    if a is None or b is None or len(a) != len(b):
        return False
    return bool(np.abs(a - b).max(initial=0.0) >= least)


def _jumps(here: Any, there: Any) -> bool:
    """Returns whether what is told at two places are other words, truths or whole numbers."""
    if isinstance(here, str):
        return bool(here != there)
    a, b = numbers_of(here), numbers_of(there)
    if a is None or b is None or len(a) != len(b):
        return False
    return all(np.array_equal(x, np.rint(x)) for x in (a, b)) and not np.array_equal(a, b)
