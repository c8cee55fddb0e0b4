"""Agents of others: trains agents with plain SB3 on environments of others, for `hyrl-mj diagnose --env`.

    pip install "hyrl-mj[robotics,dm-control]"
    python scripts/outside_agents.py reacher point-maze --out agents

Nothing of hyrl_mj takes part. Each agent takes a few minutes, and the same seed gives the same agent on the
same kind of machine.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

# Where the goal of Reacher is pinned [m].
TARGET = (-0.15, 0.0)


class From(gym.Wrapper):
    """An environment that is placed anew after each reset, by a function that returns the observation."""

    def __init__(self, env: gym.Env, place: Callable[[Any], Any]):
        super().__init__(env)
        self._place = place

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        _, info = self.env.reset(**options)
        return self._place(self.env.unwrapped), info


class WithOptions(gym.Wrapper):
    """An environment that is always reset with the same options."""

    def __init__(self, env: gym.Env, options: dict[str, Any]):
        super().__init__(env)
        self._options = options

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.env.reset(seed=seed, options=self._options)


@dataclass(frozen=True)
class Agent:
    """How an agent is trained.

    Attributes:
        make: makes its environment.
        samples: number of samples.
        options: the arguments of the algorithm.
        policy: SB3's name of its policy.
        kind: SB3's algorithm.
        copies: number of environments.
    """

    make: Callable[[], gym.Env]
    samples: int
    options: dict[str, Any]
    policy: str = "MlpPolicy"
    kind: type[PPO] | type[SAC] = PPO
    copies: int = 16


def reacher() -> gym.Env:
    """Reacher with its target at one place, from any pose of its arm."""

    def place(inner: Any) -> np.ndarray:
        qpos, qvel = inner.data.qpos.copy(), inner.data.qvel.copy()
        qpos[:2] = inner.np_random.uniform((-np.pi, -2.8), (np.pi, 2.8))
        qpos[2:4] = TARGET
        inner.set_state(qpos, qvel)
        return inner._get_obs()

    return From(gym.make("Reacher-v5"), place)


def maze(name: str, cell: tuple[int, int]) -> Callable[[], gym.Env]:
    def make() -> gym.Env:
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
        return WithOptions(gym.make(name), {"goal_cell": np.array(cell)})

    return make


def ogbench() -> gym.Env:
    """A maze from any free cell."""
    import ogbench  # noqa: F401

    def place(inner: Any) -> np.ndarray:
        cell = inner.ij_to_xy(inner.np_random.choice(np.argwhere(inner.maze_map == 0)))
        inner.set_xy(cell + inner.np_random.uniform(-1.5, 1.5, 2))
        return inner.get_ob()

    return From(gym.make("pointmaze-medium-singletask-v0", add_noise_to_goal=False), place)


def pendulum() -> gym.Env:
    """A pendulum whose reward tells how upright it is, with inputs that are held for two steps."""
    import shimmy
    from dm_control.mujoco.wrapper.mjbindings import sizes

    # dm_control 1.0.50 asks for arrays that MuJoCo 4 has renamed.
    for name, kind in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
        table = sizes.array_sizes[name]
        sizes.array_sizes[name] = {key: table[key] for key in table if hasattr(kind, key)}
    gym.register_envs(shimmy)
    env = gym.wrappers.FlattenObservation(gym.make("dm_control/pendulum-swingup-v0"))
    physics: Any = env.unwrapped._env.physics
    upright = gym.wrappers.TransformReward(env, lambda _: float(physics.pole_vertical() - 1) / 2)
    return gym.wrappers.RepeatAction(upright, 2)


def annealed(left: float) -> float:
    """The rate of learning while a share of the training is left."""
    return 1e-3 * left


def net(*hidden: int) -> dict[str, Any]:
    return {"policy_kwargs": {"net_arch": list(hidden)}}


SHORT = {"n_steps": 128, "batch_size": 512, "learning_rate": 1e-3, "gamma": 0.98}
LONG = {"n_steps": 256, "batch_size": 1024, "n_epochs": 6, "gamma": 0.995, "learning_rate": 1e-3}
LONG["ent_coef"] = 0.003
LARGE = {**LONG, "gamma": 0.997, "gae_lambda": 0.98, **net(128, 128)}
SWING = {"learning_starts": 2_000, "gradient_steps": 4, "learning_rate": 1e-3, "gamma": 0.99}
medium, large = maze("PointMaze_Medium-v3", (6, 6)), maze("PointMaze_Large-v3", (3, 6))
AGENTS = {
    "reacher": Agent(reacher, 600_000, SHORT),
    "point-maze": Agent(medium, 1_500_000, LONG, "MultiInputPolicy"),
    "point-maze-large": Agent(large, 3_000_000, LARGE, "MultiInputPolicy"),
    "ogbench": Agent(ogbench, 3_000_000, {**LONG, "learning_rate": annealed, **net(128, 128)}),
    "pendulum": Agent(pendulum, 60_000, {**SWING, **net(64, 64)}, kind=SAC, copies=4),
}


def train(agent: Agent, seed: int, path: Path) -> str:
    """Trains an agent, PPO's with rewards of unit variance, saves it, and returns how well it does."""

    def make() -> gym.Env:
        env = agent.make()
        if agent.kind is SAC:
            return env
        return gym.wrappers.NormalizeReward(env, gamma=agent.options["gamma"])

    env = make_vec_env(make, n_envs=agent.copies, seed=seed)
    model = agent.kind(agent.policy, env, seed=seed, device="cpu", verbose=0, **agent.options)
    model.learn(agent.samples)
    model.save(path)
    mean, spread = evaluate_policy(model, agent.make(), 10, warn=False)
    return f"return {mean:.1f} +- {spread:.1f}"


def main() -> None:
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("agents", nargs="+", choices=AGENTS)
    parser.add_argument("--out", type=Path, default=Path("agents"))
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.agents:
        began = time.monotonic()
        how = train(AGENTS[name], given.seed, given.out / f"{name}.zip")
        print(f"{name}: {time.monotonic() - began:.0f} s, {how}", flush=True)


if __name__ == "__main__":
    main()
