"""The inspection of an environment: what it is found to have and to do, before anything rests on it."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces

from hyrl_mj import mjcf
from hyrl_mj.chart import Chart
from hyrl_mj.environments import trials
from hyrl_mj.environments.coordinates import AnyChart, Coordinate, all_names, coordinates
from hyrl_mj.environments.expressions import Expression
from hyrl_mj.environments.fingerprint import differing, fingerprint
from hyrl_mj.environments.instance import Instance, Recipe, Worn
from hyrl_mj.environments.observations import flat
from hyrl_mj.environments.opening import Source
from hyrl_mj.environments.pool import Pool
from hyrl_mj.environments.specification import FORMS, Criterion, EnvironmentSpec
from hyrl_mj.environments.surroundings import (
    bounds_of,
    changed_by_user,
    check_pins,
    drawn,
    groups_of,
    islands_of,
    robot_of,
    states_of_resets,
)
from hyrl_mj.errors import BadInput, unknown

# Samples of an episode of an environment that never ends by itself.
STEPS_WITHOUT_END = 1_000
# Where episodes start.
CHART, RESET = "chart", "reset"
# Each episode begins with a reset: one that takes longer [s] would take hours for a thousand.
LONGEST_RESET = 3.0
# And so would steps, of which an episode has hundreds [s].
LONGEST_STEP = 0.3
# Runs under inputs at random that show how far coordinates go, their steps, and for how long inputs are held.
RUNS, STEPS, HELD = 16, 150, 15
# What info calls success.
SUCCESS = ("success", "is_success")
# What goes no farther than this stands [m].
STANDS = 1e-6


@dataclass(frozen=True)
class Given:
    """What the user says of an environment: the arguments of `from_gymnasium` of these names."""

    chart: AnyChart | None = None
    noisy: Sequence[float] | None = None
    success: str | None = None
    failure: str | None = None
    bounds: Mapping[str, tuple[float, float]] | None = None
    steps: int | None = None
    starts: str = CHART


@dataclass
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


def inspect(source: Source, given: Given) -> tuple[EnvironmentSpec, Pool, Instance]:
    """Returns what is known of an environment, what plays its episodes, and an instance to look at.

    Raises:
        BadInput: it cannot be used, or one of its instances went another way than a new one.
    """
    found: dict[str, str] = {}
    instance = Instance(Recipe(source))
    began = time.monotonic()
    instance.reset()
    if (took := time.monotonic() - began) > LONGEST_RESET:
        raise BadInput(
            f"reset() of {source.name} takes {took:.1f} s, and each of thousands of episodes begins with it: "
            f"give an environment whose reset takes less than {LONGEST_RESET:g} s"
        )
    began = time.monotonic()
    instance.stepped(instance.drawn(np.random.default_rng(0)))
    if (took := time.monotonic() - began) > LONGEST_STEP:
        raise BadInput(
            f"step() of {source.name} takes {took:.1f} s, and thousands of episodes take many of them: give "
            f"an environment whose step takes less than {LONGEST_STEP:g} s"
        )
    instance.reset()
    instance.recipe = replace(instance.recipe, observer=trials.observer_of(instance))
    chosen = _chart_of(instance, given.chart, found)
    places = instance.physics.columns
    at = tuple(int(places[c.kind][c.index]) for c in chosen)
    robot = robot_of(instance.model, chosen)
    offset = tuple(c.offset for c in chosen)
    solid = robot[instance.model.geom_bodyid]
    instance.recipe = replace(instance.recipe, noisy=at, offset=offset, solid=solid)
    runs = _sampled(instance)
    criterion = _criterion(instance, given, runs, found)
    points = [
        (mjcf.point_of(instance.model, a), mjcf.point_of(instance.model, b))
        for a, b in criterion.places
    ]
    instance.recipe = replace(
        instance.recipe, keys=criterion.keys, places=tuple(points), harmless=runs.harmless
    )
    resets = states_of_resets(instance)
    _check_drawn(instance, chosen, drawn(instance, resets, robot), found)
    check_pins(instance)
    instance = Instance(
        instance.recipe
    )  # a new one: something may have outlasted the resets of the other
    state = _at_rest(instance, places, robot)
    groups = groups_of(instance, runs.states[:, list(at)][:, :2]) if _in_plane(chosen) else []
    box, starting = _bounds(
        instance, chosen, runs.states[:, list(at)] + offset, resets[:, list(at)] + offset, given, groups,
        found,
    )  # fmt: skip
    low, high, levels = _limits(instance)
    space = instance.env.observation_space
    parts = (
        {key: int(spaces.flatdim(part)) for key, part in space.spaces.items()}
        if isinstance(space, spaces.Dict)
        else {}
    )
    max_steps = given.steps or instance.steps or STEPS_WITHOUT_END
    found["sample time"] = f"{runs.dt:g} s, of a step"
    if given.steps is None:
        found["steps"] = f"{max_steps} ({max_steps * runs.dt:g} s) of an episode"
    spec = EnvironmentSpec(
        name=source.name,
        recipe=instance.recipe,
        chart=box,
        coordinates=chosen,
        state=state,
        qpos=places["qpos"],
        qvel=places["qvel"],
        columns=int(spaces.flatdim(space)),
        parts=parts,
        observation_low=_ends(space, "low"),
        observation_high=_ends(space, "high"),
        moves=np.zeros(int(spaces.flatdim(space)), dtype=bool),
        affine=None,
        wrapped=instance.env is not instance.inner,
        low=low,
        high=high,
        inputs=_input_names(instance, len(low)),
        levels=levels,
        criterion=criterion,
        depth=runs.deepest,
        start_low=starting[0],
        start_high=starting[1],
        noisy=_shares(chosen, given.noisy, found),
        max_steps=max_steps,
        dt=runs.dt,
        worst_reward=min(runs.worst_reward, 0.0),
        islands=islands_of(instance, groups),
        tracked=runs.tracked,
        memoryless=not runs.memory and instance.env is instance.inner,
        found=found,
    )
    tried = trials.tried(instance, spec)
    instance = Instance(tried[0].recipe)
    instance.reset()
    return *tried, instance


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


# ---- what was given or filled in


def _chart_of(
    instance: Instance, chart: AnyChart | None, found: dict[str, str]
) -> tuple[Coordinate, ...]:
    if chart is not None:
        chosen = coordinates(instance, chart)
    else:
        space = instance.env.observation_space
        if isinstance(space, spaces.Dict) and "achieved_goal" in space.spaces:
            proposed: AnyChart = "achieved_goal"
        else:
            proposed = [f"qpos[{i}]" for i in range(min(instance.model.nq, 2))]
        chosen = coordinates(instance, proposed)
        names = [c.described() for c in chosen]
        said = f"{proposed} ({', '.join(names)})" if isinstance(proposed, str) else ", ".join(names)
        others = [name for name in all_names(instance) if name not in (*names, proposed)]
        found["chart"] = f"{said}; others are {', '.join(others[:12])}"
    for c in chosen:
        if (pinned := f"{c.kind}[{c.index}]") in instance.source.pinned:
            raise BadInput(
                f"{pinned} is the coordinate {c.name} of the chart, where runs begin anywhere: leave it out "
                "of what is pinned, or name another chart"
            )
    return chosen


def _criterion(instance: Instance, given: Given, runs: Runs, found: dict[str, str]) -> Criterion:
    name, success, failure = instance.name, given.success, given.failure
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
        Expression.parse(success, "success"),
        None if failure is None else Expression.parse(failure, "failure"),
    )
    for path in criterion.keys:
        if path[0] not in runs.info:
            raise unknown(f"entry of info of {name}", str(path[0]), runs.info)
    if failure is None:
        found["failure"] = "an episode that the environment ends without success; or give failure"
    return criterion


def _check_drawn(
    instance: Instance, chosen: Sequence[Coordinate], names: list[str], found: dict[str, str]
) -> None:
    """Raises `BadInput` if resets draw what nothing pins."""
    source, name = instance.source, instance.name
    changed = changed_by_user(instance) if source.reset or source.pinned else []
    if source.reset and not changed:
        draws = f", which draws {', '.join(names)}" if names else ""
        raise BadInput(
            f"the options of reset {dict(source.reset)} change nothing in {name}{draws}: name the options as "
            "its reset does"
        )
    if not names:
        return
    left = [n for n in names if n not in changed and n.partition("[")[0] not in changed]
    if not source.pins or (source.seed is None and left):
        how = 'with options of reset as {"reset": {"goal_cell": [6, 6]}}'
        if positions := {n: 0.1 for n in left if n.startswith(("qpos[", "qvel[", "mocap_pos["))}:
            how = f"with values as {json.dumps({'pinned': dict(list(positions.items())[:4])})}"
        raise BadInput(
            f"each reset of {name} draws {', '.join(left[:8])}, and what is to be done depends on it: pin it"
            f', {how}, or as the reset with a seed draws it as {{"seed": 0}}'
        )
    given = f" and {dict(source.reset)}" if source.reset else ""
    pinned = f", with {dict(source.pinned)}" if source.pinned else ""
    found["goal"] = (
        f"{', '.join(names[:8])} as the reset with seed {source.first}{given} draws it{pinned}"
    )


def _at_rest(instance: Instance, places: Mapping[str, np.ndarray], robot: np.ndarray) -> np.ndarray:
    """Returns MuJoCo's state (S,) after the reset that all runs begin with, the robot at rest."""
    instance.reset()
    state = instance.physics.read()
    pinned = [name for name in instance.source.pinned if name.startswith("qvel[")]
    still = places["qvel"][robot[instance.model.dof_bodyid]]
    held = [places["qvel"][int(name[5:-1])] for name in pinned]
    state[np.setdiff1d(still, held)] = 0.0
    return state


def _bounds(
    instance: Instance,
    chosen: Sequence[Coordinate],
    runs: np.ndarray,
    begun: np.ndarray,
    given: Given,
    groups: Any,
    found: dict[str, str],
) -> tuple[Chart, tuple[tuple[float, ...], tuple[float, ...]]]:
    names = [c.name for c in chosen]
    for name in given.bounds or {}:
        if name not in names:
            raise BadInput(f"bounds for {name} cannot be used: the chart has {', '.join(names)}")
    bounds = bounds_of(instance, chosen, np.vstack([runs, begun]), given.bounds or {}, groups)
    found["bounds"] = ", ".join(
        f"{c.name} {b.low:.3g} to {b.high:.3g} (from {b.why})"
        for c, b in zip(chosen, bounds, strict=True)
    )
    low, high = tuple(b.low for b in bounds), tuple(b.high for b in bounds)
    units = tuple(c.unit for c in chosen)
    chart = Chart(tuple(names), units, low, high, tuple(b.periodic for b in bounds))
    first, last = begun.min(axis=0), begun.max(axis=0)
    lead = ", ".join(f"{n} {a:.3g} to {b:.3g}" for n, a, b in zip(names, first, last, strict=True))
    found["starts"] = (
        f"all over the chart, the robot at rest and all else as after a reset; with {RESET!r} where resets "
        f"lead to: {lead}"
    )
    if given.starts == RESET:
        return chart, (
            tuple(np.clip(first, low, high).tolist()), tuple(np.clip(last, low, high).tolist())
        )  # fmt: skip
    return chart, (low, high)


def _shares(
    chosen: Sequence[Coordinate], noisy: Sequence[float] | None, found: dict[str, str]
) -> tuple[float, ...]:
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


def _limits(instance: Instance) -> tuple[np.ndarray, np.ndarray, int | None]:
    """Returns lower and upper limits (m,) of the inputs, and the number of values of a discrete action."""
    space: Any = instance.env.action_space
    if isinstance(space, spaces.Discrete):
        return np.zeros(1), np.array([float(space.n - 1)]), int(space.n)
    return np.ravel(space.low).astype(float), np.ravel(space.high).astype(float), None


def _input_names(instance: Instance, m: int) -> tuple[str, ...]:
    model = instance.model
    names = [model.actuator(i).name.rpartition("/")[2] for i in range(model.nu)]
    own = len(names) == m and all(names)
    return tuple(names) if own else tuple(f"action[{i}]" for i in range(m))


def _ends(space: Any, end: str) -> np.ndarray:
    """Returns the lower or upper limits (o,) of an observation."""
    parts = space.spaces if isinstance(space, spaces.Dict) else None
    values = (
        getattr(space, end) if parts is None else {k: getattr(p, end) for k, p in parts.items()}
    )
    return flat(values, space)


def _in_plane(chosen: Sequence[Coordinate]) -> bool:
    """Returns whether the first two coordinates are a place."""
    return len(chosen) >= 2 and all(c.unit == "m" for c in chosen[:2])
