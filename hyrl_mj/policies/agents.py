"""Agents that were trained elsewhere: SB3 zips, ONNX files and the weights of a run, as policies."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadArtifact, BadInput, check_seed, unknown
from hyrl_mj.policies.activations import ACTIVATIONS
from hyrl_mj.policies.functions import from_onnx
from hyrl_mj.policies.mlp import MlpPolicy, ObservationPolicy, SampledPolicy
from hyrl_mj.policies.sb3_zip import REMEDY, from_tensors, read_zip
from hyrl_mj.tasks import Task


def load_agent(
    path: str | Path,
    task: Task,
    activation: str | None = None,
    stochastic: bool = False,
    seed: int = 0,
) -> ObservationPolicy:
    """Reads a trained agent as a policy: an SB3 zip, an `.onnx` file, or a `policy.safetensors` of a run.

    Zips are those that `model.save` writes for PPO, A2C, DQN, SAC, TD3 and DDPG with an MLP policy, also by
    SB3 1.x. Nothing in them is executed, and every member but `policy.pth` may be missing. The agent must
    have learned on the task's own observation, in its order and scale: the statistics of `VecNormalize` are
    in another file and are not applied. Spaces come from the task: inputs of TD3, DDPG and SAC are stretched
    to its limits. A policy class that overrides `forward` is not recognised, and acts as SB3's own.

    An ONNX model has one input, observations (n, k) float32, and as its first output inputs (n, m) in the
    plant's units; for a discrete task preferences (n, levels) or integers (n,).

    A `.safetensors` file is one that `MlpPolicy.save` wrote, with its description beside it.

    Args:
        path: the file.
        task: the task on which the policy acts.
        activation: the function between the layers, one of `hyrl_mj.policies.ACTIVATIONS`, for a zip that
            does not name it; by default SB3's: "tanh" for PPO and A2C, "relu" for the others.
        stochastic: draw from the policy's distribution instead of acting by its mean or mode (PPO, A2C,
            SAC). Such a policy is reproducible call by call only.
        seed: the seed of these draws.

    Returns:
        A `FunctionPolicy` for an `.onnx` file, else an `MlpPolicy` or `SampledPolicy`.

    Raises:
        BadInput: an unknown activation, a bad seed, or a policy without a distribution to draw from.
        BadArtifact: a file that is no such agent, or one that does not fit the task.
    """
    path = Path(path)
    if activation is not None and activation not in ACTIVATIONS:
        raise unknown("activation", activation, ACTIVATIONS)
    check_seed(seed)
    if path.suffix == ".onnx":
        if stochastic or activation is not None:
            raise BadInput("an .onnx file acts as it is: give neither an activation nor stochastic")
        return from_onnx(path, task, REMEDY)
    if path.suffix == ".safetensors":
        policy = MlpPolicy.load(path)
        if policy.task.name != task.name:
            raise BadArtifact(
                f"{path} is a policy for {policy.task.name}: {task.name} needs its own"
            )
        if activation not in (None, policy.activation):
            raise BadArtifact(
                f"{path} has activation {policy.activation!r}: leave the activation out"
            )
    else:
        with artifacts.reading(path, REMEDY):
            weights, about = read_zip(path)
            policy = from_tensors(weights, about, task, activation)
    return SampledPolicy(policy, np.random.default_rng(seed)) if stochastic else policy
