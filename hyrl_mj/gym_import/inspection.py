"""The inspection of an environment: what it is found to have and to do, before anything rests on it."""

from __future__ import annotations

import logging
import time
import timeit
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj.errors import BadInput
from hyrl_mj.files import trust
from hyrl_mj.gym_import import trials
from hyrl_mj.gym_import.coordinates import (
    all_names,
    bounds_of,
    coordinates,
    own_of,
    robot_of,
)
from hyrl_mj.gym_import.draws import check_draws
from hyrl_mj.gym_import.expressions import Expression
from hyrl_mj.gym_import.fingerprint import codes_of, differing, is_known
from hyrl_mj.gym_import.instance import Instance, outlasting
from hyrl_mj.gym_import.observations import parts_of
from hyrl_mj.gym_import.opening import (
    COUNTING,
    FORMS,
    AnyChart,
    Description,
    actions_of,
    layers,
    made,
)
from hyrl_mj.gym_import.pool import Pool
from hyrl_mj.gym_import.resets import SAME, resets_of, violation_of
from hyrl_mj.gym_import.specification import Criterion
from hyrl_mj.gym_import.starts import VIOLATED, check_noted
from hyrl_mj.physics import memory, mjcf
from hyrl_mj.sets import Chart

# Resets and steps of an inspection, and environments that are made, about (without wrappers half as many
# resets), and from how long on it is said how long it takes [s].
TAKEN, LONG = (750, 12_000, 100), 60.0
# Runs under inputs at random that show what an environment does at all, and their samples at most.
RUNS, LENGTH = 16, 150
# What is said of an observation that shows derived quantities from before the end of a step.
LAG = {
    "earlier": "is that of a physics step before the end of a step, with noise, too",
    "unknown": "is from shortly before the end of a step; noise adds what it changes at the end",
}


def inspect(description: Description, untried: bool = False) -> tuple[Pool, Instance]:
    """Returns what plays the episodes of an environment and knows about it, and an instance to look at.

    Args:
        description: what the user says of it.
        untried: whether it is made, reset and stepped first within limits of time and memory.

    Raises:
        BadInput: it cannot be used, or one of its instances went another way than a new one.
    """
    pool = Pool(description)  # before anything has been made
    if untried and pool.forks:
        pool.try_out()
    elif untried and trust.is_received():
        raise BadInput(
            f"{description.name} comes from a file of others, and this process cannot fork another one that "
            "tries it within limits of time and memory: open it once in the main process of a program"
        )
    instance, began = Instance(pool.spec), time.monotonic()
    if made(description).unwrapped is instance.inner:
        raise BadInput(
            f"{description.name} gives the same environment each time, and episodes are played by several: "
            "let it make a new one"
        )
    _check_times(instance, time.monotonic() - began)
    _check_pinned(instance)
    instance.reset()
    _learn_spaces(instance)
    instance.learn(observers=trials.observers_of(instance))
    _learn_coordinates(instance)
    states, info = _sampled(instance)
    instance.learn(criterion=_criterion(instance, info))
    resets = resets_of(instance)
    if draws := check_draws(instance, resets, states):
        instance.spec.found["goal"] = draws
    used, instance = instance, Instance(instance.spec)  # something may have outlasted resets
    instance.learn(state=_at_rest(instance, resets.states))
    _learn_bounds(instance, instance.spec.z(states), instance.spec.z(resets.states))
    instance.learn(recalled=trials.check_observer(instance.spec))
    pool.learn(instance.spec)
    trials.check_episodes(pool)
    trials.check_use(instance.spec)
    trials.check_copied(instance.spec)
    derived, late = trials.derived_of(instance)
    if late:
        instance.spec.found["lag"] = f"observation {', '.join(map(str, late))} {LAG[derived]}"
    instance.learn(derived=derived)
    instance.learn(led=check_noted(instance.spec, resets))
    pool.learn(instance.spec)
    moves, at_rest = trials.moving(pool)
    trials.check_noise(pool)
    memoryless = pool.spec.memoryless and trials.goes_on(pool)
    pool.learn(replace(pool.spec, moves=moves, at_rest=at_rest, memoryless=memoryless))
    if lasts := outlasting(used):
        instance.spec.found["episodes"] = (
            "each is played by a new environment, because of what outlasts resets "
            f"({', '.join(lasts[:4])}); no trial shows that what comes next depends on it"
        )
    instance = Instance(pool.spec)
    instance.reset()
    return pool, instance


def _check_times(instance: Instance, making: float) -> None:
    """Raises `BadInput` if a reset or a step takes so long that runs would take hours; says so of minutes.

    To make one takes `making` [s].
    """
    u, taken = instance.drawn(np.random.default_rng(0)), []
    for name, take, most, why in (
        ("reset", instance.reset, 3.0, "each of thousands of episodes begins with it"),
        ("step", lambda: instance.stepped(u), 0.3, "thousands of episodes take many of them"),
    ):
        # It may have to get ready at first, or wait for a busy core.
        taken.append(min(timeit.repeat(take, instance.reset, repeat=3, number=1)))
        if taken[-1] > most:
            raise BadInput(
                f"{name}() of {instance.name} takes {taken[-1]:.1f} s, and {why}: give an environment "
                f"whose {name} takes less than {most:g} s"
            )
    if (spent := np.dot([*taken, making], TAKEN)) > LONG:
        logging.getLogger("hyrl_mj").warning(
            f"{instance.name} takes {1e3 * making:.0f} ms to be made, {1e3 * taken[0]:.0f} ms for a reset "
            f"and {1e3 * taken[1]:.0f} ms for a step: to look at it, before anything else, takes about "
            f"{spent / 60:.0f} minute(s)"
        )


def _check_pinned(instance: Instance) -> None:
    """Raises `BadInput` if pinned positions violate a limit or a tie, or are no orientation."""
    names = [name for name in instance.spec.description.pinned if name.startswith("qpos[")]
    off = list[float]()
    for plain in (True, False) if names else ():
        instance.reset(plain=plain)
        instance.physics.write(instance.physics.read())
        off.append(violation_of(instance, joints=True))
    told = f"pinned {', '.join(names[:4])} of {instance.name}"
    if off and off[1] > off[0] + VIOLATED:
        raise BadInput(
            f"{told} violates a range of a joint or tendon, or an equality constraint, by {off[1]:.3g} m or "
            "rad, so that runs begin with a push: pin what lies within"
        )
    unit = instance.data.qpos.copy()
    mujoco.mj_normalizeQuat(instance.model, unit)
    wrong = np.flatnonzero(np.abs(unit - instance.data.qpos) > SAME)
    if any(f"qpos[{i}]" in names for i in wrong):
        raise BadInput(
            f"{told} is a part of a quaternion, whose squares do not sum to 1 with it: pin all of its four "
            "numbers"
        )


def _learn_spaces(instance: Instance) -> None:
    """Finds what is observed and put in."""
    model, space = instance.model, instance.env.observation_space
    if problem := memory.sleeping(model):
        raise BadInput(f"{instance.name} cannot be used: {problem}")
    held = np.flatnonzero((model.sensor_delay != 0) | (model.sensor_interval != 0).any(axis=1))
    if len(held):
        named = ", ".join(model.sensor(i).name or f"sensor {i}" for i in held[:4])
        raise BadInput(
            f"sensors of {instance.name} hold or delay what they measure ({named}), which noise on the state "
            "would not reach: leave out delay and interval, and put a DelayObservation around it"
        )
    actions = actions_of(instance.env)
    parts = parts_of(space)
    observation_low, observation_high = (
        np.concatenate([np.ravel(getattr(part, end)) for part in parts.values()], dtype=float)
        for end in ("low", "high")
    )
    levels = int(actions.n) if isinstance(actions, spaces.Discrete) else None
    ends = (0, levels - 1) if levels is not None else (actions.low, actions.high)
    low, high = (np.array(end, dtype=float).ravel() for end in ends)
    names = [model.actuator(i).name.rpartition("/")[2] for i in range(model.nactuator)]
    if len(names) != len(low) or not all(names):
        names = [f"action[{i}]" for i in range(len(low))]
    is_dict = isinstance(space, spaces.Dict)
    instance.learn(
        qpos=instance.physics.columns["qpos"],
        qvel=instance.physics.columns["qvel"],
        observation_low=observation_low,
        observation_high=observation_high,
        parts={n: int(spaces.flatdim(part)) for n, part in parts.items()} if is_dict else {},
        low=low,
        high=high,
        inputs=tuple(names),
        levels=levels,
        wrapped=instance.is_wrapped,
    )


def _learn_coordinates(instance: Instance) -> None:
    """Finds the coordinates of the chart, those that are given or the usual ones, and the noise on them."""
    description, found = instance.spec.description, instance.spec.found
    space = instance.env.observation_space
    if description.chart is not None:
        chosen = coordinates(instance, description.chart)
    else:
        usual: AnyChart = [f"qpos[{i}]" for i in range(min(instance.model.nq, 2))]
        if isinstance(space, spaces.Dict) and "achieved_goal" in space.spaces:
            usual = "achieved_goal"
        chosen = coordinates(instance, usual)
        names = [c.described() for c in chosen]
        said = f"{usual} ({', '.join(names)})" if isinstance(usual, str) else ", ".join(names)
        others = [name for name in all_names(instance) if name not in (*names, usual)]
        found["chart"] = f"{said}; others are {', '.join(others[:12])}"
    for c in chosen:
        if c.described() in description.pinned:
            raise BadInput(
                f"{c.described()} is the coordinate {c.name} of the chart, where runs begin anywhere: leave "
                "it out of what is pinned, or name another chart"
            )
    noisy = description.noisy
    if noisy is None:
        noisy = [float(c.kind == "qpos") for c in chosen]
        on = ", ".join(c.name for c in chosen if c.kind == "qpos")
        found["noise"] = f"on {on}, in the unit of each; or give the share of each with noisy"
    if len(noisy) != len(chosen):
        raise BadInput(
            f"noisy has {len(noisy)} share(s), and the chart {len(chosen)} coordinate(s) "
            f"({', '.join(c.name for c in chosen)}): give one for each"
        )
    solid = robot_of(instance.model, chosen)[instance.model.geom_bodyid]
    instance.learn(coordinates=chosen, noisy=tuple(map(float, noisy)), solid=solid)


def _sampled(instance: Instance) -> tuple[np.ndarray, list[str]]:
    """Finds what runs under inputs at random show; refuses random numbers in steps.

    Returns:
        MuJoCo's states (n, S) that they met, and the keys of `info`.
    """
    rng, model = np.random.default_rng(0), instance.model
    states, rewards, bodies, geoms = [], [], [], []
    info_keys: dict[str, None] = {}
    deepest, dt, harmless, remembers = 0.0, 0.0, set[int](), False
    for seed in range(RUNS):
        instance.reset(seed)
        instance.mark()
        before, began = instance.memory(), instance.data.time
        deepest = max(deepest, instance.physics.depth(instance.spec.solid))
        for _, reward, terminated, truncated, info in instance.wander(rng, LENGTH, held=15):
            states.append(instance.physics.read())
            dt = dt or float(instance.data.time - began)
            deepest = max(deepest, instance.physics.depth(instance.spec.solid))
            rewards.append(float(reward))
            info_keys |= dict.fromkeys(key for key in info if isinstance(key, str))
            bodies.append(instance.data.xpos.copy())
            geoms.append(instance.data.geom_xpos.copy())
            if not (terminated or truncated):
                harmless |= instance.physics.touched(instance.spec.solid)
        instance.finish()
        remembers = remembers or not is_known(before) or bool(differing(instance.memory(), before))
    if dt <= 0:
        raise BadInput(
            f"the time of {instance.name} stands still in step(), so nothing tells how long a step is: let "
            "it call mj_step, or add its duration to data.time"
        )
    if not np.isfinite(rewards).all():
        raise BadInput(f"step() of {instance.name} gives rewards that are not finite: repair it")
    instance.learn(
        dt=round(dt, 9),
        worst_reward=min(*rewards, 0.0),
        depth=deepest,
        harmless=frozenset(harmless),
        tracked=_farthest(model.body, bodies) or _farthest(model.geom, geoms),
        memoryless=not remembers and not instance.is_wrapped,
    )
    return np.array(states), list(info_keys)


def _farthest(named: Any, places: Sequence[np.ndarray]) -> str:
    """Returns the name of what goes farthest, of places (k, n, 3) [m]; none if nothing does."""
    went = np.ptp(places, axis=0).sum(axis=1)
    return str(named(int(went.argmax())).name) if went.max() > 1e-6 else ""


def _criterion(instance: Instance, info: Sequence[str]) -> Criterion:
    """Returns when an episode is a success; `info` has had these keys."""
    description, name, found = instance.spec.description, instance.name, instance.spec.found
    success, failure = description.success, description.failure
    if success is None or success.strip() == "info":
        usual = "success", "is_success"
        told = [key for key in usual if key in info]
        if not told:  # what only a success brings is found in the code
            told = [key for key in usual if _is_written(instance.env, key)]
            told = told if len(told) == 1 else []
        if not told:
            raise BadInput(
                f"{name} does not tell in its info when it succeeds: say so with success, as {FORMS}"
            )
        if success is None:
            found["success"] = f'info["{told[0]}"]; or give {FORMS}'
        success = f'info["{told[0]}"]'
    criterion = Criterion(name, Expression.parse(success, "success"))
    if failure is None:
        found["failure"] = "an episode that the environment ends without success; or give failure"
    else:
        criterion = replace(criterion, failure=Expression.parse(failure, "failure"))
    for path in criterion.keys:
        if path[0] not in info and not _is_written(instance.env, path[0]):
            met = f"it has had {', '.join(info)}" if info else "it has been empty"
            names = [type(layer).__name__ for layer in layers(made(description))]
            if counting := [one for one in names if one in COUNTING]:
                met += f"; runs are played without {counting[0]}, so say it by reward or terminated"
            raise BadInput(
                f"no sampled run of {name} had {path[0]!r} in its info, and no method of it has that word: "
                f"name an entry of info; {met}"
            )
    model = instance.model
    points = [(mjcf.point_of(model, a), mjcf.point_of(model, b)) for a, b in criterion.places]
    for place in dict.fromkeys(name for pair in criterion.places for name in pair):
        places = [getattr(instance.data, kind)[i] for kind, i in mjcf.points_of(model, place)]
        if len(places) > 1 and (np.ptp(places, axis=0) > 1e-6).any():
            raise BadInput(
                f"several things of {name} have the name {place}, in different places: say which, as in "
                f'distance("body {place}", ...), of site, body and geom'
            )
    return replace(criterion, points=tuple(points))


def _is_written(env: Any, word: str | int) -> bool:
    """Returns whether a word stands in a method of an environment or of one of its wrappers."""
    kinds = {kind for layer in layers(env) for kind in type(layer).__mro__}
    constants = [one for kind in kinds for code in codes_of(kind) for one in code.co_consts]
    return any(word == one or (isinstance(one, tuple) and word in one) for one in constants)


def _at_rest(instance: Instance, begun: np.ndarray) -> np.ndarray:
    """Returns MuJoCo's state (S,) after the reset that all runs begin with, the robot at rest.

    Velocities that all resets, to states (n, S), set alike stay, such as that of a wheel that spins.
    """
    instance.reset()
    spec, model, state = instance.spec, instance.model, instance.physics.read()
    drawn = np.ptp(begun[:, spec.qvel], axis=0) > 0
    pinned = [f"qvel[{i}]" in spec.description.pinned for i in range(model.nv)]
    moving = robot_of(model, spec.coordinates)[model.dof_bodyid]
    state[spec.qvel[moving & drawn & ~np.array(pinned, dtype=bool)]] = 0.0
    return state


def _learn_bounds(instance: Instance, met: np.ndarray, begun: np.ndarray) -> None:
    """Finds the bounds of the chart, what can be passed on both sides in it, starts, and steps.

    Args:
        instance: the environment.
        met: (n, d) chart points that sampled runs have met.
        begun: (n, d) chart points that resets have led to.
    """
    spec, found, given = instance.spec, instance.spec.found, instance.spec.description
    names = tuple(c.name for c in spec.coordinates)
    for name in given.bounds:
        if name not in names:
            raise BadInput(f"bounds for {name} cannot be used: the chart has {', '.join(names)}")
    bounds, islands, plane = bounds_of(instance, met, begun)
    found["bounds"] = ", ".join(
        f"{name} {b.low:.3g} to {b.high:.3g} (from {b.why})"
        for name, b in zip(names, bounds, strict=True)
    )
    low, high, periodic, _ = zip(*bounds, strict=True)
    chart = Chart(names, tuple(c.unit for c in spec.coordinates), low, high, periodic)
    begun = chart.near(begun, begun[0])  # in one turn, which the middle of the chart is in
    middle = (begun.min(axis=0) + begun.max(axis=0)) / 2
    begun = begun + (chart.wrap(middle) - middle)
    ends = [begun.min(axis=0), begun.max(axis=0)]
    lead = ", ".join(f"{n} {a:.3g} to {b:.3g}" for n, a, b in zip(names, *ends, strict=True))
    moving = np.flatnonzero(np.isin(spec.qvel, own_of(instance)) & (spec.state[spec.qvel] != 0))
    but = f" but for {', '.join(f'qvel[{i}]' for i in moving)}" if len(moving) else ""
    found["starts"] = (
        f"all over the chart, the robot at rest{but} and all else as after a reset (deeper than "
        f"{spec.depth:.2g} m inside of something it has crashed); with 'reset' between the places to which "
        f"64 resets lead, at rest{but}, too, and all else as after the reset with seed {given.seed or 0}: "
        f"{lead}"
    )
    if not np.ptp(begun, axis=0).any():
        found["starts"] += (
            ", one place, so no reset shows what else would be elsewhere at other starts; trials led it there"
        )
    start_low, start_high = low, high
    if given.starts == "reset":
        start_low, start_high = (tuple(end.tolist()) for end in ends)
        out = ~np.array(periodic) & ((ends[0] < low) | (ends[1] > high))
        if out.any():
            raise BadInput(
                f"resets of {instance.name} lead to {lead}, beyond the bounds of {names[out.argmax()]} that "
                "are given: give bounds that hold them, or starts='chart'"
            )
    max_steps = given.steps or instance.steps or 1_000  # of one that never ends by itself
    found["sample time"] = f"{spec.dt:g} s, of a step"
    if given.steps is None:
        found["steps"] = f"{max_steps} ({max_steps * spec.dt:g} s) of an episode"
    instance.learn(
        chart=chart,
        islands=islands,
        plane=plane,
        start_low=start_low,
        start_high=start_high,
        max_steps=max_steps,
    )
