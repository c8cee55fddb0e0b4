"""Trainings of SB3's PPO that stage 1 has not: other policies, other buffers, and with a memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from hyrl_mj.alternatives.base import Given
from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.learning.training import TaskGround, spread_kinks, threads, with_settings
from hyrl_mj.policies import Controller, Policy
from hyrl_mj.simulation import AnyNoise

# The kinds of noise by which checkpoints are judged: the worse of the two counts.
JUDGED = ("uniform", "alternating")


def environment(given: Given, noise: str | AnyNoise = "none") -> TaskVecEnv:
    """Returns the episodes of a training under noise, or a kind of it, as stage 1 has them."""
    settings = given.training("ppo")
    noise = given.noise(noise) if isinstance(noise, str) else noise
    paid = TaskGround(given.task, replace(settings, rehearse=0.0)).domain(settings.gamma)
    core = BatchedEnv(
        given.task, settings.envs, noise=noise, domain=paid, max_steps=settings.episode
    )
    return TaskVecEnv(core)


def learned(
    given: Given,
    env: VecEnv,
    acting: Callable[[Any], Controller | Policy],
    *,
    policy: str | type[Any] = "MlpPolicy",
    algorithm: type[BaseAlgorithm] = PPO,
    samples: int = 0,
    start: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] = MappingProxyType({}),
    **of_policy: Any,
) -> Any:
    """Returns a model that was trained, with the weights of its best checkpoint.

    Its settings are those of PPO in stage 1 but for the symmetry of the network and the episodes that start
    anywhere, and all samples have as many checkpoints.

    Args:
        given: what may be used.
        env: the episodes.
        acting: returns what a model is judged by: a policy, or a controller.
        policy: SB3's policy.
        algorithm: SB3's algorithm, with the interface of PPO's.
        samples: of the training, by default all.
        start: weights to begin with, by default new ones.
        options: arguments of the algorithm to change.
        of_policy: arguments of the policy to change.

    Raises:
        BadInput: the training broke off.
    """
    settings, best = given.training("ppo"), _Best(given, acting)
    arguments = {**settings.options, **options}
    with threads(1):  # faster for small networks
        model = with_settings(algorithm, policy, env, settings, given.seed, of_policy, arguments)
        if settings.spread and start is None:
            spread_kinks(model.policy, given.task, given.seed)
        if start is not None:
            model.policy.load_state_dict(start)
        try:
            model.learn(samples or settings.samples, callback=best)
        except (HyrlError, OSError):
            raise
        except Exception as error:  # of SB3 or torch, as of weights that are not finite
            raise BadInput(
                f"its training broke off after {model.num_timesteps:,} samples ({brief(error)})"
            ) from error
    model.policy.load_state_dict(best.state)
    return model


class _Best(BaseCallback):
    """Keeps the weights of the best checkpoint."""

    def __init__(self, given: Given, acting: Callable[[Any], Controller | Policy]):
        super().__init__()
        self._given, self._acting = given, acting
        self._won, self.state = -1.0, {}  # type: float, dict[str, Any]
        self._every = max(given.samples // given.task.effort.checkpoints, 1)
        self._next = self._every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self._every
            self._judge()
        return True

    def _on_training_end(self) -> None:
        self._judge()

    def _judge(self) -> None:
        won = self._given.won(self._acting(self.model), JUDGED)
        if won >= self._won:  # of equally good ones the latest
            tensors = self.model.policy.state_dict()
            self._won, self.state = won, {name: value.clone() for name, value in tensors.items()}
