"""Policies whose training is penalised for changing their inputs quickly."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import RolloutBufferSamples

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, register
from hyrl_mj.alternatives.training import environment, learned
from hyrl_mj.learning.training import export

# The coefficient of SB3's entropy bonus where a task has none: the penalty is part of that term.
LEAST_BONUS = 1e-4
Kind = Literal["CAPS", "Lipschitz"]


class PairedBuffer(RolloutBuffer):
    """A buffer whose observations (n, 2 k) are each followed by the next one of the episode."""

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        if not self.generator_ready:
            now = np.asarray(self.observations)  # type: ignore[has-type]
            then = np.concatenate([now[1:], now[-1:]])
            last = np.concatenate([self.episode_starts[1:], self.episode_starts[-1:]]) == 1
            last[-1] = True
            then = np.where(last[..., None], now, then)
            self.observations = np.concatenate([now, then], axis=2)
        yield from super().get(batch_size)


class SmoothPolicy(ActorCriticPolicy):
    """SB3's policy, whose bonus for entropy is less a penalty for changes of its mean input.

    CAPS (Mysore et al. 2021, arXiv:2012.06644): the distance between the means at an observation and at the
    next one, and between those at an observation and at one beside it, drawn with a deviation. Lipschitz: the
    square of the mean's derivative along a direction that is drawn.
    """

    def __init__(self, *args: Any, kind: Kind, weight: float, deviation: float, **kwargs: Any):
        self.kind, self.weight, self.deviation = kind, weight, deviation
        super().__init__(*args, **kwargs)

    def evaluate_actions(self, obs: Any, actions: torch.Tensor) -> Any:
        now, then = obs.chunk(2, dim=1)
        values, log_prob, entropy = super().evaluate_actions(now, actions)
        if self.kind == "CAPS":
            beside = now + self.deviation * torch.randn_like(now)
            mean = self._mean(now)
            change = (mean - self._mean(then)).norm(dim=1) + (mean - self._mean(beside)).norm(dim=1)
        else:
            step = 1e-2 * torch.nn.functional.normalize(torch.randn_like(now), dim=1)
            slope = (self._mean(now + step) - self._mean(now)).norm(dim=1) / 1e-2
            change = slope**2
        bonus = 0.0 if entropy is None else entropy
        return values, log_prob, bonus - self.weight * change

    def _mean(self, obs: torch.Tensor) -> torch.Tensor:
        """Returns the mean inputs (n, m), or the probabilities of the levels (n, L)."""
        distribution = self.get_distribution(obs).distribution
        if isinstance(distribution, torch.distributions.Categorical):
            return distribution.probs
        return distribution.mean


@register
class Smooth(Alternative):
    """PPO with a penalty for changes of the input, by CAPS or of the policy's slope."""

    name = "smooth"
    title = "smooth (CAPS, Lipschitz)"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        task = given.task
        bonus = max(given.training("ppo").options.get("ent_coef", 0.0), LEAST_BONUS)

        kinds: tuple[tuple[Kind, float], ...] = (
            ("CAPS", 0.01), ("CAPS", 0.1), ("Lipschitz", 1e-4), ("Lipschitz", 1e-2),
        )  # fmt: skip
        for kind, weight in kinds:
            model = learned(
                given,
                environment(given),
                partial(export, task=task),
                policy=SmoothPolicy,
                kind=kind,
                weight=weight / bonus,
                deviation=given.eps,
                options={"ent_coef": bonus, "rollout_buffer_class": PairedBuffer},
            )
            yield Candidate(f"{kind}, weight {weight:g}", export(model, task), given.samples)
