"""Samples of the batched environments, against the bare physics and against one environment in a loop."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property

import gymnasium
import mujoco
import numpy as np
from mujoco.batch import Batch

import hyrl_mj
from benchmarks import Figure
from benchmarks.runs import Runs
from hyrl_mj import Chart, Outcome, Task
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
        (CartPole(), 1024, ">= 0.9"),
    ):
        name = f"{task.name}, n = {n}, with observation, reward, ends, resets"
        yield Figure(name, "samples/s", raw, target, _episodes(task, n), _physics(task, n))
    single = _one_environment(vehicle)
    name = "vehicle, n = 4096, in batches"
    yield Figure(
        name, "samples/s", "the Gymnasium environment", ">= 20", _episodes(vehicle, 4096), single
    )
    name = "PointMaze_Medium-v3, n = 256, through from_gymnasium"
    for mode, against in (("sync", "SyncVectorEnv"), ("async", "AsyncVectorEnv")):
        with _outside("PointMaze_Medium-v3", 256, mode) as (ours, theirs):
            yield Figure(name, "samples/s", f"Gymnasium's {against}", ">= 0.8", ours, theirs)
    name = "vehicle, closed loop under noise, 10,000 episodes"
    yield Figure(name, "samples/s", raw, ">= 0.3", _closed_loop(runs), _physics(vehicle, 4096))


def _episodes(task: Task, n: int) -> Callable[[], int]:
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


class CartPole(Task):
    """A pole to balance on a cart, at two substeps a sample: more physics than a point that moves."""

    name = "cart-pole"
    chart = Chart(("cart", "pole"), ("m", "rad"), (-2.4, -0.3), (2.4, 0.3), (False, False))
    inputs = ("push",)
    noisy = (True, True, True, True)
    max_steps, worst_reward = 200, 0.0
    start_low, start_high = (-0.05, -0.05), (0.05, 0.05)
    observation_low, observation_high = (-10.0,) * 4, (10.0,) * 4

    @cached_property
    def model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(
            """
            <mujoco model="cart-pole">
              <option timestep="0.01" integrator="RK4"/>
              <custom><numeric name="sample_time" data="0.02"/></custom>
              <worldbody>
                <geom type="plane" size="5 5 0.1" pos="0 0 -1"/>
                <body>
                  <joint name="cart" type="slide" axis="1 0 0" limited="true" range="-3 3" damping="0.1"/>
                  <geom type="box" size="0.1 0.1 0.05" mass="1"/>
                  <body pos="0 0 0.05">
                    <joint name="pole" axis="0 1 0" damping="0.01"/>
                    <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.045" mass="0.1"/>
                  </body>
                </body>
              </worldbody>
              <actuator><motor name="push" joint="cart" gear="10" ctrlrange="-1 1"/></actuator>
              <sensor>
                <jointpos joint="cart"/><jointpos joint="pole"/>
                <jointvel joint="cart"/><jointvel joint="pole"/>
              </sensor>
            </mujoco>
            """
        )

    def z(self, measured: np.ndarray) -> np.ndarray:
        return measured[:, :2]

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return measured

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.cos(measurement[:, 1])

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        fallen = (np.abs(measurement[:, 1]) > 0.2) | (np.abs(measurement[:, 0]) > 2.4)
        return np.where(fallen, Outcome.CRASHED, Outcome.RUNNING)

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        return np.full(len(measurement), Outcome.REACHED)

    def arrived(self, z: np.ndarray) -> np.ndarray:
        return self.miss(z) < 0.2

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.abs(z[:, 1])

    def direction(self, path: np.ndarray) -> np.ndarray:
        return np.where(path[-1, :, 1] > 0, 0, 1)
