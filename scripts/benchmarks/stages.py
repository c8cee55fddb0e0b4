"""Critical set and extended sets, against the same starts one at a time."""

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from itertools import product
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
    search = _OneRod(run)
    yield Figure(
        f"critical set, vehicle, {RODS} x {RODS} rods, all levels",
        "ms",
        "rod by rod, SB3's predict",
        ">= 50x",
        lambda: len([find_critical_set(run.task, run.policy, RODS, RESOLUTION)]),
        search.all,
    )
    for name in ("vehicle", "unit_circle"):
        yield _extension(runs.load(name))


def _extension(run: Run) -> Figure:
    task, settings = run.task, run.settings
    args = (task, run.policy, run.critical_set.points, run.partition, settings.eps)
    calls: list[tuple[Any, np.ndarray, LoopSettings]] = []
    runs_of_ways = import_module(
        "hyrl_mj.simulation.way_runs"
    )  # the package has a function of that name
    batched = runs_of_ways.closed_loop

    def noted(task: Task, controller: Any, z0: np.ndarray, *, settings: LoopSettings) -> Any:
        calls.append((controller.policy, z0, settings))
        return batched(task, controller, z0, settings=settings)

    with mock.patch.object(runs_of_ways, "closed_loop", noted):
        extend(*args)
    starts = sum(len(z0) for _, z0, _ in calls)
    predict = _Predict(run)

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


class _Predict:
    """The stage-1 policy by SB3's predict."""

    def __init__(self, run: Run):
        self._task = run.task
        self._model: BaseAlgorithm = build(run.task, run.settings.stage1, 0, start_from=run.policy)

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Of one measurement (1, p)."""
        observation = self._task.observation(measured)[0].astype(np.float32)
        action, _ = self._model.predict(observation, deterministic=True)
        levels = self._task.input_levels
        return (action if levels is None else levels[action])[None]


class _OneRod:
    """The paper's search (Algorithm 1): rod by rod, its ends one after the other."""

    def __init__(self, run: Run):
        self._task, self._predict = run.task, _Predict(run)

    def all(self) -> int:
        """Search the whole chart."""
        chart = self._task.chart
        sides = np.subtract(chart.high, chart.low)
        cell = sides.max() / RODS
        axes = [
            np.arange(low + cell / 2, high, cell)
            for low, high in zip(chart.low, chart.high, strict=True)
        ]
        found = []
        for point in product(*axes):
            for axis in np.eye(len(sides)):
                self._search(np.array(point), axis, cell, RESOLUTION * cell, found)
        return 1

    def _search(self, centre, axis, length, least, found) -> None:
        ends = [centre - axis * length / 2, centre + axis * length / 2]
        paths = [
            _one_start(self._task, self._predict, end, WaySettings.samples, backward=False)
            for end in ends
        ]
        moves = [path[-1] - path[0] for path in paths]
        apart = np.linalg.norm(moves[1] - moves[0])
        if apart <= WaySettings.parting * sum(np.linalg.norm(move) for move in moves):
            return
        if length <= least:
            found.append(centre)
            return
        for half in (-0.25, 0.25):
            self._search(centre + half * length * axis, axis, length / 2, least, found)
