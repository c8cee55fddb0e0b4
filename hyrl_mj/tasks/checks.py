"""Checks that a task is complete and consistent, before anything is trained."""

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj import mjcf
from hyrl_mj.chart import Chart
from hyrl_mj.errors import BadInput, brief, unknown
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import SEARCHES, Learning, Outcome, Scene
from hyrl_mj.tasks.registry import check_current, line_in

# Number of starts that are tried, and of samples from each under random inputs.
STARTS, SAMPLES = 64, 20
# Largest error of a chart point that is set as a full state and measured [chart units].
ROUND_TRIP = 1e-6


def check_task(task: Task) -> Task:
    """Returns the task itself, if it can be trained.

    Raises:
        BadInput: it cannot; the message names the file, the mistake, and the remedy.
    """
    check_current(task)
    where = task.source or task.name
    try:
        _check_parts(task)
        _check_training(task)
        _check_model(task)
        _check_starts(task)
        _check_episode(task)
    except BadInput as error:
        raise BadInput(f"the task of {where} cannot be used: {error}") from error
    except Exception as error:  # whatever its own methods raise
        line = line_in(error, task.source)
        raise BadInput(f"the task of {where} cannot be used: {brief(error)}{line}") from error
    return task


def _check_parts(task: Task) -> None:
    if missing := [name for name in Task.__annotations__ if not hasattr(task, name)]:
        raise BadInput(f"it has no {', '.join(missing)}: add what is missing")
    for name, kind in (("chart", Chart), ("scene", Scene), ("learning", Learning)):
        if not isinstance(value := getattr(task, name), kind):
            raise BadInput(f"{name} is {value!r}: give a hyrl_mj.{kind.__name__}(...)")
    chart, d = task.chart, task.chart.dimension
    for name in ("units", "low", "high", "periodic"):
        if (count := len(getattr(chart, name))) != d:
            raise BadInput(f"its chart has {d} name(s) and {count} value(s) of {name}: give {d}")
    if not (np.isfinite(chart.sides).all() and (chart.sides > 0).all()):
        raise BadInput("its chart has a side that is not positive: give low < high, both finite")
    for name in ("start_low", "start_high"):
        if (count := len(getattr(task, name))) != d:
            raise BadInput(f"{name} has {count} value(s): its chart takes {d}")
    if np.greater(task.start_low, task.start_high).any():
        raise BadInput("start_low is greater than start_high: exchange them")
    if task.set_point is not None:
        _check_shape("set_point has", task.set_point, (d,))
    scene = task.scene
    for start in (*scene.starts, *scene.policy_starts):
        task.chart.check(start, task.name)
    if not (np.isfinite(scene.time) and scene.time > 0):
        raise BadInput(f"scene.time is {scene.time}: give a time > 0 s")
    if not np.isfinite(task.noisy).all() or min(task.noisy) < 0:
        raise BadInput(f"noisy is {task.noisy}: give shares of the noise bound, 0 or more")
    if len(scene.mode_names) < 2:
        raise BadInput(f"scene.mode_names is {scene.mode_names!r}: name two or more")


def _check_training(task: Task) -> None:
    learning = task.learning
    if learning.search not in SEARCHES:
        raise unknown("search", learning.search, SEARCHES)
    if not task.inputs:
        raise BadInput("inputs is empty: name the actuators that the policy drives")
    if learning.levels is not None and (learning.levels < 2 or len(task.inputs) > 1):
        raise BadInput(
            f"{learning.levels} levels of {len(task.inputs)} input(s) cannot be used: give 2 or more of a "
            "single input, or none"
        )
    if task.mirror is not None:
        counts = {"observation": len(task.observation_low), "inputs": len(task.inputs)}
        for name, count in counts.items():
            signs = getattr(task.mirror, name)
            if len(signs) != count or not set(signs) <= {-1, 1}:
                raise BadInput(f"mirror.{name} is {signs}: give {count} values, each 1 or -1")


def _check_model(task: Task) -> None:
    model, path = task.model, task.model_path
    if not model.nu:
        raise BadInput(f"{path.name} has no actuators: give the policy at least one to drive")
    _ = task.input_limits
    # The replay needs both.
    mjcf.object_id(model, mujoco.mjtObj.mjOBJ_SITE, task.scene.tracked)
    mjcf.object_id(model, mujoco.mjtObj.mjOBJ_CAMERA, task.scene.camera)
    steps = task.dt / model.opt.timestep
    if abs(steps - round(steps)) > 1e-6 or steps < 0.5:
        raise BadInput(
            f"its sample time {task.dt:g} s is no multiple of the physics step "
            f"{model.opt.timestep:g} s in {path.name}: change one of them"
        )


def _check_starts(task: Task) -> None:
    d, p = task.chart.dimension, task.measurement_columns
    z = task.starts(STARTS, np.random.default_rng(0))
    _check_shape(f"starts({STARTS}) gives", z, (STARTS, d))
    outside = z[~task.chart.contains(z)]
    if len(outside):
        point = task.chart.format(outside[0])
        raise BadInput(f"it starts outside its chart, at {point}: change one of them")
    plant = task.plant(STARTS)
    plant.set_state(*task.state(z, np.random.default_rng(1)))
    measurement = plant.measurement
    if measurement.shape != (STARTS, p):
        raise BadInput(
            f"it measures {measurement.shape[1]} column(s), and `noisy` has {p}: make them as many"
        )
    back = task.z(measurement)
    _check_shape("z() gives", back, z.shape)
    _check_shape("with_z() gives", task.with_z(measurement, z[::-1]), measurement.shape)
    off = np.abs(task.chart.difference(back, z)).max(axis=1)
    if off.max() > ROUND_TRIP:
        worst = int(off.argmax())
        raise BadInput(
            f"state() and z() do not belong to each other: {task.chart.format(z[worst])} is measured as "
            f"{task.chart.format(back[worst])}"
        )
    ending = task.ending(measurement)
    over = np.flatnonzero(ending != Outcome.RUNNING)
    if len(over):
        raise BadInput(
            f"{len(over)} of {STARTS} starts are over before they begin: {task.chart.format(z[over[0]])} "
            f"is {Outcome(ending[over[0]]).label}; start elsewhere, or change ending()"
        )


def _check_episode(task: Task) -> None:
    rng, plant = np.random.default_rng(0), task.plant(STARTS)
    plant.set_state(*task.state(task.starts(STARTS, rng), rng))
    low, high = np.array(task.observation_low), np.array(task.observation_high)
    path = [task.z(plant.measurement)]
    for sample in range(SAMPLES):
        measurement = plant.measurement
        running = task.outcome(measurement, plant.unstable) == Outcome.RUNNING
        observation = task.observation(measurement[running])
        if observation.shape[1:] != low.shape or low.shape != high.shape:
            raise BadInput(
                f"observation() gives shape {observation.shape} for {running.sum()} measurements, "
                f"observation_low has {len(low)} values and observation_high {len(high)}: make them as many"
            )
        outside = ~((observation >= low) & (observation <= high))
        if outside.any():
            row, column = np.argwhere(outside)[0]
            raise BadInput(
                f"observation[{column}] is {observation[row, column]:g} after {sample} samples, and "
                f"its bounds are {low[column]:g} and {high[column]:g}: widen them"
            )
        u = rng.uniform(*task.input_limits, (STARTS, len(task.inputs)))
        reward = np.asarray(task.reward(measurement, u))
        if reward.shape != (STARTS,) or not np.isfinite(reward[running]).all():
            raise BadInput(
                f"reward() of {STARTS} measurements must be {STARTS} finite numbers, it has shape "
                f"{reward.shape} and values like {reward.ravel()[0]:g}"
            )
        plant.step(u)
        path.append(task.z(plant.measurement))
    way = task.direction(np.array(path))
    z, measurement = path[-1], plant.measurement
    results = {
        "direction": way,
        "miss": task.miss(z),
        "arrived": task.arrived(z),
        "danger": task.danger(measurement),
        "verdict": task.verdict(measurement),
    }
    for name, values in results.items():
        _check_shape(f"{name}() gives", values, (STARTS,))
    ways = set(np.unique(way).tolist())
    if not ways <= {-1, *range(len(task.scene.mode_names))}:
        raise BadInput(f"direction() gives {sorted(ways)}: give -1 or an index of scene.mode_names")


def _check_shape(what: str, values: ArrayLike, shape: tuple[int, ...]) -> None:
    if np.shape(values) != shape:
        raise BadInput(f"{what} shape {np.shape(values)}: the task needs {shape}")
