"""Trials of an environment: whether what it observes follows its state, as far as it uses that itself, and
whether its instances go as new ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.instance import Instance, Seen, renewed, to_end
from hyrl_mj.gym_import.observations import flat, observers, shaped, unlike
from hyrl_mj.gym_import.plant import EnvironmentPlant, check_finite
from hyrl_mj.gym_import.pool import Pool
from hyrl_mj.gym_import.resets import SAME
from hyrl_mj.gym_import.specification import MOVED, Derived, EnvironmentSpec
from hyrl_mj.gym_import.stage import Played
from hyrl_mj.system.generators import kept_generators
from hyrl_mj.tasks import Outcome

# Episodes and samples of a trial, and for how many samples inputs are held.
EPISODES, SAMPLES, HELD = 8, 40, 8
# Places on the chart from which runs of so many samples come to one state, which may show where they were;
# from the first places whole episodes, in which slow sensors measure.
PLACES, AWAY, FAR = 64, 2, 5


def observers_of(instance: Instance) -> tuple[str, ...]:
    """Returns the names of what computes what an environment observes; raises `BadInput` if nothing does."""
    rng, space = np.random.default_rng(0), instance.inner.observation_space
    left = observers(instance.env)
    for seed in range(EPISODES):
        instance.reset(seed)
        runs: Iterable[Any] = instance.wander(rng, SAMPLES, HELD)
        if not instance.spec.description.pinned:  # else it was pinned after that observation
            runs = chain([None], runs)
        for _ in runs:
            seen = flat(instance.inner_seen, space)
            with kept_generators():  # one that is no observer may draw
                left = {name: get for name, get in left.items() if _agrees(get, seen, space)}
    if not left:
        raise BadInput(
            f"{instance.name} has no method that computes what it observes in its present state, so nothing "
            "is known of what it would observe under noise: give it one named _get_obs, without arguments, "
            "whose answer step() and reset() return as it is; let reset() call mj_forward before it "
            "observes, and let no wrapper move the robot after that"
        )
    return tuple(left)


def _agrees(get: Any, seen: np.ndarray, space: Any) -> bool:
    try:
        return np.array_equal(flat(get(), space), seen, equal_nan=True)
    except Exception:  # it takes arguments, or is something else
        return False


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the differences (o,) of two observations; equal values that are not finite do not differ."""
    with np.errstate(invalid="ignore"):
        return np.where(unlike(a, b), np.abs(a - b), 0.0)


def _rounds(off: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns which differences (o,) are no more than rounding of values (o,)."""
    sizes = np.abs(values[np.isfinite(values)])
    return np.asarray(off <= 1e-9 * max(float(sizes.max(initial=0.0)), 1.0))


def check_observer(spec: EnvironmentSpec) -> np.ndarray:
    """Returns `recalled` of a spec; raises `BadInput` if other columns depend on the way to a state.

    Runs under the same inputs are put into one state. What they observe there has to be the same to the bit:
    what is stored on the way differs, if only by rounding.
    """
    name, usual = spec.name, dict[int, np.ndarray]()
    instance, fresh = Instance(spec), Instance(spec)
    fresh.reset()
    none, recalled = np.zeros(spec.dimension), np.zeros(1, dtype=bool)
    states = spec.state_at(spec.anywhere(np.random.default_rng(7), PLACES))
    # Most runs are short, and some go to their ends.
    runs = [(state, AWAY) for state in states]
    runs += [(state, spec.max_steps) for state in states[:FAR]]
    for state, away in runs:
        instance = renewed(instance)
        instance.physics.write(state)
        if instance.physics.depth(spec.solid) > spec.depth:
            continue
        for k, result in enumerate(instance.wander(np.random.default_rng(8), away, HELD), 1):
            if any(result[2:4]) or (k != AWAY and k % HELD):
                continue
            seen = instance.seen_as("now", spec.state, none)
            recalled = recalled | instance.recalls(fresh, spec.state, none)
            off = _apart(seen, usual.setdefault(k, seen))
            if off.any():
                column = int((off != 0).argmax())
                raise BadInput(
                    f"what {name} observes does not follow its state: observation[{column}] differs by "
                    f"{off[column]:.6g} in one state, after runs in different places. It is stored by "
                    "step(), or computed from what is, so that noise would not reach it: compute it from the "
                    "state"
                )
    return recalled


def derived_of(instance: Instance) -> tuple[Derived, list[int]]:
    """Returns `derived` of a spec, and the columns of what is observed that are not from the end of a step.

    Raises:
        BadInput: noise on the chart's coordinates moves columns of which it is not known when they are from,
            or those that a reset returns are not of its state.
    """
    rng, space = np.random.default_rng(5), instance.inner.observation_space
    step = instance.spec.nudge
    off: dict[Derived, list[np.ndarray]] = {"now": [], "earlier": []}
    moving, size, first = [], [], [0 * flat(instance.inner_seen, space)]
    for seed in range(EPISODES):
        instance.reset(seed)
        if not instance.spec.description.pinned:  # else it was pinned after that observation
            now = instance.seen_as("now", instance.physics.read(), 0 * step)
            first.append(_apart(now, flat(instance.inner_seen, space)))
        for _ in instance.wander(rng, SAMPLES, HELD):
            seen, state = flat(instance.inner_seen, space), instance.physics.read()
            size.append(np.abs(seen))
            for derived, differences in off.items():
                differences.append(_apart(instance.seen_as(derived, state, 0 * step), seen))
            moving.append(np.abs(flat(instance.displaced(step), space) - seen))
    if not np.any(moving):
        spec = instance.spec
        noisy = [c.name for c, share in zip(spec.coordinates, spec.noisy, strict=True) if share]
        raise BadInput(
            f"noise on {', '.join(noisy)} changes nothing that {instance.name} "
            "observes, so there is nothing to find out: name a chart of what it observes"
        )
    # More than solvers leave open.
    stale = (np.max(first, axis=0) > 1e-3) & (np.max(moving, axis=0) > 0)
    if stale.any():
        raise BadInput(
            f"reset() of {instance.name} returns observation[{stale.argmax()}] of another place than it leads"
            " to, which at other starts is not known: let it call mj_forward before it observes"
        )
    most = {derived: np.abs(differences).max(axis=0) for derived, differences in off.items()}
    differ = {derived: ~_rounds(far, np.array(size)) for derived, far in most.items()}
    lags = np.flatnonzero(differ["now"]).tolist()
    for derived, columns in differ.items():
        if not columns.any():
            return derived, lags
    # With the Runge-Kutta method they are from its last stage, which is near the end.
    step_of_physics = np.abs(np.subtract(off["now"], off["earlier"])).max(axis=0)
    far = most["now"] > 0.5 * step_of_physics
    unknown = (
        differ["now"] & differ["earlier"] & far & ~_rounds(np.max(moving, axis=0), np.array(size))
    )
    if unknown.any():
        raise BadInput(
            f"observation[{unknown.argmax()}] of {instance.name} comes neither from the end of a step nor "
            "from a physics step before, so it is not known what it is under noise: leave it out, such as "
            "forces of contacts by include_cfrc_ext_in_observation=False, or call mj_forward at the end of "
            "step()"
        )
    return "unknown", lags


def moving(pool: Pool) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns which columns of an observation at rest follow the chart (o,) bool, and `at_rest` of a spec."""
    spec, rng = pool.spec, np.random.default_rng(0)
    # For each term; with wrappers each of them takes two resets.
    places = EPISODES if spec.wrapped else PLACES
    z = spec.anywhere(rng, places * spec.terms(spec.anywhere(rng, 1)).shape[1])
    seen, depths = pool.scatter("rest", spec.state_at(z))
    check_finite(spec.name, seen[depths <= spec.depth])
    fit = np.linalg.lstsq(terms := spec.terms(z), seen, rcond=None)[0]
    exact = _rounds(np.abs(terms @ fit - seen), seen).all()
    return np.ptp(seen, axis=0) > 0, fit if exact else None


def check_use(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if step() changes what is observed under noise, or moves the robot by it.

    The same runs are played by an environment whose observer sees the true place, and by one whose observer
    sees others, all over the chart. What the latter gives has to be returned, and both runs have to go the
    same way. Wrappers give the actions of the former.
    """
    true, noisy = Instance(spec), Instance(spec)
    inner, offset, given = noisy.inner, np.zeros(spec.dimension), list[np.ndarray]()
    own = getattr(inner, "__dict__", dict.fromkeys(spec.observers))
    names = [name for name in spec.observers if hasattr(type(inner), name) and name not in own]
    # It may be made of several methods, or put in already, or the environment allows no attributes.
    if not names:
        return

    def observe() -> Any:
        given.append(noisy.seen_as("now", noisy.physics.read(), offset))
        return shaped(given[-1], noisy.inner_seen, inner.observation_space)

    rng, half = np.random.default_rng(10), spec.chart.sides * (np.array(spec.noisy) > 0) / 2
    for state in spec.state_at(spec.anywhere(rng, EPISODES)):
        for name in names:
            vars(inner).pop(name, None)
        for one in (true, noisy):  # both, so that they are reset as often
            one.reset()
            one.arrive(state)
        vars(inner).update(dict.fromkeys(names, observe))
        if true.physics.depth(spec.solid) > spec.depth:
            continue
        for k in range(min(SAMPLES, spec.max_steps)):
            if k % HELD == 0:
                u = true.drawn(rng)
            true.passed.clear()
            ended = any(true.stepped(u)[2:4])
            if spec.wrapped and len(true.passed) != 1:  # wrappers step several times, or not at all
                return
            noisy.script, offset[:] = iter(true.passed[:]), rng.uniform(-half, half)
            given.clear()
            try:
                ended |= any(noisy.stepped(u)[2:4])
            except BadInput:  # step() may not be able to work with such observations
                break
            before, after = true.physics.read(), noisy.physics.read()
            if not np.array_equal(before, after, equal_nan=True):
                raise BadInput(
                    f"step() of {spec.name} moves the robot by what {names[0]}() gives, where noise "
                    "does not come: let it read MuJoCo's state, or put the controller into a wrapper, which "
                    "sees the noise"
                )
            seen = flat(noisy.inner_seen, inner.observation_space)
            if given and not any(np.array_equal(one, seen, equal_nan=True) for one in given):
                raise BadInput(
                    f"step() of {spec.name} changes what {names[0]}() gives where noise may show the "
                    "robot, as where it clips: let that method compute all that is observed"
                )
            if ended:
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
        other = here.copy()
        other[copies] = there[copies]
        seen, shown = (one.seen_as("now", state, none[0]) for state in (here, other))
        if not np.array_equal(seen, shown, equal_nan=True):
            names = ", ".join(one.physics.names[at] for at in copies[:4])
            raise BadInput(
                f"what {spec.name} observes shows {names}, to which code copies the place of the robot, "
                "where noise does not reach it: let it observe the place itself"
            )


# ---- runs of several instances


def _runs(
    pool: Pool, seed: int, n: int = EPISODES
) -> Iterator[tuple[EnvironmentPlant, np.ndarray]]:
    """Yields n runs from starts at random, before each sample, with inputs (n, m) at random for it.

    Some starts are drawn more, and of these the ones that are free of walls come first.
    """
    rng, spec = np.random.default_rng(seed), pool.spec
    states = spec.state_at(spec.anywhere(rng, 3 * n))
    _, depths = pool.scatter("rest", states)
    states = states[np.argsort(depths > spec.depth, kind="stable")[:n]]
    plant = EnvironmentPlant(pool, None, n)
    plant.set_state(states[:, spec.qpos], states[:, spec.qvel])
    for k in range(min(SAMPLES, spec.max_steps)):
        if k % HELD == 0:
            u = rng.uniform(spec.low, spec.high, (n, len(spec.low)))
        yield plant, u if spec.levels is None else np.round(u)


def check_episodes(pool: Pool) -> None:
    """Raises `BadInput` unless instances go as new ones after other episodes, and later episodes as a first.

    Some runs are judged in a process of their own each. More are judged one after the other in one, and by
    an environment that is never replaced: neither what outlasts its resets nor what these draw may matter.
    Not all of them may be a success at once.
    """
    runs = _episodes(pool, 3, EPISODES)
    pool.check(runs, processes=EPISODES)
    more = _episodes(pool, 4, 2 * EPISODES)
    pool.check(more, processes=1)
    begun = [run for run in (*runs, *more) if len(run.inputs)]
    if begun and all(
        len(run.inputs) == 1 and run.outcome == Outcome.REACHED and not run.cut for run in begun
    ):
        raise BadInput(
            f"each run of {pool.spec.name} is a success after its first step, wherever it begins and "
            f"whatever it does ({pool.spec.criterion.success.text}): say otherwise when an episode is one, "
            "with success"
        )


def check_noise(pool: Pool) -> None:
    """Raises `BadInput` unless instances go as new ones under noise."""
    pool.check([run for seed in (5, 6) for run in _episodes(pool, seed, EPISODES, MOVED)])


def _episodes(pool: Pool, seed: int, n: int, share: float = 0.0) -> list[Played]:
    """Returns n runs from starts at random, under noise of a share of the sides of the chart."""
    spec, everyone = pool.spec, np.arange(n)
    d, o = spec.dimension, spec.columns
    rng, bound = np.random.default_rng(seed), share * spec.chart.sides * spec.noisy
    starts, inputs, noises, told = [], [], [], []
    for plant, u in _runs(pool, seed, n):
        starts.append(plant.state)
        noises.append(rng.uniform(-bound, bound, (n, d)))
        told.append(_observed(plant, noises[-1]))
        plant.step(u)
        inputs.append(u)
    noises.append(np.zeros((n, d)))
    told.append(_observed(plant, noises[-1]))
    plant.end()
    u, path, noise = np.array(inputs), np.array(told), np.array(noises)
    over = path[:, :, -1] != 0
    ends = np.where(over.any(axis=0), over.argmax(axis=0), len(u))
    last, cut = path[ends, everyone], ends == spec.max_steps
    outcome = np.where(
        cut & (last[:, -1] == 0), spec.criterion.verdict(last[:, -2] > 0), last[:, -1]
    )
    if not spec.wrapped:  # at an end that is known nothing is observed any more
        noise[ends, everyone] = 0.0
    return [
        Played(
            starts[0][i],
            u[:end, i],
            path[: end + 1, i, :d],
            int(outcome[i]),
            bool(cut[i]),
            path[: end + 1, i, d : d + o],
            noise[: end + 1, i],
            path[1 : end + 1, i, d + o : d + o + 1],
        )
        for i, end in enumerate(ends)
    ]


def _observed(plant: EnvironmentPlant, noise: np.ndarray) -> np.ndarray:
    """Returns the measurements (n, p) of runs with the observation under noise (n, d)."""
    d, o, everyone = plant.spec.dimension, plant.spec.columns, np.arange(plant.n)
    errors = np.pad(noise, ((0, 0), (0, o + 3)))
    seen = plant.observe(plant.truth(everyone), errors, everyone)[:, d : d + o]
    found = plant.truth(everyone)
    found[:, d : d + o] = seen
    return found


def goes_on(pool: Pool, of_chart: bool = False) -> bool:
    """Returns whether runs go on from written states as they did, so that these are all there is.

    Args:
        pool: plays the runs.
        of_chart: whether the states at rest at the chart points of the runs are written, so that the chart is
            all there is; by default MuJoCo's states of the runs.
    """
    spec, rng = pool.spec, np.random.default_rng(4)
    for plant, u in _runs(pool, 4, 48 if of_chart else EPISODES):
        going = np.flatnonzero(plant.measurement[:, -1] == 0)
        before = plant.state[going]
        plant.step(u[going], going)
        if not len(going):
            return True
        written = before
        if of_chart:
            written = spec.state_at(spec.z(before))
            # The time, which comes first in a state, is no part of the chart, and may matter late.
            written[:, 0] = rng.uniform(0, spec.max_steps * spec.dt, len(going))
        try:
            after, seen, report = pool.scatter("branch", written, u[going])
        except BadInput:
            return False
        success, outcome = spec.criterion.judged(report)
        told = np.column_stack([spec.z(after), seen, report[:, 0], success, outcome])
        if not np.allclose(told, plant.measurement[going], rtol=0, atol=1e-9, equal_nan=True):
            return False
        exact = np.array_equal(seen, plant.measurement[going, spec.dimension : -3])
        if not of_chart and not (exact and np.array_equal(after, plant.state[going])):
            return False
    return True
