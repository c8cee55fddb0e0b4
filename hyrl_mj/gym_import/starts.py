"""Whether a start elsewhere on the chart is as one that a reset would lead to.

A run begins after the reset with the seed, and at its own place on the chart. All else stays as that reset
left it. What a reset sets to the place of the robot would be elsewhere: a setpoint, a place that it notes, a
load that is tied to the robot. So a reset is made to lead to the start, and runs that it begins are compared.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain
from types import FrameType
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.attributes import (
    held,
    like,
    numbers_in,
    numbers_of,
    put_at,
    put_numbers,
    set_numbers,
    value_at,
)
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.fingerprint import LIBRARIES, differing, shared_variables
from hyrl_mj.gym_import.instance import Instance, Seen, renewed, to_end
from hyrl_mj.gym_import.resets import SAME, Resets, violation_of
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, SAMPLES

# How much farther than a reset notes it, as a share of that, something is moved.
FAR = 3
# Lines of Python that a reset may take in a trial: one that draws until something holds may never end.
LINES = 100_000
# Numbers that a variable of a function may hold, of those that are looked at.
FEW = 200
# By how much equality constraints and limits of tendons may be violated more than after resets [m, rad].
VIOLATED = 1e-3


def check_noted(spec: EnvironmentSpec, resets: Resets) -> Led | None:
    """Raises `BadInput` if a run from a start on the chart is not as a reset to there would have it go.

    Runs that are put to a start are compared with those that a reset begins which is led there. Their inputs
    do not change, which leads far away; where resets note anything, all runs that are judged are, too.

    Returns:
        How these are; None if resets note nothing.
    """
    _check_ties(spec, resets)
    led = _check_led(spec)
    _check_begun(spec)
    return led


def _starts(spec: EnvironmentSpec, rng: np.random.Generator) -> np.ndarray:
    return spec.state_at(spec.anywhere(rng, EPISODES))


def _check_begun(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if a first sample leads to one place, wherever on the chart a run begins."""
    rng, instance, ends = np.random.default_rng(11), Instance(spec), list[np.ndarray]()
    starts, inputs, none = _starts(spec, rng), [instance.drawn(rng)], np.zeros((2, spec.dimension))
    for state in starts:
        instance = renewed(instance)
        *_, last = instance.play(state, inputs, none)
        ends.append(last.state)
    apart, stays = (np.ptp(spec.z(np.array(states)), axis=0) > 0 for states in (starts, ends))
    for c in np.array(spec.coordinates, dtype=object)[apart & ~stays]:
        raise BadInput(
            f"step() of {spec.name} leads to one {c.name}, wherever on the chart a run begins: it goes by "
            "something else than MuJoCo's state in its attribute data, as by a second one; let it step that"
        )


def _check_ties(spec: EnvironmentSpec, resets: Resets) -> None:
    instance = Instance(spec)
    if not (instance.model.neq or instance.model.tendon_limited.any()):
        return
    for state in _starts(spec, np.random.default_rng(11)):
        instance.put(state)
        if (off := violation_of(instance)) > VIOLATED + 2 * resets.violation:
            raise BadInput(
                f"equality constraints or limits of tendons tie the robot of {spec.name} to something that "
                f"stays where its reset leads to: at another start on the chart they are off by {off:.3g} m "
                "or rad. Leave them out, name a chart of what they tie together, or give its bounds"
            )


# ---- a reset is led to the start


@dataclass(frozen=True)
class Led:
    """How the resets of an environment are led to a start: what holds their place holds that of the start.

    Homes do so until the reset has ended, MuJoCo's state and variables of functions from before each line of
    Python on, and attributes when it has ended.

    Attributes:
        homes: names of numbers by which resets go; see `_homes`.
        holders: what attributes hold; see `_holders`. None if homes alone are moved.
    """

    homes: Sequence[str]
    holders: Mapping[str, np.ndarray] | None

    @contextmanager
    def to(self, instance: Instance, state: np.ndarray) -> Iterator[None]:
        """Leads resets of an instance to a state of MuJoCo (S,) within the block, which leave it all else."""
        spec, known = instance.spec, _numbers_of_resets(instance)
        by = (state - spec.state)[spec.places[[c.kind == "qpos" for c in spec.coordinates]]]
        instance.own = np.append(own_of(instance), instance.physics.columns["warmstart"])
        instance.lead = lead = _Lead(instance, state[spec.places], self.holders)
        try:
            for name in self.homes:
                if name in known:  # a reset may hold it otherwise than a constructor
                    lead.moved.enter_context(_moved(*known[name], by))
            yield
        finally:
            instance.own = instance.lead = None
            lead.end()

    def noted(self, usual: Instance, led: Instance, state: np.ndarray) -> list[str]:
        """Puts two instances to a state (S,), one by a reset that is led there.

        Returns:
            The names of what they hold otherwise since then; none if they cannot be compared.
        """
        before = differing(led.memory(), usual.memory())  # as spaces that draw their seeds
        usual.put(state)
        try:
            with self.to(led, state):
                led.put(state)
        except BadInput:  # it cannot begin there
            return []
        states = led.physics.read(), usual.physics.read()
        moved = np.flatnonzero(~np.isclose(*states, rtol=SAME, atol=SAME))
        memory = led.memory()
        noted = [name for name in differing(memory, usual.memory()) if name not in before]
        # Where it draws other numbers, as until something is far enough away, all else is another draw.
        deep = usual.physics.depth(usual.spec.solid) > usual.spec.depth
        if deep or {*noted} & {*memory.generators}:
            return []
        return noted + [usual.physics.names[at] for at in moved]

    def refused(self, name: str, noted: Sequence[str]) -> BadInput:
        """Returns the error that a run of an environment goes otherwise because of what its reset notes."""
        return BadInput(
            f"reset() of {name} notes where it leads to ({', '.join(noted[:4])}), and step() "
            "goes by that, so a start elsewhere on the chart is none of its own: let the first "
            "step() note it, pin it, or give starts='reset' if all resets lead to one place"
        )


@dataclass
class _Lead:
    """Leads one reset of an instance to a place (d,) in MuJoCo's state; see `Led`."""

    instance: Instance
    place: np.ndarray
    holders: Mapping[str, np.ndarray] | None
    moved: ExitStack = field(default_factory=ExitStack)
    lines: int = 0

    def __call__(self, frame: FrameType, *_: Any) -> Any:
        """Is told of each line by `sys.settrace`."""
        if str(frame.f_globals.get("__name__")).partition(".")[0] in LIBRARIES:
            return None
        self.lines += 1
        if self.lines > LINES:
            raise BadInput(
                f"reset() of {self.instance.name} takes more than {LINES:,} lines of Python, too many "
                "to see whether it notes where it leads to: let it compute less, as once where it is made"
            )
        if self.holders is None:
            return self
        for c, value in zip(self.instance.spec.coordinates, self.place, strict=True):
            getattr(self.instance.data, c.kind)[c.index] = value
        variables = frame.f_locals
        for name, value in [*variables.items()]:
            if isinstance(value, float | tuple | list | np.ndarray):
                variables[name] = self._led(value)
        return self

    def _led(self, value: Any) -> Any:
        """Returns a value with the start's place where it holds the usual one."""
        spec = self.instance.spec
        size = 1 if isinstance(value, float) else getattr(value, "size", 0) or len(value)
        numbers = numbers_of(value) if size <= FEW else None
        if numbers is None or ((at := _holding(numbers, spec.state[spec.places])) < 0).all():
            return value
        return like(value, np.where(at < 0, numbers, self.place[at]))

    def end(self) -> None:
        """Ends with a reset, before anything is observed."""
        self.moved.close()
        inner, holders = self.instance.inner, self.holders or {}
        at_end = numbers_in(inner) if holders else {}
        same = {n: at for n, at in holders.items() if len(at) == len(at_end.get(n, ()))}
        set_numbers(inner, {n: _numbers_at(self.place, at) for n, at in same.items()})


def _check_led(spec: EnvironmentSpec) -> Led | None:
    """Raises `BadInput` if a run goes otherwise where the reset before it is led to its start.

    What such a reset notes as numbers is also moved farther, where limits on it show.

    Returns:
        How other runs are tried so; None if resets note nothing.
    """
    rng, usual, led = np.random.default_rng(11), Instance(spec), Instance(spec)
    how, notes = Led(_homes(spec), _holders(Instance(spec))), False
    none = np.zeros((spec.max_steps, spec.dimension))
    with how.to(led, spec.state):
        led.reset()  # to where it leads anyway: one that takes too long for a trial is refused
    for i, state in enumerate(_starts(spec, rng)):
        inputs = [usual.drawn(rng)] * spec.max_steps
        for farther in (0, FAR, -FAR) if i < EPISODES // 2 else (0,):
            usual, led = map(renewed, (usual, led))
            if not (noted := how.noted(usual, led, state)):
                break
            notes = True
            if farther:
                here, there = (numbers_in(one.inner) for one in (usual, led))
                shared = [n for n in there if len(there[n]) == len(here.get(n, ()))]
                away = {n: there[n] + farther * (there[n] - here[n]) for n in shared}
                set_numbers(led.inner, {n: to for n, to in away.items() if (to != there[n]).any()})
            ours = [*to_end(usual.goes_on(inputs, none))]
            try:
                apart = _go_apart(spec, ours, led.goes_on(inputs, none))
            except BadInput:  # it fails with values that it does not know
                apart = True
            if apart:
                raise how.refused(spec.name, noted)
    return how if notes else None


def _go_apart(spec: EnvironmentSpec, ours: Iterable[Seen], theirs: Iterable[Seen]) -> bool:
    """Returns whether two runs differ after one of their samples."""
    for k, (a, b) in enumerate(zip(ours, theirs, strict=False)):
        # The first reward after a start is of what shapes it, and alone it is not judged by.
        first = 0 if k or "reward" in spec.criterion.asked else 1
        here, there = (
            np.concatenate([one.state[spec.places], one.observation, one.report[first:]])
            for one in (a, b)
        )
        if not np.allclose(here, there, rtol=SAME, atol=SAME, equal_nan=True):
            return True
    return False


def _holding(numbers: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Returns which coordinate of a place (d,) each of some numbers (k,) is: (k,) int, -1 of none.

    Halves and whole numbers may be anything, unless all of the place stands in a row. So may one of several.
    """
    found, d = np.full(len(numbers), -1), len(place)
    odd = np.flatnonzero(2 * place != np.rint(2 * place))
    if len(numbers) == 1 or (len(odd) == d and np.isin(place, numbers).all()):
        for j in odd:
            found[numbers == place[j]] = j
    if d > 1 and place.any():
        for i in np.flatnonzero(numbers == place[0]):
            if np.array_equal(numbers[i : i + d], place):
                found[i : i + d] = range(d)
    return found


def _holders(instance: Instance) -> dict[str, np.ndarray]:
    """Returns which coordinates of the place attributes hold, by name: (k,) int, -1 of none.

    They hold it throughout runs, or resets set them to the usual place whatever they have held before.
    """
    spec, rng, rows, places = instance.spec, np.random.default_rng(14), [], []
    for _ in range(EPISODES):
        instance.reset()
        for _ in chain([None], instance.wander(rng, SAMPLES, HELD)):
            rows.append(numbers_in(instance.inner))
            places.append(instance.physics.read()[spec.places])
    found, moves = {}, np.ptp(places, axis=0) > 0
    for name, first in rows[0].items():
        if {len(row.get(name, ())) for row in rows} != {len(first)}:
            continue
        table = np.array([row[name] for row in rows])
        same = np.isclose(table[:, :, None], np.array(places)[:, None], SAME, SAME)
        is_held = same.all(axis=0) & moves  # (k, d)
        if is_held.any():
            found[name] = np.where(is_held.any(axis=1), is_held.argmax(axis=1), -1)
    usual = spec.state[spec.places]
    other = usual + 1 / 3
    with suppress(BadInput):  # it may not be able to begin from elsewhere
        instance.reset()
        before = _holding_in(instance, usual)
        set_numbers(instance.inner, {n: _numbers_at(other, at) for n, at in before.items()})
        instance.reset()
        now, kept = (_holding_in(instance, place) for place in (usual, other))
        found |= {n: at for n, at in now.items() if np.array_equal(before.get(n, ()), at)}
        set_numbers(instance.inner, {n: _numbers_at(usual, at) for n, at in kept.items()})
    return found


def _holding_in(instance: Instance, place: np.ndarray) -> dict[str, np.ndarray]:
    """Returns which coordinates of a place (d,) attributes hold, by name; see `_holding`."""
    found = {n: _holding(numbers, place) for n, numbers in numbers_in(instance.inner).items()}
    return {name: at for name, at in found.items() if (at >= 0).any()}


def _numbers_at(place: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Returns the coordinates of a place (d,) that `at` (k,) tells, NaN where it tells none."""
    return np.where(at < 0, np.nan, place[at])


def _homes(spec: EnvironmentSpec) -> list[str]:
    """Returns the names of numbers that lead resets elsewhere on the chart where they are moved."""
    probe, found = Instance(spec), list[str]()
    state = _starts(spec, np.random.default_rng(12))[0]
    places = spec.places[[c.kind == "qpos" for c in spec.coordinates]]
    for name in _numbers_of_resets(probe) if len(places) else ():
        with suppress(BadInput), Led([name], None).to(probe, state):
            probe.reset()
            now = probe.physics.read()[places]
            there, stays = (np.isclose(now, one[places], SAME, SAME) for one in (state, spec.state))
            if (there | stays).all() and not stays.all():
                found.append(name)
    return found


def _numbers_of_resets(instance: Instance) -> dict[str, tuple[Any, Any, list[int]]]:
    """Returns numbers that may be the place to which resets lead: owners, keys, and where the chart's are.

    They are as many as positions, of the chart at least, in attributes, in variables that instances share,
    or in keyframes.
    """
    at, nq = [c.index for c in instance.spec.coordinates if c.kind == "qpos"], instance.model.nq
    found = dict[str, tuple[Any, Any, list[int]]]()
    ours = (place[:3] for place in held(instance.inner))
    for name, owner, key in (*ours, *shared_variables(instance.env)):
        numbers = numbers_of(value_at(owner, key))
        if numbers is not None and len(at) <= len(numbers) <= nq:
            found[name] = owner, key, at if len(numbers) == nq else [*range(len(at))]
    keys = [nq * row + i for row in range(instance.model.nkey) for i in at]
    return {**found, "key_qpos": (instance.model, "key_qpos", keys)} if keys else found


@contextmanager
def _moved(owner: Any, key: Any, at: list[int], by: np.ndarray) -> Iterator[None]:
    """Moves some of the numbers that an owner holds, within the block."""
    old = value_at(owner, key)
    kept, numbers = copy.copy(old), np.array(numbers_of(old))
    numbers[at] += np.resize(by, len(at))
    put_numbers(owner, key, numbers)
    try:
        yield
    finally:
        if isinstance(old, np.ndarray) and old.flags.writeable:
            old[...] = kept
        put_at(owner, key, old)
