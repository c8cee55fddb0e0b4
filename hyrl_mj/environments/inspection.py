"""The inspection of an environment: what it is found to have and to do, before anything rests on it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces

from hyrl_mj import mjcf
from hyrl_mj.chart import Chart
from hyrl_mj.environments import trials
from hyrl_mj.environments.coordinates import (
    Coordinate,
    all_names,
    bounds_of,
    coordinates,
    groups_of,
    islands_of,
    robot_of,
)
from hyrl_mj.environments.draws import check_draws, states_of_resets
from hyrl_mj.environments.expressions import Expression
from hyrl_mj.environments.fingerprint import differing, fingerprint
from hyrl_mj.environments.instance import EARLIER, UNKNOWN, Instance, Recipe, Worn
from hyrl_mj.environments.observations import parts_of
from hyrl_mj.environments.opening import RESET, AnyChart, Description
from hyrl_mj.environments.pool import Pool
from hyrl_mj.environments.specification import FORMS, Criterion, EnvironmentSpec
from hyrl_mj.errors import BadInput, unknown

# Samples of an episode of an environment that never ends by itself.
STEPS_WITHOUT_END = 1_000
# Each episode begins with a reset, and has hundreds of steps: those that take longer [s] would take hours.
LONGEST_RESET, LONGEST_STEP = 3.0, 0.3
# Runs under inputs at random that show how far coordinates go, their steps, and for how long inputs are held.
RUNS, STEPS, HELD = 16, 150, 15
# What info calls success.
SUCCESS = ("success", "is_success")
# What goes no farther than this stands [m].
STANDS = 1e-6
# What is said of an observation that shows derived quantities from before the end of a step.
LAG = {
    EARLIER: "is that of a physics step before the end of a step, with noise, too",
    UNKNOWN: "is from shortly before the end of a step; noise adds what it changes at the end",
}


@dataclass(frozen=True)
class Runs:
    """What runs under inputs at random showed.

    Attributes:
        states: MuJoCo's states (n, S) that they met.
        info: the keys of `info`.
        worst_reward: the least reward.
        deepest: how deep the robot was inside of something [m], at most.
        dt: time of a step [s].
        tracked: name of the body that went farthest, or of the geom where no body went anywhere.
        memory: the name of what changed, "" if nothing did.
        harmless: the geoms that the robot touched without an end of the episode.
    """

    states: np.ndarray
    info: tuple[str, ...]
    worst_reward: float
    deepest: float
    dt: float
    tracked: str
    memory: str
    harmless: frozenset[int]


def inspect(description: Description) -> tuple[EnvironmentSpec, Pool, Instance]:
    """Returns what is known of an environment, what plays its episodes, and an instance to look at.

    Raises:
        BadInput: it cannot be used, or one of its instances went another way than a new one.
    """
    found: dict[str, str] = {}
    instance = Instance(Recipe(description))
    _check_times(instance)
    instance.reset()
    instance.recipe = replace(instance.recipe, observer=trials.observer_of(instance))
    chosen = _chart_of(instance, found)
    model, columns = instance.model, instance.physics.columns
    at = [int(columns[c.kind][c.index]) for c in chosen]
    offset = tuple(c.offset for c in chosen)
    robot = robot_of(model, chosen)
    solid = robot[model.geom_bodyid]
    instance.recipe = replace(instance.recipe, noisy=tuple(at), offset=offset, solid=solid)
    runs = _sampled(instance)
    criterion = _criterion(instance, runs, found)
    instance.recipe = recipe = replace(
        instance.recipe,
        keys=criterion.keys,
        places=tuple(
            (mjcf.point_of(model, a), mjcf.point_of(model, b)) for a, b in criterion.places
        ),
        harmless=runs.harmless,
    )
    resets = states_of_resets(instance)
    if draws := check_draws(instance, resets, robot):
        found["goal"] = draws
    instance = Instance(recipe)  # something may have outlasted the resets of the other
    state = _at_rest(instance, robot)
    in_plane = len(chosen) >= 2 and all(c.unit == "m" for c in chosen[:2])
    groups = groups_of(instance, runs.states[:, at[:2]]) if in_plane else []
    begun = resets[:, at] + offset
    samples = np.vstack([runs.states[:, at] + offset, begun])
    chart = _chart_within(instance, chosen, samples, groups, found)
    space = instance.env.observation_space
    low, high = _ends([instance.env.action_space])
    observation_low, observation_high = _ends(parts_of(space).values())
    start_low, start_high = _starts(description, chart, begun, found)
    found["sample time"] = f"{runs.dt:g} s, of a step"
    max_steps = description.steps or instance.steps or STEPS_WITHOUT_END
    if description.steps is None:
        found["steps"] = f"{max_steps} ({max_steps * runs.dt:g} s) of an episode"
    parts = parts_of(space) if isinstance(space, spaces.Dict) else {}
    spec = EnvironmentSpec(
        recipe=recipe,
        chart=chart,
        coordinates=chosen,
        state=state,
        qpos=columns["qpos"],
        qvel=columns["qvel"],
        parts={name: int(spaces.flatdim(part)) for name, part in parts.items()},
        observation_low=observation_low,
        observation_high=observation_high,
        moves=np.zeros(len(observation_low), dtype=bool),
        affine=None,
        wrapped=instance.is_wrapped,
        low=low,
        high=high,
        inputs=_input_names(instance, len(low)),
        levels=int(high[0]) + 1 if isinstance(instance.env.action_space, spaces.Discrete) else None,
        criterion=criterion,
        depth=runs.deepest,
        start_low=start_low,
        start_high=start_high,
        noisy=_shares(description, chosen, found),
        max_steps=max_steps,
        dt=runs.dt,
        worst_reward=min(runs.worst_reward, 0.0),
        islands=islands_of(instance, groups),
        tracked=runs.tracked,
        memoryless=not runs.memory and not instance.is_wrapped,
        found=found,
    )
    return _tried(instance, spec)


def _tried(instance: Instance, spec: EnvironmentSpec) -> tuple[EnvironmentSpec, Pool, Instance]:
    """Returns what `inspect` does, with what trials show, which may refuse the environment."""
    step = trials.MOVED * spec.chart.sides * np.array([share > 0 for share in spec.noisy])
    trials.check_observer(instance, step)
    derived, late = trials.derived_of(instance, step)
    found = dict(spec.found)
    if late:
        found["lag"] = f"observation {', '.join(map(str, late))} {LAG[derived]}"
    recipe = replace(spec.recipe, derived=derived)
    recipe = replace(recipe, anew=spec.wrapped and trials.changes_by_reset(recipe, spec.state))
    pool, spec = Pool(recipe), replace(spec, recipe=recipe, found=found)
    moves, affine = trials.moving(pool, spec)
    spec = replace(spec, moves=moves, affine=affine)
    trials.check_instances(pool, spec)
    spec = replace(spec, memoryless=spec.memoryless and trials.goes_on(pool, spec))
    instance = Instance(recipe)
    instance.reset()
    return spec, pool, instance


def _check_times(instance: Instance) -> None:
    """Raises `BadInput` if a reset or a step takes so long that runs would take hours."""
    for name, most, why in (
        ("reset", LONGEST_RESET, "each of thousands of episodes begins with it"),
        ("step", LONGEST_STEP, "thousands of episodes take many of them"),
    ):
        began = time.monotonic()
        if name == "reset":
            instance.reset()
        else:
            instance.stepped(instance.drawn(np.random.default_rng(0)))
        if (took := time.monotonic() - began) > most:
            raise BadInput(
                f"{name}() of {instance.name} takes {took:.1f} s, and {why}: give an environment whose "
                f"{name} takes less than {most:g} s"
            )


def _sampled(instance: Instance) -> Runs:
    """Returns what runs under inputs at random show; refuses random numbers in steps."""
    rng, states, rewards = np.random.default_rng(0), [], []
    info_keys: dict[str, None] = {}
    bodies, geoms, deepest, dt, memory, harmless = [], [], 0.0, 0.0, "", set()
    for seed in range(RUNS):
        instance.reset(seed)
        with suppress(Worn):  # these resets draw from other seeds
            instance.mark()
        before, began = fingerprint(instance.env), instance.data.time
        deepest = max(deepest, instance.depth())
        for _, reward, terminated, truncated, info in instance.wander(rng, STEPS, HELD):
            states.append(instance.physics.read())
            dt = dt or float(instance.data.time - began)
            deepest = max(deepest, instance.depth())
            rewards.append(float(reward))
            info_keys |= dict.fromkeys(key for key in info if isinstance(key, str))
            bodies.append(instance.data.xpos.copy())
            geoms.append(instance.data.geom_xpos.copy())
            if not (terminated or truncated):
                harmless |= instance.touched()
        instance.finish()
        changed = differing(fingerprint(instance.env), before)
        memory = memory or (changed[0] if changed else "")
    if not np.isfinite(rewards).all():
        raise BadInput(f"step() of {instance.name} gives rewards that are not finite: repair it")
    model = instance.model
    tracked = _farthest(model.body, bodies) or _farthest(model.geom, geoms)
    return Runs(
        np.array(states), tuple(info_keys), min(rewards), deepest, round(dt, 9), tracked, memory,
        frozenset(harmless),
    )  # fmt: skip


def _farthest(named: Any, places: Sequence[np.ndarray]) -> str:
    """Returns the name of what goes farthest, of places (k, n, 3) [m]; none if nothing does."""
    went = np.ptp(places, axis=0).sum(axis=1)
    return str(named(int(went.argmax())).name) if went.max() > STANDS else ""


def _at_rest(instance: Instance, robot: np.ndarray) -> np.ndarray:
    """Returns MuJoCo's state (S,) after the reset that all runs begin with, the robot at rest."""
    instance.reset()
    state, at = instance.physics.read(), instance.physics.columns["qvel"]
    pinned = [f"qvel[{i}]" in instance.recipe.description.pinned for i in range(len(at))]
    state[at[robot[instance.model.dof_bodyid] & ~np.array(pinned, dtype=bool)]] = 0.0
    return state


# ---- what was given or filled in


def _chart_of(instance: Instance, found: dict[str, str]) -> tuple[Coordinate, ...]:
    """Returns the coordinates of the chart that is given, or of the usual one."""
    description, space = instance.recipe.description, instance.env.observation_space
    if (chart := description.chart) is not None:
        chosen = coordinates(instance, chart)
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
    return chosen


def _criterion(instance: Instance, runs: Runs, found: dict[str, str]) -> Criterion:
    description, name = instance.recipe.description, instance.name
    success, failure = description.success, description.failure
    if success is None or success.strip() == "info":
        told = [key for key in SUCCESS if key in runs.info]
        if not told:
            raise BadInput(
                f"{name} does not tell in its info when it succeeds: say so with success, as {FORMS}"
            )
        if success is None:
            found["success"] = f'info["{told[0]}"]; or give {FORMS}'
        success = f'info["{told[0]}"]'
    criterion = Criterion(
        name,
        Expression.parse(success, "success"),
        None if failure is None else Expression.parse(failure, "failure"),
    )
    for path in criterion.keys:
        if path[0] not in runs.info:
            raise unknown(f"entry of info of {name}", str(path[0]), runs.info)
    if failure is None:
        found["failure"] = "an episode that the environment ends without success; or give failure"
    return criterion


def _chart_within(
    instance: Instance,
    chosen: Sequence[Coordinate],
    samples: np.ndarray,
    groups: Any,
    found: dict[str, str],
) -> Chart:
    """Returns the chart of some coordinates, with the bounds that are given or found."""
    names, given = tuple(c.name for c in chosen), instance.recipe.description.bounds
    for name in given:
        if name not in names:
            raise BadInput(f"bounds for {name} cannot be used: the chart has {', '.join(names)}")
    bounds = bounds_of(instance, chosen, samples, given, groups)
    found["bounds"] = ", ".join(
        f"{name} {b.low:.3g} to {b.high:.3g} (from {b.why})"
        for name, b in zip(names, bounds, strict=True)
    )
    low, high, periodic, _ = zip(*bounds, strict=True)
    return Chart(names, tuple(c.unit for c in chosen), low, high, periodic)


def _starts(
    description: Description, chart: Chart, begun: np.ndarray, found: dict[str, str]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns the corners of the box of starts; resets have led to chart points (n, d)."""
    first, last = begun.min(axis=0), begun.max(axis=0)
    ends = zip(chart.names, first, last, strict=True)
    found["starts"] = (
        f"all over the chart, the robot at rest and all else as after a reset; with {RESET!r} where resets "
        f"lead to: {', '.join(f'{name} {a:.3g} to {b:.3g}' for name, a, b in ends)}"
    )
    if description.starts != RESET:
        return chart.low, chart.high
    low, high = (np.clip(end, chart.low, chart.high).tolist() for end in (first, last))
    return tuple(low), tuple(high)


def _shares(
    description: Description, chosen: Sequence[Coordinate], found: dict[str, str]
) -> tuple[float, ...]:
    """Returns the share of the noise bound on each coordinate."""
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
    return tuple(float(share) for share in noisy)


def _ends(parts: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns the limits (k,) of boxes one after the other, or of the index of a discrete action."""
    ends = [
        (0, space.n - 1) if isinstance(space, spaces.Discrete) else (space.low, space.high)
        for space in parts
    ]
    low, high = (
        np.concatenate([np.ravel(end) for end in some], dtype=float)
        for some in zip(*ends, strict=True)
    )
    return low, high


def _input_names(instance: Instance, m: int) -> tuple[str, ...]:
    model = instance.model
    names = [model.actuator(i).name.rpartition("/")[2] for i in range(model.nu)]
    own = len(names) == m and all(names)
    return tuple(names) if own else tuple(f"action[{i}]" for i in range(m))
