"""Policies that remember: the last observations, or the state of a recurrent network, trained under noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecFrameStack

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, Unfit, register
from hyrl_mj.alternatives.training import environment, learned
from hyrl_mj.policies import PolicyController, from_callable


@dataclass(frozen=True)
class Stacked:
    """A model on the last observations, zeros before the first, as SB3's `VecFrameStack` gives them.

    Attributes:
        model: SB3's model.
        length: the number of observations.
        size: the length of one.
    """

    model: Any
    length: int
    size: int

    def start(self, n: int) -> np.ndarray:
        return np.zeros((n, (self.length - 1) * self.size))

    def act(self, memory: np.ndarray, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        frames = np.hstack([memory, observation])
        actions, _ = self.model.predict(frames.astype(np.float32), deterministic=True)
        return actions, frames[:, self.size :]


@register
class FrameStack(Alternative):
    """The last observations."""

    name = "stack"
    title = "frame stack"
    sentence = "PPO on the last 4 observations, trained under uniform noise."

    def candidates(self, given: Given) -> Iterator[Candidate]:
        length, size = 4, len(given.task.observation_low)

        def controller(model: Any) -> PolicyController:
            return PolicyController(from_callable(Stacked(model, length, size), given.task))

        env = VecFrameStack(environment(given, "uniform"), length)
        model = learned(given, env, controller)
        yield Candidate(f"{length} observations", controller(model), given.samples)


@register
class Recurrent(Alternative):
    """A recurrent network."""

    name = "recurrent"
    title = "recurrent"
    sentence = "RecurrentPPO (an LSTM of 64 cells), trained under uniform noise."

    def candidates(self, given: Given) -> Iterator[Candidate]:
        try:
            from sb3_contrib import RecurrentPPO
        except ImportError:
            raise Unfit("sb3-contrib is missing: pip install sb3-contrib") from None

        def controller(model: Any) -> PolicyController:
            return PolicyController(from_callable(model, given.task))

        hidden = given.training("ppo").hidden
        model = learned(
            given,
            environment(given, "uniform"),
            controller,
            policy="MlpLstmPolicy",
            algorithm=RecurrentPPO,
            net_arch=list(hidden[:1]),
            lstm_hidden_size=64,
        )
        yield Candidate("64 cells", controller(model), given.samples)
