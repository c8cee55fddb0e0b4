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
# What differs by less than this share of what a physics step changes is from near the end of a step.
NEAR = 0.5
# By how much coordinates are moved to see what follows them, as a share of the side of the chart.
MOVED = 1e-3


def observer_of(instance: Instance) -> str:
    """Returns the name of what computes what an environment observes, "" if nothing is found to."""
    rng, space = np.random.default_rng(0), instance.inner.observation_space
    left = observers(instance.env)

    def agreeing() -> dict[str, Any]:
        seen = flat(instance.inner_seen, space)
        return {name: get for name, get in left.items() if _agrees(get, seen, space)}

    for seed in range(EPISODES):
        instance.reset(seed)
        if not instance.source.pinned:  # else it was pinned after that observation
            left = agreeing()
        for _ in instance.wander(rng, SAMPLES, HELD):
            left = agreeing()
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
    step = MOVED * spec.chart.sides * np.array([s > 0 for s in spec.noisy])
    _check_observer(instance, step)
    found, (derived, columns) = dict(spec.found), _derived(instance, step)
    if columns:
        when = {
            EARLIER: "is that of a physics step before the end of a step, with noise, too",
            UNKNOWN: "is from shortly before the end of a step; noise adds what it changes at the end",
        }
        found["lag"] = f"observation {', '.join(map(str, columns))} {when[derived]}"
    recipe = replace(spec.recipe, derived=derived)
    recipe = replace(recipe, anew=spec.wrapped and _changes_by_reset(recipe, spec.state))
    instance.recipe, pool = recipe, Pool(recipe)
    spec = replace(spec, recipe=recipe, found=found)
    moves, affine = _moving(pool, spec)
    spec = replace(spec, moves=moves, affine=affine)
    _check_instances(pool, spec)
    return replace(spec, memoryless=spec.memoryless and _forgets(pool, spec)), pool


def _rounds(off: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns which differences (o,) are no more than rounding of values (o,)."""
    return np.asarray(off <= ROUNDING * max(float(np.abs(values).max(initial=0.0)), 1.0))


def _check_observer(instance: Instance, step: np.ndarray) -> None:
    """Raises `BadInput` unless what is observed follows the state, as after a reset to that state.

    After some steps the state of the reset is written again. What is observed then has to be what the reset
    observed, but for columns that have nothing to do with the place: those that no noise moves, that all
    resets observe alike, and that do not depend on where the run began.
    """
    rng, name, space = np.random.default_rng(1), instance.name, instance.inner.observation_space
    first, suspects = [], {}
    for seed in range(EPISODES):
        instance.reset(seed)
        state = instance.physics.read()
        instance.physics.write(state)
        seen = instance.watched() if instance.source.pinned else instance.inner_seen
        first.append(begun := flat(seen, space))
        for _ in instance.wander(rng, SAMPLES, HELD):
            pass
        before = fingerprint(instance.env)
        moved = instance.displaced(step)
        if changed := differing(fingerprint(instance.env), before):
            raise BadInput(
                f"{name} changes {changed[0]} when it computes what it observes, so that cannot be asked for "
                "where noise shows the robot: let it only read"
            )
        instance.physics.write(state)
        off = np.abs(flat(instance.watched(), space) - begun)
        for column in map(int, np.flatnonzero(~_rounds(off, begun))):
            suspects[column] = (
                f"is {begun[column]:.6g} after reset() and differs by {off[column]:.6g} in that state later"
            )
            if moved[column]:
                _refuse(name, column, suspects[column])
    for column, why in suspects.items():
        if np.ptp([row[column] for row in first]) > 0 or _depends(instance, column, step):
            _refuse(name, column, why)


def _refuse(name: str, column: int, why: str) -> None:
    raise BadInput(
        f"what {name} observes does not follow its state: observation[{column}] {why}. It is stored by "
        "step(), or computed from what is, so that noise would not reach it: compute it from the state"
    )


def _depends(instance: Instance, column: int, step: np.ndarray) -> bool:
    """Returns whether a column of the observation depends on where a run under the same inputs began."""
    space, ends = instance.inner.observation_space, []
    for offset in (0.0, 1.0):
        instance.reset()
        instance.physics.write(instance.moved(instance.physics.read(), offset * step))
        runs = instance.wander(np.random.default_rng(2), HELD, 1)
        ends.append([flat(instance.inner_seen, space)[column] for _ in runs])
    return not np.array_equal(ends[0], ends[1], equal_nan=True)


def _derived(instance: Instance, step: np.ndarray) -> tuple[str, list[int]]:
    """Returns `Recipe.derived`, with the columns of what is observed that are not as at the end of a step.

    Raises:
        BadInput: noise on the chart's coordinates moves columns of which it is not known when they are from.
    """
    rng, space = np.random.default_rng(5), instance.inner.observation_space
    off: dict[str, list[np.ndarray]] = {NOW: [], EARLIER: []}
    step_of_physics, moving, size = [], [], []
    for seed in range(EPISODES):
        instance.reset(seed)
        for _ in instance.wander(rng, SAMPLES, HELD):
            seen, state = flat(instance.inner_seen, space), instance.physics.read()
            size.append(np.abs(seen))
            for derived, differences in off.items():
                with instance.physics.kept():
                    differences.append(instance.seen_as(derived, state, 0 * step) - seen)
            step_of_physics.append(np.abs(off[NOW][-1] - off[EARLIER][-1]))
            moving.append(np.abs(instance.displaced(step)))
    most = {derived: np.abs(differences).max(axis=0) for derived, differences in off.items()}
    differ = {derived: ~_rounds(far, np.array(size)) for derived, far in most.items()}
    lags = np.flatnonzero(differ[NOW]).tolist()
    for derived, columns in differ.items():
        if not columns.any():
            return derived, lags
    # With the Runge-Kutta method they are from its last stage, which is near the end.
    far = most[NOW] > NEAR * np.max(step_of_physics, axis=0)
    unknown = differ[NOW] & differ[EARLIER] & far & ~_rounds(np.max(moving, axis=0), np.array(size))
    if unknown.any():
        raise BadInput(
            f"observation[{unknown.argmax()}] of {instance.name} comes neither from the end of a step nor "
            "from a physics step before, so it is not known what it is under noise: leave it out, such as "
            "forces of contacts by include_cfrc_ext_in_observation=False, or call mj_forward at the end of "
            "step()"
        )
    return UNKNOWN, lags


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


def _moving(pool: Pool, spec: EnvironmentSpec) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns which columns of an observation at rest follow the chart (o,) bool, and `affine` of a spec."""
    shape = EPISODES * (spec.dimension + 1), spec.dimension
    z = np.random.default_rng(0).uniform(spec.start_low, spec.start_high, shape)
    seen, _ = pool.rest(spec.state_at(z))
    one = np.column_stack([z, np.ones(len(z))])
    fit = np.linalg.lstsq(one, seen, rcond=None)[0]
    exact = _rounds(np.abs(one @ fit - seen), seen).all()
    return np.ptp(seen, axis=0) > 0, fit if exact else None


# ---- runs of several instances


def _begun(
    pool: Pool, spec: EnvironmentSpec, rng: np.random.Generator
) -> tuple[EnvironmentPlant, np.ndarray]:
    """Returns runs at starts at random, and these, MuJoCo's states (n, S); as free of walls as some are."""
    shape = 3 * EPISODES, spec.dimension
    states = spec.state_at(rng.uniform(spec.start_low, spec.start_high, shape))
    _, depths = pool.rest(states)
    states = states[np.argsort(depths > spec.depth, kind="stable")[:EPISODES]]
    plant = EnvironmentPlant(spec, pool, None, EPISODES)
    plant.set_state(states[:, spec.qpos], states[:, spec.qvel])
    return plant, states


def _inputs(spec: EnvironmentSpec, rng: np.random.Generator) -> np.ndarray:
    """Returns inputs (n, m) at random."""
    u = rng.uniform(spec.low, spec.high, (EPISODES, len(spec.low)))
    return u if spec.levels is None else np.round(u)


def _check_instances(pool: Pool, spec: EnvironmentSpec) -> None:
    """Raises `BadInput` unless instances go as new ones after other episodes, with noise and without."""
    rng, d = np.random.default_rng(3), spec.dimension
    columns = slice(d, d + spec.columns)
    for noise in (0.0, 0.0, MOVED):
        plant, states = _begun(pool, spec, rng)
        inputs, measured = [], [plant.measurement]
        for k in range(min(SAMPLES, spec.max_steps)):
            if k % HELD == 0:
                u = _inputs(spec, rng)
            errors = np.zeros_like(measured[0])
            errors[:, :d] = (
                noise * rng.uniform(-1, 1, (EPISODES, d)) * spec.chart.sides * spec.noisy
            )
            if noise:
                everyone = np.arange(EPISODES)
                plant.observe(plant.truth(everyone), errors, everyone)
            plant.step(u)
            inputs.append(u)
            measured.append(plant.measurement)
            if (measured[-1][:, -1] != 0).all():
                break
        over = np.array(measured)[:, :, -1] != 0
        ends = np.where(over.any(axis=0), over.argmax(axis=0), len(inputs))
        pool.check(
            [
                Played(
                    states[i],
                    np.array(inputs)[:end, i],
                    np.array(measured)[: end + 1, i, :d],
                    None if noise else np.array(measured)[: end + 1, i, columns],
                    np.array(measured)[1 : end + 1, i, columns.stop],
                )
                for i, end in enumerate(ends)
            ]
        )


def _forgets(pool: Pool, spec: EnvironmentSpec) -> bool:
    """Returns whether runs go on from a written state as they did, so that MuJoCo's state is all there is."""
    rng, columns = np.random.default_rng(4), slice(spec.dimension, spec.dimension + spec.columns)
    plant, _ = _begun(pool, spec, rng)
    for _ in range(SAMPLES):
        before, going = plant.state, np.flatnonzero(plant.measurement[:, -1] == 0)
        if not len(going):
            break
        u = _inputs(spec, rng)[going]
        plant.step(u, going)
        try:
            after, seen, _ = pool.branch(before[going], u)
        except BadInput:
            return False
        same = np.array_equal(seen, plant.measurement[going, columns])
        if not (same and np.array_equal(after, plant.state[going])):
            return False
    return True
