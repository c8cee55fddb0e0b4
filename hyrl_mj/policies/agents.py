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
    """A trained agent as a policy: an SB3 zip, an `.onnx` file, or a `.safetensors` file of ours.

    Zips are those that `model.save` writes for PPO, A2C, DQN, SAC, TD3 and DDPG with an MLP policy, by
    SB3 1.x too. Nothing in them is executed, and all but `policy.pth` may be missing. The agent has to
    have learned on the task's own observation, in its order and scale: statistics of `VecNormalize` lie
    in another file and are not applied. Spaces come from the task: TD3, DDPG and SAC are stretched to
    its limits. A policy class with a `forward` of its own cannot be told from SB3's.

    An ONNX model has one input, observations (n, k) float32, and as its first output inputs (n, m) in the
    plant's units; for a discrete task preferences (n, levels) or integers (n,).

    A `.safetensors` file is what `MlpPolicy.save` wrote, with its description beside it.

    Args:
        path: the file.
        task: the task that it is to act on.
        activation: between the layers, one of `hyrl_mj.policies.mlp.ACTIVATIONS`, for a zip that does not
            say; by default SB3's: "tanh" for PPO and A2C, "relu" for the others.
        stochastic: draw from the policy's distribution instead of acting by its mean or mode (PPO, A2C,
            SAC). Such a policy is reproducible call by call only.
        seed: of these draws.

    Returns:
        A `FunctionPolicy` for an `.onnx` file, else an `MlpPolicy` or `SampledPolicy`.

    Raises:
        BadInput: an unknown activation, a bad seed, a policy that has nothing to draw from.
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
        policy = _from_safetensors(path, task, activation)
    else:
        with artifacts.reading(path, REMEDY):
            weights, about = read_zip(path)
            policy = from_tensors(weights, about, task, activation)
    return SampledPolicy(policy, np.random.default_rng(seed)) if stochastic else policy


def _from_safetensors(path: Path, task: Task, activation: str | None) -> MlpPolicy:
    """The policy that `MlpPolicy.save` wrote."""
    policy = MlpPolicy.load(path)
    if policy.task.name != task.name:
        raise BadArtifact(f"{path} is a policy for {policy.task.name}: {task.name} needs its own")
    if activation not in (None, policy.activation):
        raise BadArtifact(f"{path} has activation {policy.activation!r}: leave the activation out")
    return policy
