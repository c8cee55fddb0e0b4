"""Samples of the batched environments, against the bare physics and against one environment in a loop."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import gymnasium
import numpy as np
from mujoco.batch import Batch

import hyrl_mj
from benchmarks import Figure
from benchmarks.runs import Runs
from hyrl_mj import Task
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop

# Samples that a piece of work is.
SAMPLES = 60


def figures(runs: Runs) -> Iterator[Figure]:
    """The vehicle at two sizes, a heavier plant, Gymnasium's own way, and noisy episodes."""
    vehicle, raw = hyrl_mj.get_task("vehicle"), "Batch.step of the same model, same threads"
    for task, n, target in (
        (vehicle, 4096, ">= 0.5"),
        (vehicle, 64, ">= 0.25"),
        (hyrl_mj.get_task("quadrotor"), 1024, ">= 0.9"),
    ):
        name = f"{task.name}, n = {n}, with observation, reward, ends, resets"
        yield Figure(name, "samples/s", raw, target, episodes(task, n), _physics(task, n))
    name, single = "vehicle, n = 4096, in batches", "the Gymnasium environment"
    ours, theirs = episodes(vehicle, 4096), _one_environment(vehicle)
    yield Figure(name, "samples/s", single, ">= 20", ours, theirs)
    name = "PointMaze_Medium-v3, n = 256, through from_gymnasium"
    for mode, against in (("sync", "SyncVectorEnv"), ("async", "AsyncVectorEnv")):
        with _outside("PointMaze_Medium-v3", 256, mode) as (ours, theirs):
            yield Figure(name, "samples/s", f"Gymnasium's {against}", ">= 0.8", ours, theirs)
    name = "vehicle, closed loop under noise, 10,000 episodes"
    yield Figure(name, "samples/s", raw, ">= 0.3", _closed_loop(runs), _physics(vehicle, 4096))


def episodes(task: Task, n: int) -> Callable[[], int]:
    """Returns samples of so many episodes under random inputs, which are reset where they end."""
    env = BatchedEnv(task, n)
    env.seed(0)
    env.reset()
    u = np.random.default_rng(0).uniform(*task.input_limits, (SAMPLES, n, len(task.inputs)))

    def work() -> int:
        for row in u:
            done = np.flatnonzero(env.step(row).done)
            if len(done):
                env.reset(done)
        return n * SAMPLES

    return work


def _physics(task: Task, n: int) -> Callable[[], int]:
    batch = Batch(task.model, n)
    batch.qpos[:] = task.state(task.starts(n, np.random.default_rng(0)))[0]
    substeps = round(task.dt / task.model.opt.timestep)

    def work() -> int:
        for _ in range(SAMPLES):
            batch.step(nstep=substeps)
        return n * SAMPLES

    return work


@contextmanager
def _outside(name: str, n: int, mode: str) -> Iterator[tuple[Callable[[], int], Callable[[], int]]]:
    """Yields steps of copies of an environment of others, as ours and as Gymnasium's."""
    options = {"goal_cell": np.array([6, 6])}
    task = hyrl_mj.from_gymnasium(name, reset=options)
    plant, rng = task.plant(n), np.random.default_rng(0)
    plant.set_state(*task.state(task.starts(n, rng)))
    inputs = rng.uniform(*task.input_limits, (SAMPLES, n, len(task.inputs)))
    others = gymnasium.make_vec(name, n, vectorization_mode=mode)
    others.reset(seed=0, options=options)

    def ours() -> int:
        for u in inputs:
            plant.step(u)
            task.observation(plant.measurement)
        return n * SAMPLES

    def theirs() -> int:
        for u in inputs.astype(np.float32):
            others.step(u)
        return n * SAMPLES

    yield ours, theirs
    others.close()


def _one_environment(task: Task) -> Callable[[], int]:
    env = gymnasium.make(task.env_id)
    env.reset(seed=0)
    env.action_space.seed(0)

    def work() -> int:
        for _ in range(500):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
        return 500

    return work


def _closed_loop(runs: Runs) -> Callable[[], int]:
    run = runs.load("vehicle")
    z0 = run.task.starts(10_000, np.random.default_rng(0))

    def work() -> int:
        noise = Noise("uniform", 0.1)
        rollout = closed_loop(
            run.task, run.controller, z0, noise, settings=LoopSettings(quiet=True)
        )
        return int(rollout.length.sum())

    return work
