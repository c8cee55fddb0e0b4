"""A task's mirror symmetry: networks that respect it while they learn, and policies seen in the mirror.

The rewards of HyRL's problems are symmetric with respect to a hyperplane (paper, Section IV-B), and at
the start the two ways past an obstacle differ by a thousandth of the return: less than the error of a
freely trained network, which then decides at an arbitrary place. Here a network f sees the observation o
and its mirror image S o in one batch, and answers with the mean of f(o) and the mirrored f(S o). That is a
plain network of twice the width, whose two halves have the same weights.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from hyrl_mj.policies import MlpPolicy
from hyrl_mj.tasks.base import Task


def impose(policy: Any, task: Task) -> None:
    """Make the networks of an SB3 MLP policy (PPO or DQN) respect `task.mirror`.

    Args:
        policy: an SB3 policy; its weights stay, and so do their names.
        task: a task with a mirror symmetry.
    """
    assert task.mirror is not None
    signs = torch.tensor(task.mirror.observation, dtype=torch.float32)
    for names, turn in _networks(policy, task):
        first, last = policy.get_submodule(names[0]), policy.get_submodule(names[-1])
        first.register_forward_pre_hook(partial(_see_both, signs))
        last.register_forward_hook(partial(_average, turn))
    policy.symmetric = True


def plain_state(policy: Any, task: Task) -> dict[str, torch.Tensor]:
    """The state dict of an SB3 policy as a plain network; of twice the width if it was made symmetric."""
    state: dict[str, torch.Tensor] = policy.state_dict()
    if not getattr(policy, "symmetric", False):
        return state
    assert task.mirror is not None
    signs = torch.tensor(task.mirror.observation, dtype=torch.float32)
    for names, turn in _networks(policy, task):
        for name in names:
            weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
            if name == names[0]:
                wide, bias = torch.cat([weight, weight * signs]), bias.repeat(2)
            elif name == names[-1]:
                wide = torch.cat([weight, turn @ weight], dim=1) / 2
                bias = (bias + turn @ bias) / 2
            else:
                wide, bias = torch.block_diag(weight, weight), bias.repeat(2)
            state[f"{name}.weight"], state[f"{name}.bias"] = wide, bias
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


def _networks(policy: Any, task: Task) -> list[tuple[list[str], torch.Tensor]]:
    """Of each network: the names of its linear layers, in order, and what the mirror does to its output."""
    linear = [name for name, layer in policy.named_modules() if isinstance(layer, nn.Linear)]
    turn = torch.tensor(_turn(task), dtype=torch.float32)
    parts: dict[tuple[str, ...], torch.Tensor]
    if hasattr(policy, "q_net"):
        parts = {("q_net.",): turn, ("q_net_target.",): turn}
    else:
        parts = {
            ("mlp_extractor.policy_net", "action_net"): turn,
            ("mlp_extractor.value_net", "value_net"): torch.eye(1),
        }
    return [([n for n in linear if n.startswith(part)], turn) for part, turn in parts.items()]


def _see_both(signs: torch.Tensor, layer: nn.Module, given: tuple[torch.Tensor]) -> torch.Tensor:
    """(n, k) observations -> (2 n, k): they and their mirror images."""
    return torch.cat([given[0], given[0] * signs])


def _average(
    turn: torch.Tensor, layer: nn.Module, given: tuple[torch.Tensor], output: torch.Tensor
) -> torch.Tensor:
    """(2 n, k) outputs -> (n, k): the mean of the first half and the second, mirrored."""
    straight, image = output.chunk(2)
    return (straight + image @ turn.T) / 2
