"""Policies that remember: the last observations, or the state of a recurrent network, trained under noise."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from stable_baselines3.common.vec_env import VecFrameStack

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, Unfit, register
from hyrl_mj.alternatives.training import environment, learned
from hyrl_mj.learning.training import export
from hyrl_mj.policies import PreprocessedPolicy, Preprocessing, from_callable


@register
class FrameStack(Alternative):
    """PPO on the last 4 observations, trained under uniform noise."""

    name = "stack"
    title = "frame stack"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        length = 4

        def policy(model: Any) -> PreprocessedPolicy:
            network = export(model, given.task, length)
            return PreprocessedPolicy(network, Preprocessing(n_stack=length))

        env = VecFrameStack(environment(given, "uniform"), length)
        model = learned(given, env, policy)
        yield Candidate(f"{length} observations", policy(model), given.samples)


@register
class Recurrent(Alternative):
    """RecurrentPPO (an LSTM of 64 cells), trained under uniform noise."""

    name = "recurrent"
    title = "recurrent"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        try:
            from sb3_contrib import RecurrentPPO
        except ImportError:
            raise Unfit("sb3-contrib is missing: pip install sb3-contrib") from None

        hidden = given.training("ppo").hidden
        model = learned(
            given,
            environment(given, "uniform"),
            partial(from_callable, task=given.task),
            policy="MlpLstmPolicy",
            algorithm=RecurrentPPO,
            net_arch=list(hidden[:1]),
            lstm_hidden_size=64,
        )
        yield Candidate("64 cells", from_callable(model, given.task), given.samples)
