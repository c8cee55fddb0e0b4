"""Trials of what tells an environment or its wrappers the place of the robot, past the noise.

Its own `step` may use what it observes, and go by where its reset led to. Wrappers may look at `info`, at
attributes, and at MuJoCo's state.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.attributes import held, put_at, taken_apart, value_at
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.instance import Instance, Seen, renewed, to_end
from hyrl_mj.gym_import.observations import flat, shaped
from hyrl_mj.gym_import.resets import SAME
from hyrl_mj.gym_import.specification import Derived, EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, PLACES, SAMPLES

# What changes by this share of a displacement follows the place [share].
FOLLOWS = 0.01
# In how many samples what is told is changed, the start being the first, and for how many it is looked
# whether wrappers read MuJoCo's state seldom.
TOLD, SELDOM = 3, 200

# What an environment tells beside its observation, by name, among which the reward has one of its own.
Told = dict[str, Any]
REWARD = "the reward"
GONE = type("Gone", (), {})  # in place of what is not told


class _Sensor:
    """What the observer of an environment sees of the robot elsewhere, as noise has it.

    Attributes:
        instance: the environment.
        offset: (d,) on the coordinates of the chart.
        given: what has been observed, as vectors (o,).
    """

    def __init__(self, instance: Instance):
        self.instance = instance
        self.offset, self.given = np.zeros(instance.spec.dimension), list[np.ndarray]()

    def put(self, state: np.ndarray) -> bool:
        """Begins at a state (S,) of MuJoCo; returns whether that is free of walls."""
        instance = self.instance
        vars(instance.inner).pop(instance.spec.observer, None)
        instance.reset()
        instance.arrive(state)
        setattr(instance.inner, instance.spec.observer, self._observe)
        return instance.physics.depth(instance.spec.solid) <= instance.spec.depth

    def gave(self, seen: Any) -> bool:
        """Returns whether an observation is one of what has been observed."""
        seen = flat(seen, self.instance.inner.observation_space)
        return any(np.array_equal(one, seen, equal_nan=True) for one in self.given)

    def _observe(self) -> Any:
        instance = self.instance
        self.given.append(instance.seen_as("now", instance.physics.read(), self.offset))
        return shaped(self.given[-1], instance.inner_seen, instance.inner.observation_space)


def check_use(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if step() changes what is observed under noise, or moves the robot by it.

    The same runs are played with an observer that sees the true place, and with one that sees others, all
    over the chart. What the latter gives has to be returned, and both runs have to go the same way. Wrappers
    give the actions of the former.
    """
    instance = Instance(spec)
    inner, step = instance.inner, instance.inner.step
    if not hasattr(type(inner), spec.observer) or spec.observer in getattr(
        inner, "__dict__", {spec.observer: None}
    ):  # it is made of several methods, or put in already, or the environment allows no attributes
        return
    true, noisy, actions = _Sensor(instance), _Sensor(Instance(spec)), list[Any]()

    def noting(action: Any) -> Any:
        actions.append(copy.copy(action))
        return step(action)

    inner.step = noting
    rng, half = np.random.default_rng(10), spec.chart.sides * (np.array(spec.noisy) > 0) / 2
    for state in spec.state_at(spec.anywhere(rng, EPISODES)):
        clear = [one.put(state) for one in (true, noisy)]  # both, so that they are reset as often
        if not all(clear):
            continue
        for k in range(min(SAMPLES, spec.max_steps)):
            if k % HELD == 0:
                u = instance.drawn(rng)
            for noted in (actions, true.given, noisy.given):
                noted.clear()
            ended = any(instance.stepped(u)[2:4])
            if len(actions) != 1:  # of wrappers which step several times, or not at all
                return
            noisy.offset = rng.uniform(-half, half)
            try:
                moved, _, *ends, _ = noisy.instance.inner.step(actions[0])
            except (Exception, SystemExit):  # step() may not be able to work with such observations
                break
            before, after = (one.instance.physics.read() for one in (true, noisy))
            if not np.array_equal(before, after, equal_nan=True):
                raise BadInput(
                    f"step() of {spec.name} moves the robot by what {spec.observer}() gives, where noise "
                    "does not come: let it read MuJoCo's state, or put the controller into a wrapper, which "
                    "sees the noise"
                )
            if true.gave(instance.inner_seen) and not noisy.gave(moved):
                raise BadInput(
                    f"step() of {spec.name} changes what {spec.observer}() gives where noise may show the "
                    "robot, as where it clips: let that method compute all that is observed"
                )
            if ended or any(ends):
                break


def check_copied(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if what is observed shows the place by what code copies into MuJoCo's state.

    A copy, as of a camera that is put above the robot, is moved by as much as the robot, whatever it was
    before. What follows the place in `userdata`, where no physics writes, is one, too, also
    scaled or filtered. Noise on the chart does not reach it.
    """
    rng, one, step = np.random.default_rng(15), Instance(spec), spec.nudge
    columns, far = one.physics.columns, float(step.max())
    parts = ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat", "userdata")  # but for forces
    others = np.setdiff1d(np.concatenate([columns[part] for part in parts]), own_of(one))
    for i, z in enumerate(spec.anywhere(rng, EPISODES if len(others) else 0)):
        inputs = [one.drawn(rng)] * (HELD if i % 2 else 1)
        none = np.zeros((len(inputs) + 1, spec.dimension))
        usual, elsewhere = spec.state_at(np.array([z, z + step]))
        before = usual.copy()
        before[others] += far
        runs = list[list[Seen]]()
        for start in (usual, elsewhere, before):
            one = renewed(one)
            runs.append([*to_end(one.play(start, inputs, none))])
        if len({len(run) for run in runs}) > 1:
            continue
        here, there, after = (run[-1].state for run in runs)
        by = np.append(step, (there - here)[spec.places])
        moved = np.abs((there - here)[others, None] - by[by != 0]) <= SAME * far
        is_copy = moved.any(axis=1) & (np.abs(after - here)[others] <= SAME * far)
        noted = np.isin(others, columns["userdata"]) & (there != here)[others]
        copies = others[is_copy | noted]
        if not len(copies):
            continue
        other, one = here.copy(), renewed(one)
        other[copies] = there[copies]
        one.tamper = partial(_write, one, here, other)
        *_, shown = one.play(usual, inputs[: len(runs[0]) - 1], none[: len(runs[0])])
        one.tamper = None
        seen = [one.seen_as("now", state, none[0]) for state in (here, other)]
        pairs = seen, (shown.observation, runs[0][-1].observation)
        if not all(np.array_equal(a, b, equal_nan=True) for a, b in pairs):
            names = ", ".join(one.physics.names[at] for at in copies[:4])
            raise BadInput(
                f"what {spec.name} observes shows {names}, to which code copies the place of the robot, "
                "where noise does not reach it: let it observe the place itself"
            )


def _write(
    instance: Instance, usual: np.ndarray, other: np.ndarray, rest: tuple[Any, ...]
) -> tuple[Any, ...]:
    """Shows wrappers another state (S,) of MuJoCo in place of one; returns what they get beside it."""
    if np.array_equal(instance.physics.read(), usual, equal_nan=True):
        instance.physics.write(other)
    return rest


# ---- wrappers


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
        follow = [
            {
                n: b.get(n, GONE)
                for n in {**a, **b}
                if _differs(a.get(n, GONE), b.get(n, GONE), None if i % 4 else least)
            }
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

    The same runs under noise are played with the true state shown to the wrappers, and with the state where
    the noise shows the robot.

    Raises:
        BadInput: wrappers do, and tell from that state as well how the episode goes.
    """
    rng, differ = np.random.default_rng(6), {"observation": False, "report": False}
    places, step = spec.anywhere(rng, PLACES), spec.nudge
    starts = [(spec.state, min(SAMPLES, spec.max_steps))] * EPISODES
    starts += [(state, min(3, spec.max_steps)) for state in spec.state_at(places)]
    # Some measure now and then.
    starts += [(state, min(SELDOM, spec.max_steps)) for state in spec.state_at(places[:2])]
    both = [Instance(replace(spec, sensing=how)) for how in ("", "now")]
    for seed, (start, samples) in enumerate(starts):
        noises = rng.uniform(-step, step, (samples + 1, len(step)))
        drawn = [both[0].drawn(rng) for _ in range(samples)]
        inputs = [drawn[k - k % HELD] for k in range(samples)]
        runs = [_run(one, start, inputs, noises, seed % EPISODES) for one in both]
        for what in differ:
            differ[what] |= any(
                not np.array_equal(getattr(a, what), getattr(b, what), equal_nan=True)
                for (a, _), (b, _) in zip(*runs, strict=False)  # one may have ended before
            )
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
    changes: Sequence[Told] = (),
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
        new = changes[len(told)] if len(told) < len(changes) else {}
        *ends, info = *rest[:-1], dict(rest[-1])  # nothing but the info of a reset
        places = [*held(instance.inner, info)]
        told.append({name: copy.deepcopy(value_at(owner, key)) for name, owner, key in places})
        known = {name: (owner, key) for name, owner, key in places}
        top = {"info": info, "attribute": getattr(instance.inner, "__dict__", {})}
        for name in new.keys() - {REWARD}:
            kind, _, word = name.partition(" ")
            owner, key = known.get(name, (top[kind], word))
            if new[name] is not GONE:
                put_at(owner, key, copy.deepcopy(new[name]))
            elif isinstance(owner, dict):
                owner.pop(key, None)
        if ends:
            told[-1][REWARD] = ends[0]
            ends[0] = new.get(REWARD, ends[0])
        return (*ends, info)

    instance.tamper, found = tamper, []
    for seen in to_end(instance.play(start, inputs, noises, seed)):
        found.append((seen, told[-1]))
    return found


def _differs(here: Any, there: Any, least: float | None) -> bool:
    """Returns whether what is told at two places differs as what follows the place does.

    Args:
        here, there: what is told.
        least: by how much numbers differ that follow it; None where places are far apart, and only truths,
            whole numbers, and what are no numbers tell them apart.
    """
    (a, word), (b, other) = (taken_apart(told) or (np.empty(0), told) for told in (here, there))
    if len(a) != len(b) or word != other:
        return True
    if least is not None:
        return bool(np.abs(a - b).max(initial=0.0) >= least)
    return not np.array_equal(a, b) and all(np.array_equal(x, np.rint(x)) for x in (a, b))
