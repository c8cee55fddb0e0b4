"""The critical set, against the paper's procedure: rod by rod, and one closed loop at a time."""

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import mujoco
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks import Figure
from benchmarks.runs import Runs
from hyrl_mj import Run, Task, find_critical_set
from hyrl_mj.learning import WaySettings
from hyrl_mj.learning.training import build
from hyrl_mj.tasks import Outcome

RODS, RESOLUTION = 30, 1 / 32


def figures(runs: Runs) -> Iterator[Figure]:
    """The search for M*."""
    run = runs.load("vehicle")
    yield Figure(
        f"critical set, vehicle, {RODS} x {RODS} rods, all levels",
        "ms",
        "rod by rod, SB3's predict",
        ">= 50x",
        lambda: len([find_critical_set(run.task, run.policy, RODS, RESOLUTION)]),
        _rod_by_rod(run),
    )


def _one_start(task: Task, act: Callable[[np.ndarray], Any], z: np.ndarray) -> np.ndarray:
    """One closed loop, as a script would write it; how far it goes (d,)."""
    model, data = task.model, mujoco.MjData(task.model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[:] = task.state(z[None])[0][0]
    mujoco.mj_forward(model, data)
    path = [data.sensordata.copy()]
    drives = [model.actuator(name).id for name in task.inputs]
    for _ in range(WaySettings.samples):
        data.ctrl[drives] = act(path[-1])
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_sensorPos(model, data)
        path.append(data.sensordata.copy())
        if task.ending(path[-1][None])[0] != Outcome.RUNNING:
            break
    return path[-1] - path[0]


def _predict(run: Run) -> Callable[[np.ndarray], Any]:
    """The stage-1 policy by SB3's predict, of one measurement (p,)."""
    task = run.task
    model: BaseAlgorithm = build(task, run.settings.stage1, 0, start_from=run.policy)

    def act(measured: np.ndarray) -> Any:
        observation = task.observation(measured[None])[0].astype(np.float32)
        action, _ = model.predict(observation, deterministic=True)
        return action if task.input_levels is None else task.input_levels[action]

    return act


def _rod_by_rod(run: Run) -> Callable[[], int]:
    """The paper's search of the whole chart (Algorithm 1): rod by rod, its ends one after the other."""
    task, act, chart = run.task, _predict(run), run.task.chart
    cell = chart.sides.max() / RODS

    def search(centre: np.ndarray, axis: np.ndarray, length: float) -> None:
        ends = (centre - axis * length / 2, centre + axis * length / 2)
        moves = [_one_start(task, act, end) for end in ends]
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
