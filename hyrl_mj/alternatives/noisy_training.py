"""Policies that are trained under measurement noise."""

from __future__ import annotations

from collections.abc import Iterator

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, register
from hyrl_mj.learning import Training
from hyrl_mj.learning.training import Score, TaskGround, train
from hyrl_mj.policies import MlpPolicy


class NoisyGround(TaskGround):
    """All starts of a task under noise, by which policies are judged, too."""

    def __init__(self, given: Given, settings: Training, kind: str):
        super().__init__(given.task, settings)
        self.noise, self._given, self._kind = given.noise(kind), given, kind

    def __call__(self, policy: MlpPolicy) -> Score:
        """Returns the share of starts won under noise, then the score without noise."""
        return self._given.won(policy, (self._kind,)), *super().__call__(policy)


@register
class TrainedUnderNoise(Alternative):
    """The policy of stage 1, trained under uniform, alternating or constant noise."""

    name = "noise"
    title = "trained under noise"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        settings = given.training()
        for kind in ("uniform", "alternating", "bias"):
            ground = NoisyGround(given, settings, kind)
            policy = train(
                given.task, settings, given.seed, ground=ground, label=f"under {kind} noise"
            )
            yield Candidate(f"{kind} noise", policy, settings.samples)
