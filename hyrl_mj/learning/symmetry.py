"""A task's mirror symmetry: networks that respect it while they learn, and mirrored policies.

The rewards of HyRL's problems are symmetric with respect to a hyperplane (paper, Section IV-B), and at
the start the returns of the two ways past an obstacle differ by a thousandth. That is less than the error of
a freely trained network, whose critical points then lie at an arbitrary place. Here a network f gets the
observation o and its mirror image S o in one batch, and its output is the mean of f(o) and the mirrored
f(S o). This is a plain network of twice the width, whose two halves have the same weights.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from hyrl_mj.policies import MlpPolicy
from hyrl_mj.tasks import Task

# How the mirror changes a network's observation, (k,) signs, and its output, a (m, m) matrix.
Signs = torch.Tensor | None
Turn = torch.Tensor | None


def impose(policy: Any, task: Task) -> None:
    """Makes the networks of an SB3 MLP policy respect `task.mirror`: actors, critics and their targets.

    The weights and their names stay.
    """
    for name, (signs, turn) in _layers(policy, task).items():
        layer = policy.get_submodule(name)
        if signs is not None:
            layer.register_forward_pre_hook(partial(_see_both, signs))
        if turn is not None:
            layer.register_forward_hook(partial(_average, turn))
    policy.symmetric = True


def plain_state(policy: Any, task: Task) -> dict[str, torch.Tensor]:
    """Returns the state dict of an SB3 policy as a plain network, of twice the width if it is symmetric."""
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
    """Returns the mirrored policy: at a mirrored observation it gives this policy's input, mirrored."""
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
    """Returns the (k, k) matrix that mirrors a network's outputs: inputs, or values of the levels."""
    assert task.mirror is not None
    if task.input_levels is None:
        return np.diag(task.mirror.inputs)
    images = task.input_levels * task.mirror.inputs
    pairs = np.abs(task.input_levels[:, None] - images[None]).sum(axis=-1).argmin(axis=1)
    return np.eye(len(pairs))[pairs]


def _layers(policy: Any, task: Task) -> dict[str, tuple[Signs, Turn]]:
    """Returns, by name, each linear layer's signs (None unless it is first) and turn (None unless last)."""
    assert task.mirror is not None
    seen = torch.tensor(task.mirror.observation, dtype=torch.float32)
    # Critics get the inputs, too, scaled to -1..1.
    seen_by_critic = torch.tensor(task.mirror.observation + task.mirror.inputs, dtype=torch.float32)
    turn = torch.tensor(_turn(task), dtype=torch.float32)
    linear = {n: layer for n, layer in policy.named_modules() if isinstance(layer, nn.Linear)}
    critics = {n.rpartition(".")[0] + "." for n in linear if n.startswith("critic")}
    layers: dict[str, tuple[Signs, Turn]] = {}
    for parts, signs, output in (
        (("q_net.",), seen, turn),
        (("q_net_target.",), seen, turn),
        (("mlp_extractor.policy_net.", "action_net"), seen, turn),
        (("mlp_extractor.value_net.", "value_net"), seen, None),
        (("actor.latent_pi.", "actor.mu"), seen, turn),
        (("actor.log_std",), None, None),  # shares the hidden layers of the mean
        (("actor_target.",), seen, turn),
        *(((critic,), seen_by_critic, None) for critic in critics),
    ):
        names = [name for name in linear if name.startswith(parts)]
        for name in names:
            last = torch.eye(linear[name].out_features) if output is None else output
            layers[name] = signs if name == names[0] else None, last if name == names[-1] else None
    return layers


def _see_both(signs: torch.Tensor, layer: nn.Module, args: tuple[torch.Tensor]) -> torch.Tensor:
    """Returns (n, k) observations and their mirror images: (2 n, k)."""
    return torch.cat([args[0], args[0] * signs])


def _average(
    turn: torch.Tensor, layer: nn.Module, args: tuple[torch.Tensor], output: torch.Tensor
) -> torch.Tensor:
    """Returns the mean (n, k) of the first half of outputs (2 n, k) and the mirrored second half."""
    straight, image = output.chunk(2)
    return (straight + image @ turn.T) / 2
