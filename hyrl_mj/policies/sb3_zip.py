"""Reads the policy of an SB3 agent from the zip that `model.save` wrote.

The file is data. torch's restricted unpickler reads the tensors, and a JSON parser the metadata. Nothing
else in the file is unpickled.
"""

import io
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile, ZipFile, is_zipfile

import numpy as np

from hyrl_mj.errors import BadArtifact
from hyrl_mj.policies.algorithms import ALGORITHMS
from hyrl_mj.policies.mlp import ACTIVATIONS, TORCH_NAMES, MlpPolicy, check_kind
from hyrl_mj.tasks import Task

REMEDY = "give the zip that SB3's model.save wrote, an .onnx file, or a policy.safetensors of a run"
# Limit on the unpacked size [bytes]: the largest MLP policies take a few megabytes.
LARGEST = 2**28
# Parts of tensor names of agents that are no plain MLPs on a vector, and what they mean.
FOREIGN = {
    "lstm": "it has a recurrent policy (lstm)",
    "features_extractor.extractors.": "its observations are a dict",
    "features_extractor.cnn.": "it has a CNN policy, which looks at images",
    "features_extractor.": "it has a features extractor of its own",
}


def read_zip(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns the tensors of an SB3 zip by name, and its metadata, {} if it has none."""
    if not is_zipfile(path):
        raise BadArtifact(f"it is not a zip: {REMEDY}")
    with ZipFile(path) as file:
        if "policy.pth" not in file.namelist():
            raise BadArtifact(f"it has no policy.pth, and so no weights: {REMEDY}")
        about = json.loads(_member(file, "data")) if "data" in file.namelist() else {}
        if not isinstance(about, dict):
            raise BadArtifact("its metadata is no JSON object")
        return _tensors(_member(file, "policy.pth")), about


def _member(file: ZipFile, name: str) -> bytes:
    """Returns the content of a member of a zip."""
    if file.getinfo(name).file_size > LARGEST:
        raise BadArtifact(f"its {name} is too large for an MLP policy")
    return file.read(name)


def _tensors(content: bytes) -> dict[str, np.ndarray]:
    """Returns the tensors of a `policy.pth`, by name."""
    import torch  # slow to import, and only needed here

    try:
        with ZipFile(io.BytesIO(content)) as inner:
            size = sum(info.file_size for info in inner.infolist())
    except BadZipFile:
        size = len(content)  # torch before 1.6 did not zip
    try:
        if size > LARGEST:
            raise BadArtifact("its policy.pth is too large for an MLP policy")
        # torch warns of unusual pickles, which are refused anyway.
        with warnings.catch_warnings(action="ignore"):
            state = torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
    except UnpicklingError as error:
        # torch's own message recommends to load it unsafely.
        raise BadArtifact(
            "its policy.pth is damaged or holds more than tensors, which an agent's never does: nothing in "
            "it was executed; get the file again from where the agent was trained"
        ) from error
    if not isinstance(state, Mapping):
        raise BadArtifact("its policy.pth holds no tensors by name")
    tensors = {
        str(name): tensor
        for name, tensor in state.items()
        if isinstance(tensor, torch.Tensor) and tensor.is_floating_point()
    }
    # Strides let a small file hold tensors of any size.
    if 4 * sum(tensor.numel() for tensor in tensors.values()) > LARGEST:
        raise BadArtifact("its policy.pth is too large for an MLP policy")
    return {
        name: tensor.detach().to(torch.float32).numpy().copy() for name, tensor in tensors.items()
    }


def from_tensors(
    weights: dict[str, np.ndarray], about: dict[str, Any], task: Task, activation: str | None
) -> MlpPolicy:
    """Returns the policy of an SB3 agent with these tensors and this metadata."""
    _check_plain(weights, about)
    algorithm = infer_algorithm(weights, about)
    if ALGORITHMS[algorithm].is_actor_critic:
        check_kind(task, levels="log_std" not in weights)
    for name, weight in weights.items():
        if not np.isfinite(weight).all():
            raise BadArtifact(f"its tensor {name} has weights that are not finite")
    activation = _activation(about, activation) or ALGORITHMS[algorithm].activation
    return MlpPolicy(task, algorithm, activation, weights)


def _check_plain(weights: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> None:
    """Raises `BadArtifact` if an agent is more than an MLP on a vector of numbers."""
    plain = "only plain multilayer perceptrons on a vector of numbers can be used"
    for part, what in FOREIGN.items():
        if any(part in name for name in weights):
            raise BadArtifact(f"{what}: {plain}")
    if "spaces.dict" in _entry(about, "observation_space", ":type:"):
        raise BadArtifact(f"its observations are a dict: {plain}")
    extractor = _entry(about, "policy_kwargs", "features_extractor_class")
    if extractor and "torch_layers.FlattenExtractor" not in extractor:
        raise BadArtifact(f"it has a features extractor of its own, {extractor}: {plain}")
    if "actor.log_std" in weights or np.ndim(weights.get("log_std", 0)) == 2:
        raise BadArtifact("it was trained with use_sde: train it without, or export it to .onnx")


def infer_algorithm(weights: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> str:
    """Returns the SB3 algorithm that trained an agent; "ppo" also for A2C if there is no metadata."""
    if any(name.startswith("q_net.q_net.") for name in weights):
        return "dqn"
    if "action_net.weight" in weights:
        return "a2c" if about and "clip_range" not in about else "ppo"
    if "actor.mu.weight" in weights:
        return "sac"
    if "actor.mu.0.weight" in weights:
        return "td3" if any(name.startswith("critic.qf1.") for name in weights) else "ddpg"
    first = ", ".join(list(weights)[:3]) or "none"
    raise BadArtifact(
        f"its tensors ({first}) are of no MLP policy of {', '.join(ALGORITHMS)}: {REMEDY}"
    )


def _activation(about: Mapping[str, Any], chosen: str | None) -> str | None:
    """Returns the activation that the metadata names, else the chosen one."""
    entry = _entry(about, "policy_kwargs", "activation_fn")
    classes = {f"<class 'torch.nn.modules.activation.{TORCH_NAMES[n]}'>": n for n in ACTIVATIONS}
    name = classes.get(entry)
    if entry and not name and chosen is None:
        raise BadArtifact(
            f"its activation {entry} is unknown: if it is one of {', '.join(ACTIVATIONS)}, give that as "
            "activation"
        )
    if name and chosen not in (None, name):
        raise BadArtifact(f"its activation is {name!r}, not {chosen!r}: leave the activation out")
    return name or chosen


def _entry(about: Mapping[str, Any], key: str, part: str) -> str:
    """Returns a part of an entry of the metadata as text, "" if there is none."""
    entry = about.get(key)
    return str(entry.get(part, "")) if isinstance(entry, dict) else ""
