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
from hyrl_mj.tasks import Task

# What the mirror does to what a network sees, (k,) signs, and to what it says, a (m, m) matrix.
Signs = torch.Tensor | None
Turn = torch.Tensor | None


def impose(policy: Any, task: Task) -> None:
    """Make the networks of an SB3 MLP policy respect `task.mirror`: actors, critics and their targets.

    Args:
        policy: an SB3 policy; its weights stay, and so do their names.
        task: a task with a mirror symmetry.
    """
    for name, (signs, turn) in _layers(policy, task).items():
        layer = policy.get_submodule(name)
        if signs is not None:
            layer.register_forward_pre_hook(partial(_see_both, signs))
        if turn is not None:
            layer.register_forward_hook(partial(_average, turn))
    policy.symmetric = True


def plain_state(policy: Any, task: Task) -> dict[str, torch.Tensor]:
    """The state dict of an SB3 policy as a plain network; of twice the width if it was made symmetric."""
    state: dict[str, torch.Tensor] = policy.state_dict()
    if not getattr(policy, "symmetric", False):
        return state
    for name, (signs, turn) in _layers(policy, task).items():
        weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
        if signs is not None:
            wide, bias = torch.cat([weight, weight * signs]), bias.repeat(2)
        elif turn is not None:
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


def _layers(policy: Any, task: Task) -> dict[str, tuple[Signs, Turn]]:
    """Of each linear layer by name: how the mirror turns what its network sees, if it is the first one, and
    what its network says, if it is the last one."""
    assert task.mirror is not None
    seen = torch.tensor(task.mirror.observation, dtype=torch.float32)
    # Critics see the inputs, too, stretched to lie between -1 and 1.
    seen_by_critic = torch.tensor(task.mirror.observation + task.mirror.inputs, dtype=torch.float32)
    turn = torch.tensor(_turn(task), dtype=torch.float32)
    linear = {n: layer for n, layer in policy.named_modules() if isinstance(layer, nn.Linear)}
    critics = {n.rpartition(".")[0] + "." for n in linear if n.startswith("critic")}
    found: dict[str, tuple[Signs, Turn]] = {}
    for parts, signs, says in (
        (("q_net.",), seen, turn),
        (("q_net_target.",), seen, turn),
        (("mlp_extractor.policy_net.", "action_net"), seen, turn),
        (("mlp_extractor.value_net.", "value_net"), seen, None),
        (("actor.latent_pi.", "actor.mu"), seen, turn),
        (("actor.log_std",), None, None),  # beside the mean, on the same hidden layers
        (("actor_target.",), seen, turn),
        *(((critic,), seen_by_critic, None) for critic in critics),
    ):
        names = [name for name in linear if name.startswith(parts)]
        for name in names:
            same = torch.eye(linear[name].out_features) if says is None else says
            found[name] = (
                signs if name == names[0] else None,
                same if name == names[-1] else None,
            )
    return found


def _see_both(signs: torch.Tensor, layer: nn.Module, given: tuple[torch.Tensor]) -> torch.Tensor:
    """(n, k) observations -> (2 n, k): they and their mirror images."""
    return torch.cat([given[0], given[0] * signs])


def _average(
    turn: torch.Tensor, layer: nn.Module, given: tuple[torch.Tensor], output: torch.Tensor
) -> torch.Tensor:
    """(2 n, k) outputs -> (n, k): the mean of the first half and the second, mirrored."""
    straight, image = output.chunk(2)
    return (straight + image @ turn.T) / 2
