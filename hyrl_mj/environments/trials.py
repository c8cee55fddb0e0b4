"""Trials of an environment: whether what it observes follows its state, and its instances go as new ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hyrl_mj.environments.fingerprint import differing, fingerprint
from hyrl_mj.environments.instance import EARLIER, NOW, UNKNOWN, Instance, Recipe
from hyrl_mj.environments.judge import Played
from hyrl_mj.environments.observations import flat, observers
from hyrl_mj.environments.plant import EnvironmentPlant
from hyrl_mj.environments.pool import Pool
from hyrl_mj.environments.specification import EnvironmentSpec
from hyrl_mj.errors import BadInput

# Episodes and samples of a trial, and for how many samples inputs are held.
EPISODES, SAMPLES, HELD = 8, 40, 8
# Rounding of what is computed again from the same state, as a share of the largest number.
ROUNDING = 1e-9
# By how much coordinates are moved to see what follows them, as a share of the side of the chart.
MOVED = 1e-3


def observer_of(instance: Instance) -> str:
    """Returns the name of what computes what an environment observes, "" if nothing is found to."""
    rng, inner = np.random.default_rng(0), instance.inner
    left = observers(instance.env)
    for seed in range(EPISODES):
        instance.reset(seed)
        for k in range(SAMPLES):
            space = inner.observation_space
            seen = flat(instance.inner_seen, space)
            if not (instance.source.pinned and k == 0):  # what was pinned after that observation
                left = {name: get for name, get in left.items() if _agrees(get, seen, space)}
            if k % HELD == 0:
                u = instance.drawn(rng)
            _, _, terminated, truncated, _ = instance.stepped(u)
            if terminated or truncated:
                break
    return next(iter(left), "")


def _agrees(get: Any, seen: np.ndarray, space: Any) -> bool:
    try:
        return np.array_equal(flat(get(), space), seen, equal_nan=True)
    except Exception:  # it takes arguments, or is something else
        return False


def tried(instance: Instance, spec: EnvironmentSpec) -> tuple[EnvironmentSpec, Pool]:
    """Returns what is known of an environment after the trials, and what plays its episodes.


    Raises:
        BadInput: the environment does not observe what it is told, or goes otherwise than a new one.
    """
    _check_observer(instance, spec)
    found, (derived, columns) = dict(spec.found), _derived(instance)
    if columns:
        what = f"observation {', '.join(map(str, columns))}"
        if derived == EARLIER:
            found["lag"] = (
                f"{what} comes from a physics step before the end of a step, with noise, too"
            )
        else:
            found["lag"] = (
                f"{what} comes from a physics step before the end of a step; noise adds to it what it "
                "changes at the end"
            )
    recipe = replace(spec.recipe, derived=derived)
    recipe = replace(recipe, anew=spec.wrapped and _changes_by_reset(recipe, spec.state))
    spec = replace(spec, recipe=recipe, found=found)
    instance.recipe = spec.recipe
    pool = Pool(spec.recipe)
    moves, affine = _moving(pool, spec)
    spec = replace(spec, moves=moves, affine=affine)
    _check_instances(pool, spec)
    if spec.memoryless:
        spec = replace(spec, memoryless=_forgets(pool, spec))
    return spec, pool


def _check_observer(instance: Instance, spec: EnvironmentSpec) -> None:
    """Raises `BadInput` unless what is observed follows the state, as after a reset to that state.

    After some steps the state of the reset is written again. What is observed then has to be what the reset
    observed, but for columns that have nothing to do with the place: those that no noise moves, that all
    resets observe alike, and that do not depend on where the run began.
    """
    rng, name, space = np.random.default_rng(1), instance.name, instance.inner.observation_space
    first: list[np.ndarray] = []
    suspects: dict[int, str] = {}
    step = MOVED * spec.chart.sides * np.array([s > 0 for s in spec.noisy])
    for seed in range(EPISODES):
        instance.reset(seed)
        state = instance.physics.read()
        instance.physics.write(state)
        begun = flat(instance.watched(), space)
        if not instance.source.pinned:
            begun = flat(instance.inner_seen, space)
        first.append(begun)
        for k in range(SAMPLES):
            if k % HELD == 0:
                u = instance.drawn(rng)
            _, _, terminated, truncated, _ = instance.stepped(u)
            if terminated or truncated:
                break
        before = fingerprint(instance.env)
        moved = instance.displaced(step)
        if changed := differing(fingerprint(instance.env), before):
            raise BadInput(
                f"{name} changes {changed[0]} when it computes what it observes, so that cannot be asked for "
                "where noise shows the robot: let it only read"
            )
        instance.physics.write(state)
        off = np.abs(flat(instance.watched(), space) - begun)
        scale = max(float(np.abs(begun).max(initial=0.0)), 1.0)
        for column in map(int, np.flatnonzero(~(off <= ROUNDING * scale))):
            suspects[column] = (
                f"is {begun[column]:.6g} after reset() and differs by {off[column]:.6g} in that state later"
            )
            if moved[column]:
                _refuse(name, column, suspects[column])
    for column, why in suspects.items():
        if np.ptp([row[column] for row in first]) > 0 or _depends(instance, spec, column, step):
            _refuse(name, column, why)


def _changes_by_reset(recipe: Recipe, start: np.ndarray) -> bool:
    """Returns whether a start (S,) is another one after a reset before, as with running statistics."""
    found = []
    for resets in (0, 0, 1):
        instance = Instance(recipe)
        for _ in range(resets):
            instance.reset()
        observation = instance.put(start)
        found.append((observation, instance.remembered()))
    usual = set(differing(found[0][1], found[1][1]))  # such as names of files
    changed = set(differing(found[0][1], found[2][1])) - usual
    return bool(changed) or not np.array_equal(found[0][0], found[2][0], equal_nan=True)


def _derived(instance: Instance) -> tuple[str, list[int]]:
    """Returns `Recipe.derived`, with the columns of what is observed that are not as at the end of a step."""
    rng, space = np.random.default_rng(5), instance.inner.observation_space
    odd: dict[str, np.ndarray | bool] = {NOW: False, EARLIER: False}
    for seed in range(EPISODES):
        instance.reset(seed)
        for k in range(SAMPLES):
            if k % HELD == 0:
                u = instance.drawn(rng)
            _, _, terminated, truncated, _ = instance.stepped(u)
            seen, state = flat(instance.inner_seen, space), instance.physics.read()
            for derived in odd:
                with instance.physics.kept():
                    again = instance.seen_as(derived, state, np.zeros(len(instance.recipe.noisy)))
                off = np.abs(again - seen)
                odd[derived] |= ~(off <= ROUNDING * max(float(np.abs(seen).max(initial=0.0)), 1.0))
            if terminated or truncated:
                break
    fits = [derived for derived, columns in odd.items() if not np.any(columns)]
    return fits[0] if fits else UNKNOWN, np.flatnonzero(odd[NOW]).tolist()


def _refuse(name: str, column: int, why: str) -> None:
    raise BadInput(
        f"what {name} observes does not follow its state: observation[{column}] {why}. It is stored by "
        "step(), or computed from what is, so that noise would not reach it: compute it from the state"
    )


def _depends(instance: Instance, spec: EnvironmentSpec, column: int, step: np.ndarray) -> bool:
    """Returns whether a column of the observation depends on where a run under the same inputs began."""
    space, ends = instance.inner.observation_space, []
    for offset in (0.0, 1.0):
        rng = np.random.default_rng(2)
        instance.reset()
        instance.physics.write(instance.moved(instance.physics.read(), offset * step))
        seen = []
        for _ in range(HELD):
            _, _, terminated, truncated, _ = instance.stepped(instance.drawn(rng))
            seen.append(flat(instance.inner_seen, space)[column])
            if terminated or truncated:
                break
        ends.append(seen)
    return not np.array_equal(ends[0], ends[1], equal_nan=True)


def _moving(pool: Pool, spec: EnvironmentSpec) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns which columns of an observation at rest follow the chart (o,) bool, and `affine` of a spec."""
    rng = np.random.default_rng(0)
    z = rng.uniform(
        spec.start_low, spec.start_high, (EPISODES * (spec.dimension + 1), spec.dimension)
    )
    seen, _ = pool.rest(spec.state_at(z))
    one = np.column_stack([z, np.ones(len(z))])
    fit = np.linalg.lstsq(one, seen, rcond=None)[0]
    exact = np.abs(one @ fit - seen).max() <= ROUNDING * max(np.abs(seen).max(), 1.0)
    return np.ptp(seen, axis=0) > 0, fit if exact else None


def _free(pool: Pool, spec: EnvironmentSpec, n: int, rng: np.random.Generator) -> np.ndarray:
    """Returns n starts, MuJoCo's states (n, S); free of walls, as far as some draws find such ones."""
    states = spec.state_at(rng.uniform(spec.start_low, spec.start_high, (3 * n, spec.dimension)))
    _, depths = pool.rest(states)
    return states[np.argsort(depths > spec.depth, kind="stable")[:n]]


def _check_instances(pool: Pool, spec: EnvironmentSpec) -> None:
    """Raises `BadInput` unless instances go as new ones after other episodes, with noise and without."""
    rng, n, d = np.random.default_rng(3), EPISODES, spec.dimension
    for noise in (0.0, 0.0, MOVED):
        plant = EnvironmentPlant(spec, pool, None, n)
        states = _free(pool, spec, n, rng)
        plant.set_state(states[:, spec.qpos], states[:, spec.qvel])
        inputs, kept = [], [plant.measurement]
        for k in range(min(SAMPLES, spec.max_steps)):
            if k % HELD == 0:
                u = rng.uniform(spec.low, spec.high, (n, len(spec.low)))
                u = np.round(u) if spec.levels is not None else u
            errors = np.zeros((n, kept[0].shape[1]))
            errors[:, :d] = noise * rng.uniform(-1, 1, (n, d)) * spec.chart.sides * spec.noisy
            if noise:
                plant.observe(plant.truth, errors, np.arange(n))
            plant.step(u)
            inputs.append(u)
            kept.append(plant.measurement)
            if (plant.measurement[:, -1] != 0).all():
                break
        path, runs = np.array(kept), []
        for i in range(n):
            end = (
                int(np.argmax(path[:, i, -1] != 0)) if (path[:, i, -1] != 0).any() else len(inputs)
            )
            rows = slice(0, end + 1)
            o = spec.columns
            runs.append(
                Played(
                    states[i],
                    np.array([u[i] for u in inputs[:end]]).reshape(end, len(spec.low)),
                    path[rows, i, :d],
                    spec.offset,
                    None if noise else path[rows, i, d : d + o],
                    path[rows, i, d + o][1:],
                )
            )
        pool.check(runs)


def _forgets(pool: Pool, spec: EnvironmentSpec) -> bool:
    """Returns whether runs go on from a written state as they did, so that MuJoCo's state is all there is."""
    rng, n = np.random.default_rng(4), EPISODES
    plant = EnvironmentPlant(spec, pool, None, n)
    states = _free(pool, spec, n, rng)
    plant.set_state(states[:, spec.qpos], states[:, spec.qvel])
    for _ in range(SAMPLES):
        before, going = plant.state, np.flatnonzero(plant.measurement[:, -1] == 0)
        if not len(going):
            break
        u = rng.uniform(spec.low, spec.high, (n, len(spec.low)))
        u = np.round(u) if spec.levels is not None else u
        plant.step(u[going], going)
        try:
            after, _, seen = pool.branch(before[going], u[going])
        except BadInput:
            return False
        o, d = spec.columns, spec.dimension
        alike = np.array_equal(after, plant.state[going]) and np.array_equal(
            seen, plant.measurement[going][:, d : d + o]
        )
        if not alike:
            return False
    return True
