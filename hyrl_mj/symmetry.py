"""A task's mirror symmetry: networks that respect it while they learn, and policies seen in the mirror.

The rewards of HyRL's problems are symmetric with respect to a hyperplane (paper, Section IV-B), and at
the start the two ways past an obstacle differ by a thousandth of the return: less than the error of a
freely trained network, which then decides at an arbitrary place. Here every layer holds two copies of
the same weights, one that looks at the observation o and one at its mirror image S o; the output averages
the first with the mirrored second. The result is a plain network of twice the width.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.utils import parametrize

from hyrl_mj.policies import MlpPolicy
from hyrl_mj.tasks.base import Task


def impose(policy: Any, task: Task) -> None:
    """Tie the weights of an SB3 MLP policy (PPO or DQN) so that it respects `task.mirror`.

    Args:
        policy: an SB3 policy whose hidden layers have even width.
        task: a task with a mirror symmetry.
    """
    assert task.mirror is not None
    signs = torch.tensor(task.mirror.observation, dtype=torch.float32)
    turn = torch.tensor(_turn(task), dtype=torch.float32)
    values = hasattr(policy, "q_net")
    if values:
        for network in (policy.q_net.q_net, policy.q_net_target.q_net):
            _tie([*network], signs, turn)
    else:
        _tie([*policy.mlp_extractor.policy_net, policy.action_net], signs, turn)
        _tie([*policy.mlp_extractor.value_net, policy.value_net], signs, torch.eye(1))
    rate = policy.optimizer.param_groups[0]["lr"]
    trained = policy.q_net if values else policy
    policy.optimizer = policy.optimizer_class(
        trained.parameters(), lr=rate, **policy.optimizer_kwargs
    )


def plain_state(policy: nn.Module) -> dict[str, torch.Tensor]:
    """The state dict of a policy with the tied weights written out."""
    state: dict[str, torch.Tensor] = {}
    for name, module in policy.named_modules():
        if isinstance(module, nn.Linear):
            state |= {f"{name}.weight": module.weight, f"{name}.bias": module.bias}
    for name, tensor in policy.state_dict().items():
        if "parametrizations" not in name:
            state.setdefault(name, tensor)
    return state


def mirrored(policy: MlpPolicy) -> MlpPolicy:
    """The policy that does at a mirrored observation what this one does at the observation, mirrored."""
    task = policy.task
    assert task.mirror is not None
    signs, turn = np.array(task.mirror.observation), _turn(task)
    values = [f"{net}.{2 * len(policy.hidden)}" for net in ("q_net.q_net", "q_net_target.q_net")]
    weights = {}
    for name, weight in policy.weights.items():
        if name.endswith(".0.weight"):
            weight = weight * signs
        if name.rpartition(".")[0] in ("action_net", *values):
            weight = turn @ weight
        weights[name] = weight.astype(np.float32)
    return replace(policy, weights=weights)


def _turn(task: Task) -> np.ndarray:
    """(k, k) matrix that mirrors a network's outputs: inputs, or preferences of the levels."""
    assert task.mirror is not None
    if task.input_levels is None:
        return np.diag(task.mirror.inputs)
    images = task.input_levels * task.mirror.inputs
    pairs = np.abs(task.input_levels[:, None] - images[None]).sum(axis=-1).argmin(axis=1)
    return np.eye(len(pairs))[pairs]


def _tie(layers: list[nn.Module], signs: torch.Tensor, turn: torch.Tensor) -> None:
    """Tie the linear layers of one network from observation to output."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    first, *middle, last = linear
    parametrize.register_parametrization(first, "weight", _First(signs))
    for layer in middle:
        parametrize.register_parametrization(layer, "weight", _Middle())
    for layer in (first, *middle):
        parametrize.register_parametrization(layer, "bias", _Twice())
    parametrize.register_parametrization(last, "weight", _Last(turn))
    parametrize.register_parametrization(last, "bias", _Average(turn))


class _First(nn.Module):
    """(h, o) -> (2 h, o): the first half sees o, the second S o."""

    def __init__(self, signs: torch.Tensor):
        super().__init__()
        self._signs = signs

    def forward(self, half: torch.Tensor) -> torch.Tensor:
        return torch.cat([half, half * self._signs])

    def right_inverse(self, whole: torch.Tensor) -> torch.Tensor:
        return whole[: len(whole) // 2].clone()


class _Middle(nn.Module):
    """(h, g) -> (2 h, 2 g): each half goes on by itself."""

    def forward(self, half: torch.Tensor) -> torch.Tensor:
        return torch.block_diag(half, half)

    def right_inverse(self, whole: torch.Tensor) -> torch.Tensor:
        return whole[: whole.shape[0] // 2, : whole.shape[1] // 2].clone()


class _Twice(nn.Module):
    """(h,) -> (2 h,)."""

    def forward(self, half: torch.Tensor) -> torch.Tensor:
        return torch.cat([half, half])

    def right_inverse(self, whole: torch.Tensor) -> torch.Tensor:
        return whole[: len(whole) // 2].clone()


class _Last(nn.Module):
    """(k, h) -> (k, 2 h): the mean of the first half's output and the second's, mirrored."""

    def __init__(self, turn: torch.Tensor):
        super().__init__()
        self._turn = turn

    def forward(self, half: torch.Tensor) -> torch.Tensor:
        return torch.cat([half, self._turn @ half], dim=1) / 2

    def right_inverse(self, whole: torch.Tensor) -> torch.Tensor:
        return whole[:, : whole.shape[1] // 2].clone()


class _Average(nn.Module):
    """(k,) -> (k,): the mean of a bias and its mirror image."""

    def __init__(self, turn: torch.Tensor):
        super().__init__()
        self._turn = turn

    def forward(self, bias: torch.Tensor) -> torch.Tensor:
        return (bias + self._turn @ bias) / 2

    def right_inverse(self, whole: torch.Tensor) -> torch.Tensor:
        return whole.clone()
