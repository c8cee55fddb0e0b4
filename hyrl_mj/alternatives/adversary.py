"""A policy that is trained against an adversary, who learns to show it the worst noise."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, register
from hyrl_mj.alternatives.training import environment, learned
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.learning.training import export, threads
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.simulation import Sample, Signal
from hyrl_mj.tasks import Task


@register
class TrainedAgainstAdversary(Alternative):
    """Policy and an adversary who adds the noise learn by turns (ATLA, Zhang et al. 2021,
    arXiv:2101.08452)."""

    name = "adversary"
    title = "trained against an adversary"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        for turns in (2, 4):
            yield Candidate(f"{turns} turns", _by_turns(given, turns), given.samples)


def _by_turns(given: Given, turns: int) -> MlpPolicy:
    """Returns a policy that was trained against as many adversaries, with all samples together.

    The first turn of the policy is without noise. Each turn of policy or adversary has as many samples.
    """
    share = given.samples // (2 * turns + 1)

    def policy(model: Any) -> MlpPolicy:
        return export(model, given.task)

    model = learned(given, environment(given), policy, samples=share)
    for turn in range(turns):
        adversary = train_adversary(given, policy(model), share, turn)
        env, start = environment(given, adversary), model.policy.state_dict()
        model = learned(given, env, policy, samples=share, start=start)
    return policy(model)


class LearnedNoise(Signal):
    """Noise that a network shows, from the true observation.

    Args:
        bound, shares: as of `Signal`.
        task: the task.
        model: SB3's model, whose actions lie between -1 and 1.
        columns: the noisy columns of the measurement.
    """

    kind = "learned"

    def __init__(
        self, bound: float, shares: np.ndarray, task: Task, model: object, columns: np.ndarray
    ):
        super().__init__(bound, shares)
        self.task, self.model, self.columns = task, model, columns

    def sample(self, now: Sample) -> np.ndarray:
        observation = self.task.observation(now.measurement).astype(np.float32)
        actions, _ = self.model.predict(observation, deterministic=True)  # type: ignore[attr-defined]
        noise = np.zeros_like(now.measurement)
        noise[:, self.columns] = np.clip(actions, -1, 1) * self.limits[self.columns]
        return noise


class _AdversaryEnv(TaskVecEnv):
    """The noise is the action, the truth is observed, and the rewards are those of the policy, negated."""

    def __init__(self, core: BatchedEnv, policy: MlpPolicy, limits: np.ndarray):
        super().__init__(core)
        self._policy, self._limits = policy, limits
        self._columns = np.flatnonzero(limits)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(self._columns),), np.float32)

    def step_async(self, actions: np.ndarray) -> None:
        noise = np.zeros_like(self.core.measured)
        noise[:, self._columns] = np.clip(actions, -1, 1) * self._limits[self._columns]
        plant = self.core.plant
        rows = np.arange(self.core.n)
        self._actions = self._policy.act(plant.observe(plant.truth(rows), noise, rows))

    def step_wait(self) -> VecEnvStepReturn:
        observation, reward, done, infos = super().step_wait()
        return observation, -reward, done, infos


def train_adversary(given: Given, policy: MlpPolicy, samples: int, turn: int) -> LearnedNoise:
    """Returns noise that was trained with so many samples to make a policy earn little."""
    task, settings = given.task, given.training("ppo")
    shares = given.noise("uniform").against(task, None).shares
    limits = given.eps * np.abs(shares)
    model = PPO(
        "MlpPolicy",
        _AdversaryEnv(environment(given).core, policy, limits),
        seed=given.seed + turn,
        device="cpu",
        gamma=settings.gamma,
        learning_rate=settings.learning_rate,
        policy_kwargs={"net_arch": list(settings.hidden)},
        **settings.options,
    )
    with threads(1):  # faster for small networks
        model.learn(samples)
    return LearnedNoise(given.eps, shares, task, model, np.flatnonzero(limits))
