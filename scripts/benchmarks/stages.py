"""Critical set and extended sets, against the same starts one at a time."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from itertools import product
from types import SimpleNamespace
from typing import Any
from unittest import mock

import mujoco
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks import Figure
from benchmarks.runs import Runs
from hyrl_mj import Run, Task, extend, find_critical_set
from hyrl_mj.learning import WaySettings
from hyrl_mj.learning.training import build
from hyrl_mj.simulation import LoopSettings
from hyrl_mj.stages.partition import PartPolicy
from hyrl_mj.tasks import Outcome

RODS, RESOLUTION = 30, 1 / 32
# One start in so many is run one at a time: all of them would take minutes.
SHARE = 25


def figures(runs: Runs) -> Iterator[Figure]:
    """The search for M*, and the extended sets of both problems."""
    run = runs.load("vehicle")
    yield Figure(
        f"critical set, vehicle, {RODS} x {RODS} rods, all levels",
        "ms",
        "rod by rod, SB3's predict",
        ">= 50x",
        lambda: len([find_critical_set(run.task, run.policy, RODS, RESOLUTION)]),
        _rod_by_rod(run),
    )
    for name in ("vehicle", "unit_circle"):
        yield _extension(runs.load(name))


def _extension(run: Run) -> Figure:
    task, settings = run.task, run.settings
    args = (task, run.policy, run.critical_set.points, run.partition, settings.eps)
    calls: list[tuple[Any, np.ndarray, LoopSettings]] = []
    # The package has a function of that name.
    runs_of_ways = import_module("hyrl_mj.simulation.way_runs")
    batched = runs_of_ways.closed_loop

    def noted(task: Task, controller: Any, z0: np.ndarray, *, settings: LoopSettings) -> Any:
        calls.append((controller.policy, z0, settings))
        return batched(task, controller, z0, settings=settings)

    with mock.patch.object(runs_of_ways, "closed_loop", noted):
        extend(*args)
    starts = sum(len(z0) for _, z0, _ in calls)
    predict = _predict(run)

    def ours() -> int:
        extend(*args)
        return starts

    def plain() -> int:
        done = 0
        for pi, z0, settings in calls:
            policy = replace(pi, policy=predict) if isinstance(pi, PartPolicy) else predict
            limit = settings.steps or task.max_steps
            for z in z0[::SHARE]:
                _one_start(task, policy, z, limit, backward=settings.backward)
                done += 1
        return done

    against = "start by start, SB3's predict"
    return Figure(f"extended sets, {task.name}", "starts/s", against, ">= 50x", ours, plain)


def _one_start(task: Task, policy: Any, z: np.ndarray, steps: int, backward: bool) -> np.ndarray:
    """One closed loop, as a script would write it; the path (k, d)."""
    model, data = task.model, mujoco.MjData(task.model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    held = data.ctrl.copy()
    data.qpos[:] = task.state(z[None])[0][0]
    mujoco.mj_forward(model, data)
    path = [data.sensordata.copy()]
    drives = [model.actuator(name).id for name in task.inputs]
    for _ in range(steps):
        u = policy.act(path[-1][None])[0]
        data.ctrl[:] = held
        data.ctrl[drives] = u
        if backward:
            data.ctrl *= -1
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_sensorPos(model, data)
        path.append(data.sensordata.copy())
        if not backward and task.ending(path[-1][None])[0] != Outcome.RUNNING:
            break
    return np.array(path)


def _predict(run: Run) -> Any:
    """The stage-1 policy by SB3's predict, of one measurement (1, p)."""
    task = run.task
    model: BaseAlgorithm = build(task, run.settings.stage1, 0, start_from=run.policy)

    def act(measured: np.ndarray) -> np.ndarray:
        observation = task.observation(measured)[0].astype(np.float32)
        action, _ = model.predict(observation, deterministic=True)
        return (action if task.input_levels is None else task.input_levels[action])[None]

    return SimpleNamespace(act=act)


def _rod_by_rod(run: Run) -> Callable[[], int]:
    """The paper's search of the whole chart (Algorithm 1): rod by rod, its ends one after the other."""
    task, policy, chart = run.task, _predict(run), run.task.chart
    cell = chart.sides.max() / RODS

    def search(centre: np.ndarray, axis: np.ndarray, length: float) -> None:
        moves = []
        for end in (centre - axis * length / 2, centre + axis * length / 2):
            path = _one_start(task, policy, end, WaySettings.samples, backward=False)
            moves.append(path[-1] - path[0])
        apart = np.linalg.norm(moves[1] - moves[0])
        if apart <= WaySettings.parting * sum(np.linalg.norm(move) for move in moves):
            return
        if length > RESOLUTION * cell:
            for half in (-0.25, 0.25):
                search(centre + half * length * axis, axis, length / 2)

    def work() -> int:
        sides = zip(chart.low, chart.high, strict=True)
        for point in product(*(np.arange(low + cell / 2, high, cell) for low, high in sides)):
            for axis in np.eye(chart.dimension):
                search(np.array(point), axis, cell)
        return 1

    return work
