"""A task is tried out: whole episodes under random inputs, and under extreme ones from all over its chart."""

from __future__ import annotations

import copy
import inspect
import os
import pickle
import random
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from functools import cached_property, partial
from itertools import count, product
from types import FunctionType, GeneratorType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.files.sources import helpers
from hyrl_mj.physics import mjcf, mujoco_log
from hyrl_mj.sets import Grid
from hyrl_mj.system.generators import global_state
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import Outcome
from hyrl_mj.tasks.guard import check_finite
from hyrl_mj.tasks.registry import alike, get_task, made_again

# Steps of the physics that the episodes of a trial take together, at most; and the fewest side by side.
STEPS, FEWEST = 200_000, 16
STARTS = 32  # as training draws them
ANYWHERE = 4_000  # places at which a task that is made again has to be the same
# Samples after which an input must have changed something.
EFFECT = 10
# Number of the sample -> inputs (n, m).
Inputs = Callable[[int], np.ndarray]
# Indices (k,) of rows -> what a method gives for them (k, ...).
OfRows = Callable[[np.ndarray], np.ndarray]


def try_random(task: Task) -> np.ndarray:
    """Plays episodes under random inputs, and returns their outcomes (n,).

    Raises:
        BadInput: the physics breaks down, or what a method returns cannot be used.
    """
    n, rng = _side_by_side(task), np.random.default_rng(0)
    z = task.starts(n, rng)
    return _play(task, z, lambda k: task.draw_inputs(n, rng), "random")


def try_extreme(task: Task) -> np.ndarray:
    """Plays episodes under inputs at their limits, held and alternating; returns their outcomes (n,).

    They begin all over the chart, because the stages after training do so, too.

    Raises:
        BadInput: as `try_random`.
    """
    rng = np.random.default_rng(0)
    m = len(task.inputs)
    upper = [*product((False, True), repeat=m)] if m <= 4 else rng.random((16, m)) < 0.5
    corners = np.where(upper, task.input_limits[1], task.input_limits[0])
    places = np.vstack([task.starts(STARTS, rng), task.scene.starts, _nodes(task)])
    chosen = rng.permutation(2 * len(corners) * len(places))[: _side_by_side(task)]
    place, corner, alternating = np.unravel_index(chosen, (len(places), len(corners), 2))
    held, opposite = corners[corner], np.sum(task.input_limits, axis=0) - corners[corner]

    def inputs(k: int) -> np.ndarray:
        return np.where((alternating & (k % 2))[:, None], opposite, held)

    return _play(task, places[place], inputs, "extreme")


def try_methods(task: Task) -> None:
    """Raises `BadInput` if a method gives something else for the same rows in another batch or order.

    Then it depends on other rows, or on what it was asked before: nothing that is computed in bulk would
    hold. Nor may it change a variable, draw random numbers, or differ where its file is executed once more.
    """
    rng, own = np.random.default_rng(0), _copied(vars(task))
    z = np.vstack([task.starts(STARTS, rng), task.chart.draw(STARTS, rng)])
    measured, order = task.placed(z).measurement, rng.permutation(len(z))
    methods, chance = _methods(task, z, measured), global_state()
    every = np.arange(len(z))
    for name, asked in methods.items():
        first = asked(every)
        shuffled = np.empty_like(first)
        shuffled[order] = asked(order)
        alone = first.copy()
        for row in order[:STARTS]:
            alone[row] = asked(np.array([row]))[0]
        # Each answer of an environment takes Python code of its user's, which is slow.
        often = STARTS if type(task).plant is Task.plant else 1
        for again in (shuffled, alone, *(asked(every) for _ in range(often))):
            if (row := _differing_row(again, first)) is not None:
                raise BadInput(
                    f"{name}() gives {again[row]} and then {first[row]} for the same row, at "
                    f"{task.chart.format(z[row])}: let it depend on this row alone, and on nothing before"
                )
    _check_unchanged(task, own, vars(task))
    # What is filled once, as a cache, or anew each time is the same after the first time.
    for _ in range(2):
        shared = _copied(_shared(task))
        for asked in methods.values():
            asked(every)
        for name in vars(Task)["__annotations__"]:  # a property may count
            getattr(task, name, None)
    _check_unchanged(task, shared, _shared(task))
    if global_state() != chance:
        raise BadInput(
            "its methods draw from a global generator of random numbers: compute from the measurement alone"
        )
    _try_again(task)


def _try_again(task: Task) -> None:
    """Raises `BadInput` if a method differs where the file of a task is executed once more."""
    if (twin := made_again(task)) is None:
        return
    for name in sorted(vars(Task)["__annotations__"].keys() - {"source", "env_id", "spec"}):
        now, again = getattr(task, name, None), getattr(twin, name, None)
        kinds = type(now), type(again)
        # Of a class of the file, which is another one where that is executed once more.
        anew = kinds[0] is not kinds[1] and kinds[0].__name__ == kinds[1].__name__
        if not (name.startswith("_") or anew or alike(now, again)):
            raise BadInput(
                f"{name} is {now!r:.60}, and {again!r:.60} where {task.source} is executed once more, as "
                "each process does that opens a run: change it in the file"
            )
    if task.model is not twin.model and _saved(task.model) != _saved(twin.model):
        raise BadInput(
            f"its model is another one where {task.source} is executed once more, as each process does: let "
            "the code make the same each time"
        )
    (z, here), (_, there) = _answers(task), _answers(twin)
    for name in here:
        if (row := _differing_row(here[name], there[name])) is not None:
            raise BadInput(
                f"{name}() gives {here[name][row]} at {task.chart.format(z[row])}, and {there[name][row]} "
                f"where {task.source} is executed once more, as each process does: draw nothing there at "
                "random, and let nothing depend on when it is executed"
            )


def try_elsewhere(task: Task) -> None:
    """Raises `BadInput` if a method of a file's task differs in another process, as by the order of a set.

    Texts are hashed otherwise there. What can be imported in this process alone is not tried.
    """
    if made_again(task) is None:
        return
    seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "2"
    places = os.pathsep.join(filter(None, sys.path))
    program = "import sys; from hyrl_mj.tasks import trial; trial.write_answers(*sys.argv[1:])"
    with tempfile.TemporaryDirectory() as folder:
        answers = f"{folder}/answers.npz"
        command = [sys.executable, "-P", "-c", program, str(task.source), answers]
        own = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": places}
        with suppress(subprocess.TimeoutExpired):
            # [s]: to import a task takes seconds; one that takes a minute is left alone.
            subprocess.run(command, env=own, capture_output=True, timeout=60, check=False)
        if not os.path.exists(answers):
            return
        with np.load(answers, allow_pickle=False) as file:
            there = dict(file)
    z, here = _answers(task)
    for name in here.keys() & there.keys():
        if (row := _differing_row(here[name], there[name])) is not None:
            raise BadInput(
                f"{name}() gives {here[name][row]} at {task.chart.format(z[row])}, and {there[name][row]} in "
                "another process, where sets of texts are in another order: let nothing depend on that, on "
                "hash() or on the process"
            )


def write_answers(source: str, path: str) -> None:
    """Writes what the methods of a file's task give all over its chart to an npz file."""
    np.savez(path, **_answers(get_task(source))[1])


def _answers(task: Task) -> tuple[np.ndarray, dict[str, Any]]:
    """Returns chart points (n, d), and what the methods give for them (n, ...), by name."""
    z = task.chart.draw(ANYWHERE, np.random.default_rng(0))
    every, methods = np.arange(len(z)), _methods(task, z, task.placed(z).measurement)
    return z, {name: of_rows(every) for name, of_rows in methods.items()}


def _saved(model: mujoco.MjModel) -> bytes:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def _differing_row(a: np.ndarray, b: np.ndarray) -> int | None:
    """Returns the first row in which arrays (n, ...) differ by more than rounding; None if there is none."""
    same = np.isclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=True)
    return None if same.all() else int(np.argwhere(~same)[0][0])


def _check_unchanged(task: Task, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raises `BadInput` if variables have changed since they were copied, but what is computed once."""
    after = _copied(now)
    lazy = {name for name in after if isinstance(getattr(type(task), name, None), cached_property)}
    for name in after:  # the outer ones first
        if name in lazy:
            continue
        if name not in before or not alike(before[name], after[name]):
            raise BadInput(
                f"its methods change {name} when they are asked: a task remembers nothing, so compute it "
                "from the measurement"
            )


def _shared(task: Task) -> dict[str, Any]:
    """Returns the variables of a task, of its class and of its code, by name, with all that these hold.

    That is the file that defines it, and what this imports from its folder.
    """
    kinds = [kind for kind in type(task).__mro__ if not kind.__module__.startswith("hyrl_mj.")]
    # A session of its user's may hold anything.
    names = {kind.__module__ for kind in kinds} - {"__main__", "builtins", "abc"}
    names |= helpers(task.source).keys() if task.source else set()
    modules = [sys.modules[name] for name in names if name in sys.modules]
    rooms = [*modules, *kinds, task]
    found = {n: v for room in rooms for n, v in vars(room).items() if not n.startswith("__")}
    left, seen = [*found.items()], {id(room) for room in rooms}
    while left:
        name, value = left.pop()
        if id(value) not in seen:
            seen.add(id(value))
            held = {f"{n} of {name}": v for n, v in _held(value, names).items()}
            found |= held
            left += held.items()
    return found


def _held(value: Any, names: Collection[str]) -> dict[str, Any]:
    """Returns what a function keeps, or what an object holds, or a class, of modules of these names."""
    if isinstance(value, FunctionType):
        with suppress(TypeError, ValueError):  # what it wraps may be no function of Python
            kept: dict[str, Any] = {}
            for function in (value, inspect.unwrap(value)):
                kept |= {**inspect.getclosurevars(function).nonlocals, **vars(function)}
                kept["a default"] = [function.__defaults__, function.__kwdefaults__]
            return kept
    if isinstance(value, partial):
        return {"func": value.func, "the arguments": [value.args, value.keywords]}
    if isinstance(value, GeneratorType):
        return inspect.getgeneratorlocals(value)
    if isinstance(value, list | tuple | dict) and len(value) <= 1_000:  # more take long
        return {
            str(n): v for n, v in (value.items() if isinstance(value, dict) else enumerate(value))
        }
    of_class = value if isinstance(value, type) else type(value)
    if of_class.__module__ not in names and of_class is not SimpleNamespace:
        return {}
    slots = [slot for kind in of_class.__mro__ for slot in getattr(kind, "__slots__", ())]
    held = {slot: getattr(value, slot) for slot in slots if hasattr(value, slot)}
    held |= getattr(value, "__dict__", {})
    return {n: v for n, v in held.items() if not n.startswith("__")}


def _copied(variables: Mapping[str, Any]) -> dict[str, Any]:
    """Returns copies of plain variables by name, of generators of random numbers what tells their state."""
    kinds = (bool, int, float, str, list, dict, set, deque, np.ndarray, np.generic)
    chance = (np.random.Generator, np.random.RandomState, random.Random)
    found: dict[str, Any] = {}
    for name, value in variables.items():
        with suppress(Exception):  # what cannot be copied cannot be compared
            if isinstance(value, kinds):
                found[name] = copy.deepcopy(value)
            elif isinstance(value, chance):
                found[name] = pickle.dumps(value)  # to compare it: nothing loads it
            elif isinstance(value, count):
                found[name] = repr(value)
    return found


def _methods(task: Task, z: np.ndarray, measured: np.ndarray) -> dict[str, OfRows]:
    """Returns the methods of a task by name, each of rows of chart points (n, d) or measurements (n, p)."""

    def of_measured(name: str) -> OfRows:
        return lambda rows: getattr(task, name)(measured[rows])

    def state(rows: np.ndarray) -> np.ndarray:
        return np.hstack([part for part in task.state(z[rows]) if part is not None])

    middle = np.mean(task.input_limits, axis=0)

    def reward(rows: np.ndarray) -> np.ndarray:
        return task.reward(measured[rows], np.tile(middle, (len(rows), 1)))

    names = ["z", "observation", "ending", "verdict"]
    if type(task).plant is not Task.plant:  # an environment answers the rest by itself
        return {name: of_measured(name) for name in names}
    path = np.linspace(z, np.random.default_rng(0).permutation(z), 5)
    names += ["danger"] if task.gives_direction else ["danger", "where"]
    found = {name: of_measured(name) for name in names}
    found |= {"state": state, "reward": reward, "miss": lambda rows: task.miss(z[rows])}
    rng, plant = np.random.default_rng(0), task.placed(z)
    sensors, qpos, u = plant.sensors, plant.qpos, task.draw_inputs(len(z), rng)
    found["measure"] = lambda rows: task.measure(sensors[rows])
    qvel = rng.normal(size=(len(z), task.model.nv))
    if task.has_inner_loop:
        found["control"] = lambda rows: task.control(u[rows], qpos[rows], qvel[rows])
    if task.model.nmocap:
        found["mocap"] = lambda rows: np.hstack(
            [*np.moveaxis(mjcf.mocap_poses(task.model, task.mocap, qpos[rows]), 1, 0)]
        )
    if task.gives_direction:
        found["direction"] = lambda rows: task.direction(path[:, rows])
    return found


def try_inputs(task: Task) -> None:
    """Raises `BadInput` if one of the inputs changes nothing that is measured, whatever the others are.

    A car that stands does not turn, and does not brake.
    """
    rng = np.random.default_rng(0)
    z, drawn = task.starts(STARTS, rng), task.draw_inputs(STARTS, rng)
    for i, name in enumerate(task.inputs):
        seen = []
        for limit in task.input_limits:
            plant, u = task.placed(z), drawn.copy()
            u[:, i] = limit[i]
            with mujoco_log.kept():  # the episodes tell more
                for _ in range(min(EFFECT, _samples(task))):
                    plant.step(u)
            seen.append(plant.measurement)
        if (np.abs(seen[1] - seen[0]) <= 1e-9).all():
            raise BadInput(
                f"its input {name} changes nothing that is measured: name another one, or give its actuator "
                f"in {task.model_path.name} some strength"
            )


def try_control(task: Task) -> None:
    """Raises `BadInput` if an inner loop that should depend on the inputs alone depends on the state."""
    if not (task.has_inner_loop and task.steady_control):
        return
    rng = np.random.default_rng(0)
    z = task.chart.draw(ANYWHERE, rng)
    u = task.draw_inputs(ANYWHERE, rng)
    qpos, qvel = task.state(z, rng)
    qvel = rng.normal(size=(ANYWHERE, task.model.nv)) if qvel is None else qvel
    if not np.array_equal(task.control(u, qpos, qvel), task.control(u, qpos[::-1], qvel[::-1])):
        raise BadInput(
            "steady_control is True, but control() gives other controls for the same inputs at another "
            "state: leave steady_control out"
        )


def try_where(task: Task) -> None:
    """Raises `BadInput` if where() puts all states of the chart, and those soon after, on a line."""
    rng = np.random.default_rng(0)
    z = task.chart.draw(STARTS, rng)
    plant, places = task.placed(z), []
    with mujoco_log.kept():
        for _ in range(min(EFFECT, _samples(task)) + 1):
            places.append(task.where(plant.measurement))
            plant.step(task.draw_inputs(STARTS, rng))
    if not (finite := np.isfinite(places[0]).all(axis=1)).all():
        row = int(np.argmin(finite))
        raise BadInput(f"where() gives {places[0][row].tolist()} at {task.chart.format(z[row])}")
    all_places = np.concatenate(places)
    along, across = np.linalg.svd(all_places - all_places.mean(axis=0), compute_uv=False)
    if across <= 1e-6 * max(along, 1e-6):
        shape = "on a line" if along > 1e-6 else "at one place"
        raise BadInput(
            f"where() puts all states of the chart {shape}, as {places[0][0].tolist()}: give two coordinates "
            "of a plane that change with the state, or give the task a direction() of its own"
        )


def try_place(task: Task) -> None:
    """Raises `BadInput` if where() does not give the place of the tracked point, or by default of the chart.

    Obstacles are at places of the world: in other units, or in another order, runs pass them on no side.
    """
    model, tracked = task.model, task.scene.tracked
    kinds = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM
    named = any(mujoco.mj_name2id(model, kind, tracked) >= 0 for kind in kinds)
    if type(task).plant is not Task.plant or not named:
        return
    rng = np.random.default_rng(0)
    plant = task.placed(z := task.chart.draw(STARTS, rng), rng)
    where, number = mjcf.point_of(model, tracked)
    owner = {"site_xpos": model.site_bodyid, "geom_xpos": model.geom_bodyid}.get(where)
    root = model.body_rootid[number if owner is None else owner[number]]
    moves = (model.body_weldid[model.geom_bodyid] != 0) & (
        model.body_rootid[model.geom_bodyid] == root
    )
    data, places, reach = mujoco.MjData(model), [], 0.0
    for qpos in plant.qpos:
        mjcf.place(model, data, qpos, task.mocap)
        place = getattr(data, where)[number]
        places.append(place[list(task.plane)].copy())
        far = np.linalg.norm(data.geom_xpos[moves] - place, axis=1) + model.geom_rbound[moves]
        reach = max(reach, float(far.max(initial=0.0)))
    moved, given = np.ptp(places, axis=0), task.where(plant.measurement)
    off = np.abs(given - places).max(axis=1)
    away = off.max() > (reach or np.inf)
    if type(task).where is not Task.where:  # it may be another point of the robot
        if away:
            row = int(off.argmax())
            raise BadInput(
                f"where() gives {given[row].tolist()} at {task.chart.format(z[row])}, and {tracked} is at "
                f"{places[row].tolist()} in the plane {task.plane} of the world, in metres: let it give the "
                "place of the robot there, or name another point in scene.tracked"
            )
        return
    # A point may be off the middle of a robot that turns, but not off the robot.
    if away or (np.ptp(given - places, axis=0) > moved / 2).any():
        names = " and ".join(task.chart.names[:2])
        raise BadInput(
            f"its chart begins with {names}, and these are not the place of {tracked} in the plane "
            f"{task.plane} of the world, in metres: give the task a where(measured), or name another point "
            "in scene.tracked"
        )
    others = ("um", "mm", "cm", "dm", "km", "in", "ft", "rad", "deg", "°")
    for name, unit in zip(task.chart.names[:2], task.chart.units, strict=False):
        if unit.strip("[] ").lower() in others:
            raise BadInput(
                f"its chart's {name} is said to be in {unit}, and it is the place of {tracked} in metres: "
                "say m"
            )


def _samples(task: Task) -> int:
    """Returns the number of samples of a tried episode."""
    substeps = task.dt / task.model.opt.timestep
    return int(min(task.max_steps, max(STEPS / substeps / FEWEST, 1)))


def _side_by_side(task: Task) -> int:
    """Returns the number of episodes side by side."""
    steps = _samples(task) * task.dt / task.model.opt.timestep
    return int(np.clip(STEPS / steps, FEWEST, task.effort.side_by_side))


def _nodes(task: Task) -> np.ndarray:
    """Returns up to 128 nodes (k, d) of a coarse grid of the chart, at which episodes go on."""
    cells = 1
    while np.prod(Grid.with_cells(task.chart, cells + 1).counts) <= 128:
        cells += 1
    nodes = Grid.with_cells(task.chart, cells).nodes
    nodes = nodes[np.random.default_rng(0).permutation(len(nodes))[:128]]
    return nodes[task.goes_on(nodes)]


def _play(task: Task, z: np.ndarray, inputs: Inputs, kind: str) -> np.ndarray:
    """Plays episodes from starts z (n, d), checks each sample, and returns the outcomes (n,)."""
    plant = task.placed(z, np.random.default_rng(1))
    outcome, path = np.full(len(z), Outcome.RUNNING), [task.z(plant.measurement)]
    _check_observation(task, plant.measurement, 0)
    for sample in range(1, _samples(task) + 1):
        active = np.flatnonzero(outcome == Outcome.RUNNING)
        if not len(active):
            break
        u = inputs(sample)
        with mujoco_log.kept() as warnings:
            plant.step(u[active], active)
            broken = plant.unstable | (plant.warnings > 0)
            if broken.any():
                row, text = int(np.argmax(broken)), next(iter(warnings.values()), "")
                raise BadInput(
                    f"its simulation breaks down under {kind} inputs, from {task.chart.format(z[row])} after "
                    f"{sample} sample(s) with the last inputs {u[row].tolist()} ({text}): in "
                    f"{task.model_path.name}, lower kv or gear, make light bodies heavier, or shorten the "
                    "timestep"
                )
        measurement = plant.measurement
        outcome[active] = task.outcome(measurement[active], np.zeros(len(active), dtype=bool))
        _check_step(task, measurement[active], u[active], outcome[active], sample)
        z = task.chart.near(task.z(measurement), path[-1])
        _check_seam(task, path[-1][active], z[active])
        path.append(np.where((outcome == Outcome.RUNNING)[:, None], z, path[-1]))
    _check_end(task, np.array(path), plant.measurement)
    return outcome


def _check_seam(task: Task, before: np.ndarray, after: np.ndarray) -> None:
    """Raises `BadInput` if an angle that is not said to be periodic goes on at its other end."""
    chart = task.chart
    turns = {"rad": 2 * np.pi, "deg": 360.0, "°": 360.0}
    for axis, unit in enumerate(chart.units):
        leap = np.abs(after[:, axis] - before[:, axis])
        turn = turns.get(unit.strip("[] ").lower(), np.inf)
        # Who leaps over nearly a whole turn in a sample has crossed the seam.
        if not chart.periodic[axis] and leap.max() > 0.9 * turn:
            row = int(leap.argmax())
            raise BadInput(
                f"within one sample {chart.names[axis]} leaps from {before[row, axis]:.3g} to "
                f"{after[row, axis]:.3g} {unit}: say in the chart that it is periodic, or, if it "
                "turns that fast, make the sample time shorter"
            )


def _check_step(
    task: Task, measurement: np.ndarray, u: np.ndarray, outcome: np.ndarray, sample: int
) -> None:
    """Checks observation and reward of a step that ended in measurements (k, p)."""
    running = outcome == Outcome.RUNNING
    _check_observation(task, measurement[running], sample)
    task.observation(measurement)  # the last one of an episode is learned from, too
    reward = task.reward(measurement, u)
    check_finite(task, "reward", reward, measurement)
    check_finite(task, "danger", task.danger(measurement), measurement, infinite=True)
    low = running & (reward < task.worst_reward)
    if low.any():
        point = task.chart.format(task.z(measurement)[np.argmax(low)])
        raise BadInput(
            f"reward() gives {reward[low][0]:g} at {point}, and worst_reward is {task.worst_reward:g}: "
            "lower it, or bound the reward"
        )


def _check_observation(task: Task, measurement: np.ndarray, sample: int) -> None:
    """Raises `BadInput` if observations of measurements (n, p) do not lie in their bounds."""
    low, high = np.array(task.observation_low), np.array(task.observation_high)
    observation = task.observation(measurement)
    outside = ~((observation >= low) & (observation <= high))
    if outside.any():
        row, column = np.argwhere(outside)[0]
        raise BadInput(
            f"observation[{column}] is {observation[row, column]:g} after {sample} samples, and "
            f"its bounds are {low[column]:g} and {high[column]:g}: widen them"
        )


def _check_end(task: Task, path: np.ndarray, measurement: np.ndarray) -> None:
    """Tries the methods that judge a whole episode, on paths (K + 1, n, d)."""
    if task.gives_direction:
        ways = set(np.unique(task.direction(path)).tolist())
        if not ways <= {-1, *range(len(task.scene.mode_names))}:
            raise BadInput(
                f"direction() gives {sorted(ways)}: give -1 or an index of scene.mode_names"
            )
    task.arrived(path[-1])
    task.verdict(measurement)
    miss = task.miss(path[-1])
    check_finite(task, "miss", miss, path[-1], infinite=True)
    if (miss < 0).any():
        point = task.chart.format(path[-1][np.argmin(miss)])
        raise BadInput(f"miss() gives {miss.min():g} at {point}: give a distance, >= 0")
