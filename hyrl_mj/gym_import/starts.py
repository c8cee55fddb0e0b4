"""Whether a start elsewhere on the chart is as one that a reset would lead to.

A run begins after the reset with the seed, and at its own place on the chart. All else stays as that reset
left it. What a reset sets to the place of the robot would be elsewhere: a setpoint, a place that it notes, a
load that is tied to the robot.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.fingerprint import differing, shared_variables
from hyrl_mj.gym_import.instance import Instance, Seen
from hyrl_mj.gym_import.resets import (
    OF_MODEL,
    SAME,
    Predict,
    Resets,
    predicted,
    terms_of,
    violation_of,
)
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, SAMPLES
from hyrl_mj.gym_import.uses import held, numbers_of

# Samples of a run from the start of a reset, which is compared with one that is put there.
NATURAL = 100
# Lines of Python that a reset may take in a trial: one that draws until something holds may never end.
LINES = 100_000
# By how much equality constraints and limits of tendons may be violated more than after resets [m, rad].
VIOLATED = 1e-3


# ---- what would be set to another place


def _setpoints(instance: Instance, state: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Returns a state (S,) with setpoints that pull as little as those of another one: its own, moved along.

    They are those of actuators that pull the more the farther away they are from their setpoints, in `ctrl`
    or `act`.
    """
    model, data, physics = instance.model, instance.data, instance.physics
    lengths = []
    for one in (state, now):
        physics.write(one)
        lengths.append(data.actuator_length.copy())
    moved = now.copy()
    for i in range(model.nactuator):
        gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i, 1]
        if model.actuator_biastype[i] and bias and gain:
            by = -bias / gain * (lengths[1] - lengths[0])[model.actuator_outadr[i]]
            at = model.actuator_actadr[i]
            has_act = model.actuator_dyntype[i] and at >= 0
            column = (
                physics.columns["act"][at]
                if has_act
                else physics.columns["ctrl"][model.actuator_ctrladr[i]]
            )
            moved[column] += by
    return moved


def _equal_to(place: np.ndarray, table: np.ndarray) -> Callable[[np.ndarray], np.ndarray] | None:
    """Returns what puts another place (d,) where numbers (k,) hold a place; None if they do not.

    Whole numbers that stand alone may be anything else, and so may zeros.
    """
    d, at = len(place), []
    if place.any() and (d > 1 or not float(place[0] * 2).is_integer()):
        at = [i for i in range(len(table) - d + 1) if np.array_equal(table[i : i + d], place)]
    if not at:
        return None

    def put(other: np.ndarray) -> np.ndarray:
        found = table.copy()
        for i in at:
            found[i : i + d] = other
        return found

    return put


def _is_set_by_reset(spec: EnvironmentSpec, name: str, other: np.ndarray) -> bool:
    """Returns whether a reset gives an attribute its numbers, where it holds other ones (k,) before."""
    instance = Instance(spec)
    instance.reset()
    usual = instance.memory()
    _set(instance, {name: other})
    try:
        instance.reset()
    except BadInput:  # it cannot, from there
        return True
    return name not in differing(instance.memory(), usual)


# ---- the trials


def check_noted(spec: EnvironmentSpec, resets: Resets) -> None:
    """Raises `BadInput` if a run from a start on the chart is not as a reset to there would have it go.

    Runs are played after the reset as it is, and where what follows the place has been moved along. Both have
    to go alike, to their ends and under inputs that do not change, which lead far away.
    """
    _check_ties(spec, resets)
    _check_following(spec, resets)
    _check_led(spec)
    _check_natural(spec, resets)


def _starts(spec: EnvironmentSpec, rng: np.random.Generator) -> np.ndarray:
    return spec.state_at(spec.anywhere(rng, EPISODES))


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


def _check_following(spec: EnvironmentSpec, resets: Resets) -> None:
    """Raises `BadInput` if runs depend on what follows the place over resets, and is not at the start's."""
    rng, usual, other = np.random.default_rng(11), Instance(spec), Instance(spec)
    model, states = usual.model, resets.states
    drawn = bool(np.ptp(spec.z(states), axis=0).any())
    terms = terms_of(spec, model, states)
    columns = usual.physics.columns
    passed = {*columns["time"], *columns["warmstart"], *own_of(spec, model)}
    free = np.array([i for i in range(states.shape[1]) if i not in passed], dtype=int)
    names = [f"{kind}[{i}]" for kind, at in columns.items() for i in range(len(at))]
    of_state = predicted(terms, states[:, free]) if drawn else None
    of_memory: dict[str, Predict] = {}
    if drawn:
        for name, table in resets.numbers.items():
            if np.isfinite(table).all() and (predict := predicted(terms, table)) is not None:
                of_memory[name] = partial(_by_terms, spec, model, predict)
    else:
        of_memory |= _followed(usual)
        usual.reset()
        place = spec.state[spec.places]
        for name, owner, key in held(usual.inner, {}):
            name = name.removeprefix("attribute ")
            numbers = numbers_of(owner[key])
            put = None if numbers is None else _equal_to(place, numbers)
            if put is not None and _is_set_by_reset(spec, name, put(place + 1.0)):
                of_memory[name] = partial(_at_place, spec, put)
    starts = _starts(spec, rng)
    for i, state in enumerate(starts):
        moved = state.copy()
        if of_state is not None:
            now = of_state(terms_of(spec, model, state[None])[0])
            changes = np.abs(now - state[free]) > 1e-9 * np.maximum(np.abs(now), 1.0)
            moved[free[changes]] = now[changes]
        elif not drawn:
            usual.reset()
            moved = _setpoints(usual, spec.state, state)
            for kind in ("mocap_pos", "userdata"):
                put_to = _equal_to(spec.state[spec.places], state[columns[kind]])
                if put_to is not None:
                    moved[columns[kind]] = put_to(state[spec.places])
        what = [*of_memory, *(names[i] for i in np.flatnonzero(moved != state))]
        if not what:
            return
        usual = _renewed(usual)
        ours = _played(usual, state, [usual.drawn(rng)] * spec.max_steps)
        if usual.physics.depth(spec.solid) > spec.depth and len(ours) == 1:
            continue
        values = {name: predict(state) for name, predict in of_memory.items()}
        other = _compare_noted(other, ours, moved, values, what)
        if not of_memory or i >= EPISODES // 2:
            continue
        far = {n: 3 * np.ptp([p(s) for s in starts], axis=0) for n, p in of_memory.items()}
        for sign in (1, -1):  # so far that limits on it show
            changed = {n: values[n] + sign * far[n] for n in values}
            other = _compare_noted(other, ours[:NATURAL], state, changed, [*of_memory])


def _by_terms(
    spec: EnvironmentSpec, model: mujoco.MjModel, predict: Predict, state: np.ndarray
) -> np.ndarray:
    return predict(terms_of(spec, model, state[None])[0])


def _at_place(spec: EnvironmentSpec, put: Predict, state: np.ndarray) -> np.ndarray:
    return put(state[spec.places])


def _followed(instance: Instance) -> dict[str, Predict]:
    """Returns what gives numbers of attributes at a state (S,): those that follow the place in runs.

    After resets these follow it, too.
    """
    spec, rng, states = instance.spec, np.random.default_rng(14), list[np.ndarray]()
    numbers: dict[str, list[np.ndarray]] = {}
    for _ in range(EPISODES):
        instance.reset()
        for _ in chain([None], instance.wander(rng, SAMPLES, HELD)):
            states.append(instance.physics.read())
            for name, owner, key in held(instance.inner, {}):
                if (found := numbers_of(owner[key])) is not None:
                    numbers.setdefault(name.removeprefix("attribute "), []).append(found)
    terms, model = terms_of(spec, instance.model, np.array(states)), instance.model
    followed: dict[str, Predict] = {}
    for name, rows in numbers.items():
        if len(rows) < max(len(states), 3 * terms.shape[1]) or len({len(row) for row in rows}) > 1:
            continue
        table = np.array(rows)
        if np.isfinite(table).all() and (predict := predicted(terms, table)) is not None:
            followed[name] = partial(_by_terms, spec, model, predict)
    return followed


def _renewed(instance: Instance) -> Instance:
    """Returns what can play another run: an instance, or a new one if something outlasts its resets."""
    instance.noted = None
    if instance.spec.anew or instance.renew():
        instance = Instance(instance.spec)
        instance.renew()  # what it is like when it is new
    return instance


# What is seen, and the inputs (m,) that go on from there.
Sample = tuple[Seen, np.ndarray]


def _played(instance: Instance, start: np.ndarray, inputs: list[np.ndarray]) -> list[Sample]:
    """Returns the samples of a run from a start (S,) to its end; one alone if that is inside of something."""
    none, found = np.zeros((len(inputs) + 1, instance.spec.dimension)), list[Sample]()
    for seen, u in zip(instance.play(start, inputs, none), [*inputs, inputs[-1]], strict=True):
        found.append((seen, u))
        inside = instance.physics.depth(instance.spec.solid) > instance.spec.depth
        if any(seen.report[1:3]) or (len(found) == 1 and inside):
            break
    return found


def _compare_noted(
    other: Instance,
    ours: list[Sample],
    start: np.ndarray,
    noted: dict[str, np.ndarray],
    what: list[str],
) -> Instance:
    """Plays a run from a start (S,) where what a reset noted has other values, and returns what played it.

    Args:
        other: plays it, or a new one.
        ours: the samples of the run where all is as the reset has left it.
        start: MuJoCo's state (S,).
        noted: the values (k,), by name.
        what: the names of all that is changed, for the message.

    Raises:
        BadInput: it goes otherwise.
    """
    spec, other = other.spec, _renewed(other)
    other.noted = lambda: _set(other, noted)
    inputs = [u for _, u in ours[:-1]]
    theirs = other.play(start, inputs, np.zeros((len(ours), spec.dimension)))
    for k, (seen, _) in enumerate(ours):
        try:
            pair = seen, next(theirs)
        except BadInput:  # it fails with values that it does not know
            raise _not_its_own(spec, what) from None
        # The first reward after a start is of what shapes it, and alone it is not judged by.
        first = 0 if "reward" in spec.criterion.asked or k > 1 else 1
        a, b = (
            np.concatenate([s.state[spec.places], s.observation, s.report[first:]]) for s in pair
        )
        if not np.array_equal(a, b, equal_nan=True):
            raise _not_its_own(spec, what)
    return other


def _set(instance: Instance, noted: dict[str, np.ndarray]) -> None:
    """Sets attributes and parts of the model to numbers (k,), by name."""
    for name, owner, key in [*held(instance.inner, {})]:
        if (numbers := noted.get(name.removeprefix("attribute "))) is not None:
            old = owner[key]
            if isinstance(old, np.ndarray) and old.flags.writeable:
                old[...] = numbers.reshape(old.shape)  # it may be known by several names
            else:
                owner[key] = _like(old, list(numbers))
    for name in noted:
        if name.endswith(OF_MODEL):
            part = getattr(instance.model, name.removesuffix(OF_MODEL))
            part[...] = noted[name].reshape(part.shape)


def _like(old: Any, numbers: list[Any]) -> Any:
    """Returns what has the form of a value, of numbers that are taken away."""
    if isinstance(old, dict):
        return {key: _like(part, numbers) for key, part in old.items()}
    if isinstance(old, tuple) and hasattr(old, "_fields"):
        return type(old)(*(_like(part, numbers) for part in old))
    if isinstance(old, list | tuple | deque):
        return type(old)(_like(part, numbers) for part in old)
    if isinstance(old, np.ndarray):
        values = np.array([numbers.pop(0) for _ in range(old.size)]).reshape(old.shape)
        return values if _are_parts(values, old.dtype) else values.astype(old.dtype)
    number = numbers.pop(0)
    return number if _are_parts(number, type(old)) else type(old)(number)


def _are_parts(numbers: Any, kind: Any) -> bool:
    """Returns whether numbers are not those that a kind of whole numbers holds."""
    return np.issubdtype(kind, np.integer) and not np.array_equal(numbers, np.rint(numbers))


def _not_its_own(spec: EnvironmentSpec, what: list[str]) -> BadInput:
    return BadInput(
        f"reset() of {spec.name} notes where it leads to ({', '.join(what[:4])}), and step() goes by that, "
        "so a start elsewhere on the chart is none of its own: let the first step() note it, or give "
        "starts='reset' if all resets lead to one place"
    )


def _check_led(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if runs depend on what a reset computes of the place in MuJoCo that it leads to.

    The other reset finds the robot at the start itself.
    """
    rng, usual, led = np.random.default_rng(11), Instance(spec), Instance(spec)
    none = np.zeros((spec.max_steps + 1, spec.dimension))
    first = 0 if "reward" in spec.criterion.asked else 1  # of the report, by which it is judged
    for state in _starts(spec, rng):
        inputs = [usual.drawn(rng)] * spec.max_steps
        usual, led = map(_renewed, (usual, led))
        ours, theirs = (one.play(state, inputs, none) for one in (usual, led))
        next(ours)
        try:
            led.follow = _Leading(led, state)
            next(theirs)
        except BadInput:  # it cannot begin there
            continue
        finally:
            led.follow = None
        noted = differing(led.memory(), usual.memory())
        if not noted:
            return
        if usual.physics.depth(spec.solid) > spec.depth:
            continue
        for pair in zip(ours, theirs, strict=True):
            a, b = (np.concatenate([*seen[:2], seen.report[first:]]) for seen in pair)
            if not np.array_equal(a, b, equal_nan=True):
                raise _not_its_own(spec, noted[:1])
            if any(pair[0].report[1:3]):
                break


class _Leading:
    """Has each line of Python in a reset find the robot at the chart's place in a state (S,), if it is given.

    Raises:
        BadInput: the lines do not end.
    """

    def __init__(self, instance: Instance, state: np.ndarray | None):
        spec = instance.spec
        self._instance, self._lines = instance, 0
        pairs = zip(spec.coordinates, spec.places, strict=True)
        self._values = [(c.kind, c.index, state[at]) for c, at in pairs if state is not None]

    def __call__(self, *_: Any) -> Any:
        self._lines += 1
        if self._lines > LINES:
            raise BadInput(f"a reset of {self._instance.name} does not end")
        for kind, i, value in self._values:
            getattr(self._instance.data, kind)[i] = value
        return self


def _naturals(spec: EnvironmentSpec, resets: Resets) -> Iterator[Instance]:
    """Yields new instances whose own resets lead to other places.

    These are drawn, or the home that resets go by (as `init_qpos`, a keyframe, or a variable of the class) is
    moved to places on the chart, and moved back after the reset.
    """
    if np.ptp(spec.z(resets.states), axis=0).any() and "goal" not in spec.found:
        for seed in range(1, 1 + EPISODES // 2):
            natural = Instance(spec)
            natural.reset(seed)
            yield natural
    starts = _starts(spec, np.random.default_rng(12))[: EPISODES // 2]
    places = spec.places[[c.kind == "qpos" for c in spec.coordinates]]
    probe = Instance(spec)
    for name in _homes(probe) if len(places) else ():
        for state in starts:
            by = state[places] - spec.state[places]
            if not _resets_moved(probe, name, by):
                continue
            if not np.allclose(probe.physics.read()[places], state[places], rtol=SAME, atol=SAME):
                break  # it leads to no other places
            natural = Instance(spec)
            _resets_moved(natural, name, by)
            yield natural


def _homes(instance: Instance) -> dict[str, tuple[Any, Any, list[int]]]:
    """Returns numbers that may be the place to which resets lead: owners, keys, and where the chart's are.

    They are as many as positions, of the chart at least, in attributes, in variables that instances share,
    or in keyframes.
    """
    at, nq = [c.index for c in instance.spec.coordinates if c.kind == "qpos"], instance.model.nq
    found = dict[str, tuple[Any, Any, list[int]]]()
    for name, owner, key in (*held(instance.inner, {}), *shared_variables(instance.env)):
        numbers = numbers_of(_value(owner, key))
        if numbers is not None and len(at) <= len(numbers) <= nq:
            found[name] = owner, key, at if len(numbers) == nq else [*range(len(at))]
    keys = [nq * row + i for row in range(instance.model.nkey) for i in at]
    return {**found, "key_qpos": (instance.model, "key_qpos", keys)} if keys else found


def _value(owner: Any, key: Any) -> Any:
    return owner[key] if isinstance(owner, dict | list) else getattr(owner, key)


def _resets_moved(instance: Instance, name: str, by: np.ndarray) -> bool:
    """Resets an instance with numbers moved by (d,), of a name of `_homes`; returns whether it can be.

    Afterwards these are back.
    """
    owner, key, at = _homes(instance)[name]
    old = _value(owner, key)
    numbers = np.array(numbers_of(old), dtype=float)
    numbers[at] += np.resize(by, len(at))
    in_place = isinstance(old, np.ndarray) and old.dtype.kind == "f" and old.flags.writeable
    kept = copy.copy(old)
    if in_place:
        old[...] = numbers.reshape(old.shape)  # it may be known by several names
    else:
        _put(owner, key, _like(old, numbers.tolist()))
    instance.follow = _Leading(instance, None)
    try:
        instance.reset()
    except BadInput:
        return False
    finally:
        instance.follow = None
        if in_place:
            old[...] = kept
        else:
            _put(owner, key, old)
    return True


def _put(owner: Any, key: Any, value: Any) -> None:
    if isinstance(owner, dict | list):
        owner[key] = value
    else:
        setattr(owner, key, value)


def _check_natural(spec: EnvironmentSpec, resets: Resets) -> None:
    """Raises `BadInput` if a run that a reset begins goes otherwise than one that is put to the same place.

    The robot is put there as that reset left it, and all else is as the reset left it that runs begin with.
    """
    usual, rng = Instance(spec), np.random.default_rng(12)
    own = np.append(own_of(spec, usual.model), usual.physics.columns["warmstart"])
    n = min(NATURAL, spec.max_steps)
    none = np.zeros((n + 1, spec.dimension))
    for natural in _naturals(spec, resets):
        state = spec.state.copy()
        state[own] = natural.physics.read()[own]
        if natural.physics.depth(spec.solid) > spec.depth:
            continue
        inputs = [usual.drawn(rng)] * n
        seen = natural.goes_on(inputs, none[1:])
        usual = _renewed(usual)
        other = usual.play(state, inputs, none)
        next(other)
        noted = differing(natural.memory(), usual.memory())
        for k, (a, b) in enumerate(zip(seen, other, strict=True)):
            # Wrappers may have seen another first observation, where the reset shows what is not up to date.
            here, there = (
                np.concatenate(
                    [
                        one.state[spec.places],
                        [] if spec.wrapped else one.observation,
                        one.report[0 if k else 1 :],
                    ]
                )
                for one in (a, b)
            )
            if not np.allclose(here, there, rtol=SAME, atol=SAME, equal_nan=True):
                told = ", ".join(noted[:4]) or "no attribute tells what"
                raise BadInput(
                    f"a run of {spec.name} that begins where another reset leads to goes otherwise after "
                    f"{k + 1} sample(s) than that reset has it go: what resets set to where they lead to "
                    f"stays elsewhere ({told}). Let the first step() note it, pin it, or "
                    "give starts='reset' if all resets lead to one place"
                )
            if any(a.report[1:3]):
                break
