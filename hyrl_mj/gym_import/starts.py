"""Whether a start elsewhere on the chart is as one that a reset would lead to.

A run begins after the reset with the seed, and at its own place on the chart. All else stays as that reset
left it. What a reset sets to the place of the robot would be elsewhere: a setpoint, a place that it notes, a
load that is tied to the robot.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dis import get_instructions
from functools import partial
from itertools import chain
from types import FunctionType
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.attributes import (
    held,
    like,
    numbers_in,
    numbers_of,
    put_at,
    set_numbers,
    value_at,
)
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.fingerprint import LIBRARIES, differing, shared_variables
from hyrl_mj.gym_import.instance import Instance, Seen, renewed, to_end
from hyrl_mj.gym_import.resets import (
    OF_MODEL,
    SAME,
    Predict,
    Resets,
    following,
    predicted,
    tabled,
    terms_of,
    violation_of,
)
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, SAMPLES

# Samples of a run from the start of a reset, which is compared with one that is put there.
NATURAL = 100
# Samples that such runs take together before they are cut off there.
LONG = 1_000
# Lines of Python that a reset may take in a trial: one that draws until something holds may never end.
LINES = 100_000
# By how much equality constraints and limits of tendons may be violated more than after resets [m, rad].
VIOLATED = 1e-3


def check_noted(spec: EnvironmentSpec, resets: Resets) -> None:
    """Raises `BadInput` if a run from a start on the chart is not as a reset to there would have it go.

    Runs that are put to a start are compared with the same ones where what follows the place has been moved
    along, where the reset finds the robot at the start, and where a reset leads there by itself. Their inputs
    do not change, which leads far away.
    """
    _check_ties(spec, resets)
    _check_following(spec, resets)
    _check_led(spec)
    _check_natural(spec, resets)
    _check_begun(spec)


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


# ---- two runs from one start


def _check_alike(
    spec: EnvironmentSpec,
    ours: Iterable[Seen],
    theirs: Iterable[Seen],
    noted: Sequence[str],
    since: int = 0,
    rounding: float = 0.0,
) -> None:
    """Raises `BadInput` if two runs differ before the end of the first.

    Args:
        spec: what is known of the environment.
        ours, theirs: what is seen of them: one is put to the start, the other begins there as a reset does.
        noted: the names of what differs between them.
        since: the sample with which both begin.
        rounding: by how much numbers may differ, as a share.
    """
    for k, (a, b) in enumerate(zip(to_end(ours), theirs, strict=False), since):
        # The first reward after a start is of what shapes it, and alone it is not judged by.
        first = 0 if "reward" in spec.criterion.asked or k > 1 else 1
        here, there = (
            np.concatenate([one.state[spec.places], one.observation, one.report[first:]])
            for one in (a, b)
        )
        if not np.allclose(here, there, rtol=rounding, atol=rounding, equal_nan=True):
            raise _not_its_own(spec, noted)


def _not_its_own(spec: EnvironmentSpec, noted: Sequence[str]) -> BadInput:
    names = ", ".join(noted[:4]) or "no attribute tells where"
    return BadInput(
        f"reset() of {spec.name} notes where it leads to ({names}), and step() goes by that, so a start "
        "elsewhere on the chart is none of its own: let the first step() note it, pin it, or give "
        "starts='reset' if all resets lead to one place"
    )


# ---- what follows the place is moved along


def _check_following(spec: EnvironmentSpec, resets: Resets) -> None:
    """Raises `BadInput` if runs depend on what follows the place, and is not at the start's."""
    rng, usual, other = np.random.default_rng(11), Instance(spec), Instance(spec)
    drawn = np.ptp(spec.z(resets.states), axis=0).any()
    moved_along, follow = _of_draws(usual, resets) if drawn else _of_one_place(usual)
    starts, none = _starts(spec, rng), np.zeros((spec.max_steps + 1, spec.dimension))
    # So far away that limits on it show.
    far = {name: 3 * np.ptp([of(s) for s in starts], axis=0) for name, of in follow.items()}
    for i, state in enumerate(starts):
        moved = moved_along(state)
        names = [usual.physics.names[at] for at in np.flatnonzero(moved != state)]
        if not (follow or names):
            return
        usual, inputs = renewed(usual), [usual.drawn(rng)] * spec.max_steps
        run = usual.play(state, inputs, none)
        ours = [next(run)]
        if usual.physics.depth(spec.solid) > spec.depth:
            continue
        ours += to_end(run)
        values = {name: of(state) for name, of in follow.items()}
        tries = [(ours, moved, values, [*follow, *names])]
        for sign in (1, -1) if follow and i < EPISODES // 2 else ():
            away = {name: values[name] + sign * far[name] for name in follow}
            tries.append((ours[: NATURAL if i else None], state, away, [*follow]))
        for seen, start, noted, what in tries:
            other = renewed(other)
            other.noted = partial(_set, other, noted)
            try:
                _check_alike(spec, seen, other.play(start, inputs, none), what)
            except BadInput:  # also of one that fails with values that it does not know
                raise _not_its_own(spec, what) from None


def _of_draws(usual: Instance, resets: Resets) -> tuple[Predict, dict[str, Predict]]:
    """Returns what moves a state (S,) along with its place, and what gives numbers of attributes there.

    Both are of what follows the place over resets, which draw it.
    """
    columns, states = usual.physics.columns, resets.states
    passed = [columns["time"], columns["warmstart"], own_of(usual)]
    free = np.setdiff1d(np.arange(states.shape[1]), np.concatenate(passed))
    of_state = predicted(usual, states, states[:, free])

    def moved_along(state: np.ndarray) -> np.ndarray:
        moved = state.copy()
        if of_state is not None:
            now = of_state(state)
            changes = np.abs(now - state[free]) > 1e-9 * np.maximum(np.abs(now), 1.0)
            moved[free[changes]] = now[changes]
        return moved

    return moved_along, following(usual, states, resets.numbers)


def _of_one_place(usual: Instance) -> tuple[Predict, dict[str, Predict]]:
    """Returns the same where resets lead to one place: of what holds or follows it, or pulls there."""
    spec, columns, follow = usual.spec, usual.physics.columns, _followed(usual)
    usual.reset()
    for name, numbers in numbers_in(usual.inner).items():
        put = _equal_to(spec, numbers)
        if put is not None and _is_set_by_reset(spec, name, put(spec.state + 1.0)):
            follow[name] = put

    def moved_along(state: np.ndarray) -> np.ndarray:
        moved = _setpoints(usual, spec.state, state)
        for kind in ("mocap_pos", "userdata"):
            if (put := _equal_to(spec, state[columns[kind]])) is not None:
                moved[columns[kind]] = put(state)
        return moved

    return moved_along, follow


def _followed(instance: Instance) -> dict[str, Predict]:
    """Returns what gives numbers of attributes at a state (S,): those that follow the place in runs.

    After resets these follow it, too.
    """
    rng, states = np.random.default_rng(14), list[np.ndarray]()
    rows = list[dict[str, np.ndarray]]()
    for _ in range(EPISODES):
        instance.reset()
        for _ in chain([None], instance.wander(rng, SAMPLES, HELD)):
            states.append(instance.physics.read())
            rows.append(numbers_in(instance.inner))
    met = np.array(states)
    enough = len(met) >= 3 * terms_of(instance, met).shape[1]
    return following(instance, met, tabled(rows)) if enough else {}


def _equal_to(spec: EnvironmentSpec, numbers: np.ndarray) -> Predict | None:
    """Returns what puts another place where numbers (k,) hold that of the reset; None if they do not.

    Whole numbers that stand alone may be anything else, and so may zeros.
    """
    place, at = spec.state[spec.places], list[int]()
    d = len(place)
    if place.any() and (d > 1 or not float(place[0] * 2).is_integer()):
        at = [i for i in range(len(numbers) - d + 1) if np.array_equal(numbers[i : i + d], place)]
    if not at:
        return None

    def put(state: np.ndarray) -> np.ndarray:
        found = numbers.copy()
        for i in at:
            found[i : i + d] = state[spec.places]
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
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1]
    affine = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    for i in np.flatnonzero(affine & (gain != 0) & (bias != 0)):
        kind, at = "ctrl", model.actuator_ctrladr[i]
        if model.actuator_dyntype[i] and model.actuator_actadr[i] >= 0:
            kind, at = "act", model.actuator_actadr[i]
        away = (lengths[1] - lengths[0])[model.actuator_outadr[i]]
        moved[physics.columns[kind][at]] -= bias[i] / gain[i] * away
    return moved


def _set(instance: Instance, values: dict[str, np.ndarray]) -> None:
    """Sets attributes and parts of the model to numbers (k,), by name."""
    set_numbers(instance.inner, values)
    for name in values:
        if name.endswith(OF_MODEL):
            part = getattr(instance.model, name.removesuffix(OF_MODEL))
            numbers = np.where(np.isnan(values[name]), part.ravel(), values[name])
            part[...] = numbers.reshape(part.shape)


# ---- the reset finds the robot at the start


def _check_led(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if runs depend on what a reset computes of the place in MuJoCo that it leads to."""
    rng, usual, led = np.random.default_rng(11), Instance(spec), Instance(spec)
    none = np.zeros((spec.max_steps, spec.dimension))
    own = np.append(own_of(usual), usual.physics.columns["warmstart"])
    for state in _starts(spec, rng):
        inputs = [usual.drawn(rng)] * spec.max_steps
        usual, led = map(renewed, (usual, led))
        usual.put(state)
        led.follow, led.own = _Leading(led, state), own  # all else in MuJoCo as the reset leaves it
        try:
            led.put(state, spec.description.seed or 0)
        except BadInput:  # it cannot begin there
            continue
        finally:
            led.own = None
        noted = differing(led.memory(), usual.memory())
        states = led.physics.read(), usual.physics.read()
        moved = ~np.isclose(*states, rtol=SAME, atol=SAME)
        noted += [usual.physics.names[at] for at in np.flatnonzero(moved)]
        if not noted:
            return
        if usual.physics.depth(spec.solid) <= spec.depth:
            ours, theirs = (one.goes_on(inputs, none) for one in (usual, led))
            _check_alike(spec, ours, theirs, noted[:1], since=1, rounding=SAME)


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


# ---- resets lead elsewhere by themselves


def _check_natural(spec: EnvironmentSpec, resets: Resets) -> None:
    """Raises `BadInput` if a run that a reset begins goes otherwise than one that is put to the same place.

    The robot is put there as that reset left it, and all else is as the reset left it that runs begin with.
    """
    usual, rng, taken = Instance(spec), np.random.default_rng(12), 0
    own = np.append(own_of(usual), usual.physics.columns["warmstart"])
    for natural in _naturals(spec, resets):
        n = spec.max_steps if taken < LONG else min(NATURAL, spec.max_steps)
        none, taken = np.zeros((n + 1, spec.dimension)), taken + n
        state = spec.state.copy()
        state[own] = natural.physics.read()[own]
        if natural.physics.depth(spec.solid) > spec.depth:
            continue
        inputs, usual = [usual.drawn(rng)] * n, renewed(usual)
        runs = [natural.goes_on(inputs, none[1:]), usual.play(state, inputs, none)]
        next(runs[1])
        noted = differing(natural.memory(), usual.memory())
        # Wrappers may have seen another first observation, where the reset shows what is not up to date.
        passed: dict[str, Any] = {"observation": np.empty(0)} if spec.wrapped else {}
        theirs, ours = ((seen._replace(**passed) for seen in run) for run in runs)
        _check_alike(spec, theirs, ours, noted, since=1, rounding=SAME)


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
            now = probe.physics.read()[places]
            there, stays = (np.isclose(now, one[places], SAME, SAME) for one in (state, spec.state))
            if not (there | stays).all() or stays.all():
                break  # it leads to no other places
            natural = Instance(spec)
            _resets_moved(natural, name, by)
            yield natural


def _homes(instance: Instance) -> dict[str, tuple[Any, Any, list[int]]]:
    """Returns numbers that may be the place to which resets lead: owners, keys, and where the chart's are.

    They are as many as positions, of the chart at least, in attributes, in variables that instances share,
    or in keyframes. Numbers in the code of a method are those of the chart's place that stand there once.
    """
    spec = instance.spec
    at, nq = [c.index for c in spec.coordinates if c.kind == "qpos"], instance.model.nq
    found = dict[str, tuple[Any, Any, list[int]]]()
    for name, owner, key in (*held(instance.inner, {}), *shared_variables(instance.env)):
        numbers = numbers_of(value_at(owner, key))
        if numbers is not None and len(at) <= len(numbers) <= nq:
            found[name] = owner, key, at if len(numbers) == nq else [*range(len(at))]
    place = spec.state[spec.places[[c.kind == "qpos" for c in spec.coordinates]]]
    for kind in type(instance.inner).__mro__:
        own = kind.__module__.partition(".")[0] not in LIBRARIES
        for name, method in vars(kind).items() if own else ():
            if isinstance(method, FunctionType) and (code := _Constants(method, place)).found.any():
                found[f"numbers in {name}()"] = code, "numbers", [*range(len(at))]
    keys = [nq * row + i for row in range(instance.model.nkey) for i in at]
    return {**found, "key_qpos": (instance.model, "key_qpos", keys)} if keys else found


class _Constants:
    """The numbers (d,) of a place that the code of a function holds, which can be set as others.

    Attributes:
        found: (d,) bool, those that it holds once, and are no zeros.
    """

    def __init__(self, function: FunctionType, place: np.ndarray):
        self._function, self._code, self._place = function, function.__code__, place
        loaded = [one.argval for one in get_instructions(function) if one.opname == "LOAD_CONST"]
        flat = [x for one in loaded for x in (one if isinstance(one, tuple) else (one,))]
        numbers = [x for x in flat if type(x) in (int, float)]
        self.found = np.array([numbers.count(x) == 1 and x != 0 for x in place.tolist()])

    @property
    def numbers(self) -> list[float]:
        return [float(x) for x in self._place]

    @numbers.setter
    def numbers(self, numbers: list[float]) -> None:
        known = zip(self._place[self.found].tolist(), np.array(numbers)[self.found], strict=True)
        new = {x: float(y) for x, y in known}

        def moved(one: Any) -> Any:
            if isinstance(one, tuple):
                return tuple(map(moved, one))
            return new.get(one, one) if type(one) in (int, float) else one

        moves = numbers != self.numbers
        consts = tuple(map(moved, self._code.co_consts)) if moves else self._code.co_consts
        self._function.__code__ = self._code.replace(co_consts=consts)


def _resets_moved(instance: Instance, name: str, by: np.ndarray) -> bool:
    """Resets an instance with numbers moved by (d,), of a name of `_homes`; returns whether it can be.

    Afterwards these are back.
    """
    if (
        home := _homes(instance).get(name)
    ) is None:  # a reset holds it otherwise than a constructor
        return False
    owner, key, at = home
    old = value_at(owner, key)
    numbers = np.array(numbers_of(old), dtype=float)
    numbers[at] += np.resize(by, len(at))
    in_place = isinstance(old, np.ndarray) and old.dtype.kind == "f" and old.flags.writeable
    kept = copy.copy(old)
    if in_place:
        old[...] = numbers.reshape(old.shape)  # it may be known by several names
    else:
        put_at(owner, key, like(old, numbers.tolist()))
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
            put_at(owner, key, old)
    return True
