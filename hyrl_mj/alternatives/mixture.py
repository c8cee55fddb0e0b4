"""One stochastic policy of several components, of which one is taken."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, register
from hyrl_mj.alternatives.training import environment, learned
from hyrl_mj.tasks import Task, at_levels

COMPONENTS = 2


class Mixture(Distribution):
    """A mixture of Gaussians, or of categorical distributions over levels, for SB3."""

    distribution: torch.distributions.MixtureSameFamily

    def __init__(self, size: int, levels: bool):
        super().__init__()
        self.size, self.levels = size, levels

    def proba_distribution_net(self, *args: Any, **kwargs: Any) -> torch.nn.Linear:
        """Returns the last layer: the logits of the gate, then those or the means of each component."""
        return torch.nn.Linear(kwargs["latent_dim"], COMPONENTS * (1 + self.size))

    def proba_distribution(self, *args: Any, **kwargs: Any) -> Mixture:
        """Takes the outputs of the last layer (n, K (1 + size)), and the logarithm of the deviation."""
        gate, parts = self.parts(kwargs["outputs"])
        component: torch.distributions.Distribution
        if self.levels:
            component = torch.distributions.Categorical(logits=parts)
        else:
            normal = torch.distributions.Normal(parts, kwargs["log_std"].exp())
            component = torch.distributions.Independent(normal, 1)
        chosen = torch.distributions.Categorical(logits=gate)
        self.distribution = torch.distributions.MixtureSameFamily(chosen, component)
        return self

    def parts(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the gate's logits (n, K), and the logits or means of the components (n, K, size)."""
        gate, parts = outputs.split([COMPONENTS, COMPONENTS * self.size], dim=1)
        return gate, parts.reshape(-1, COMPONENTS, self.size)

    def log_prob(self, x: torch.Tensor) -> torch.Tensor:
        return self.distribution.log_prob(x)

    def entropy(self) -> None:
        """Returns None: it has no closed form, and SB3 estimates it by the actions."""

    def sample(self) -> torch.Tensor:
        return self.distribution.sample()

    def mode(self) -> torch.Tensor:
        best = self.distribution.mixture_distribution.probs.argmax(dim=1)
        component: Any = self.distribution.component_distribution
        every = component.probs.argmax(dim=2) if self.levels else component.base_dist.mean
        return every[torch.arange(len(best)), best]

    def actions_from_params(self, *args: Any, **kwargs: Any) -> Any:
        raise NotImplementedError  # SB3's base class asks for it, and calls it nowhere

    log_prob_from_params = actions_from_params


class MixturePolicy(ActorCriticPolicy):
    """SB3's policy, whose actions come from a mixture."""

    action_net: torch.nn.Linear

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        space: Any = self.action_space
        levels = hasattr(space, "n")
        self.mixture = Mixture(int(space.n) if levels else space.shape[0], levels)
        self.action_net = self.mixture.proba_distribution_net(
            latent_dim=self.mlp_extractor.latent_dim_pi
        )
        # Nearly equal components at first, which noise in the weights tells apart.
        torch.nn.init.orthogonal_(self.action_net.weight, gain=0.1)
        self.optimizer = self.optimizer_class(
            self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs
        )

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Mixture:
        log_std = getattr(self, "log_std", None)
        return self.mixture.proba_distribution(outputs=self.action_net(latent_pi), log_std=log_std)

    def outputs(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the gate's logits (n, K), and what the components do: levels (n, K), or means (n, K, m)."""
        with torch.no_grad():
            obs = torch.as_tensor(observation, dtype=torch.float32)
            latent = self.mlp_extractor.forward_actor(self.extract_features(obs))
            gate, parts = self.mixture.parts(self.action_net(latent))
        found = parts.argmax(dim=2) if self.mixture.levels else parts
        return gate.numpy(), found.numpy()


@dataclass(frozen=True)
class MixtureController:
    """A mixture as a controller whose mode is the component.

    Attributes:
        task: gives observations and inputs.
        policy: the mixture.
        held: whether the component of the first measurement is kept for the whole episode, or the most
            probable one is taken at each sample.
    """

    task: Task
    policy: MixturePolicy
    held: bool

    @property
    def modes(self) -> tuple[int, ...]:
        return tuple(range(COMPONENTS if self.held else 1))

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        if not self.held:
            return np.zeros(len(measured), dtype=int)
        return self.policy.outputs(self.task.observation(measured))[0].argmax(axis=1)

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gate, parts = self.policy.outputs(self.task.observation(measured))
        actions = parts[np.arange(len(q)), q if self.held else gate.argmax(axis=1)]
        if self.task.input_levels is not None:
            return at_levels(self.task, actions), q
        return np.clip(actions.astype(float), *self.task.input_limits), q


@register
class MixtureOfPolicies(Alternative):
    """PPO with two components and a gate (after MUPO, Zou et al. 2024, arXiv:2403.12847): the most probable
    component at each sample, or that of the first measurement for the whole episode."""

    name = "mixture"
    title = "mixture of two"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        task = given.task

        def controller(model: Any, held: bool = False) -> MixtureController:
            return MixtureController(task, model.policy, held)

        model = learned(given, environment(given), controller, policy=MixturePolicy)
        for held in (False, True):
            label = "held for the episode" if held else "at each sample"
            yield Candidate(label, controller(model, held), given.samples)
