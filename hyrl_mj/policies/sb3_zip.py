"""The policy of an SB3 agent, read from the zip that `model.save` wrote.

The file is treated as data. torch's restricted unpickler reads the tensors, and of the metadata only
plain JSON is read. Nothing else in the file is unpickled.
"""

from __future__ import annotations

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
from hyrl_mj.policies.activations import ACTIVATIONS, TORCH_NAMES
from hyrl_mj.policies.algorithms import ALGORITHMS
from hyrl_mj.policies.mlp import MlpPolicy, check_kind
from hyrl_mj.tasks import Task

REMEDY = "give the zip that SB3's model.save wrote, an .onnx file, or a policy.safetensors of a run"
# What unpacks to more [bytes] is no MLP policy: the largest of them take a few megabytes.
LARGEST = 2**28
# What parts of tensor names say about agents that are not plain MLPs on a vector.
FOREIGN = {
    "lstm": "it has a recurrent policy (lstm)",
    "features_extractor.extractors.": "its observations are a dict",
    "features_extractor.cnn.": "it has a CNN policy, which looks at images",
    "features_extractor.": "it has a features extractor of its own",
}


def read_zip(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The tensors of an SB3 zip by name, and its metadata, {} if it has none."""
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
    """What a member of a zip unpacks to."""
    if file.getinfo(name).file_size > LARGEST:
        raise BadArtifact(f"its {name} is too large for an MLP policy")
    return file.read(name)


def _tensors(content: bytes) -> dict[str, np.ndarray]:
    """The tensors of a `policy.pth`, by name."""
    import torch  # slow to import, and only needed here

    try:
        with ZipFile(io.BytesIO(content)) as inner:
            size = sum(info.file_size for info in inner.infolist())
    except BadZipFile:
        size = len(content)  # torch before 1.6 did not zip
    try:
        if size > LARGEST:
            raise BadArtifact("its policy.pth is too large for an MLP policy")
        with warnings.catch_warnings(action="ignore"):  # of odd pickles, which are refused anyway
            state = torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
    except UnpicklingError as error:
        # torch's own sentence recommends to load it unsafely.
        raise BadArtifact(
            "its policy.pth is damaged or holds more than tensors, as an agent's never does: nothing in it "
            "was executed; get the agent from who trained it"
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
    """The policy of an SB3 agent whose tensors and metadata have been read."""
    _check_plain(weights, about)
    algorithm = infer_algorithm(weights, about)
    if ALGORITHMS[algorithm].is_actor_critic:
        check_kind(task, levels="log_std" not in weights)
    wrong = [name for name, weight in weights.items() if not np.isfinite(weight).all()]
    if wrong:
        raise BadArtifact(f"its tensor {wrong[0]} has weights that are not finite")
    activation = _activation(about, activation) or ALGORITHMS[algorithm].activation
    return MlpPolicy(task, algorithm, activation, weights)


def _check_plain(weights: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> None:
    """Refuse agents that are more than an MLP on a vector of numbers."""
    plain = "only plain multilayer perceptrons on a vector of numbers can be used"
    for part, what in FOREIGN.items():
        if any(part in name for name in weights):
            raise BadArtifact(f"{what}: {plain}")
    if "spaces.dict" in _said(about, "observation_space", ":type:"):
        raise BadArtifact(f"its observations are a dict: {plain}")
    extractor = _said(about, "policy_kwargs", "features_extractor_class")
    if extractor and "torch_layers.FlattenExtractor" not in extractor:
        raise BadArtifact(f"it has a features extractor of its own, {extractor}: {plain}")
    if "actor.log_std" in weights or np.ndim(weights.get("log_std", 0)) == 2:
        raise BadArtifact("it was trained with use_sde: train it without, or export it to .onnx")


def infer_algorithm(weights: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> str:
    """Which SB3 algorithm trained an agent; "ppo" for A2C, too, where there is no metadata."""
    if any(name.startswith("q_net.q_net.") for name in weights):
        return "dqn"
    if "action_net.weight" in weights:
        return "a2c" if about and "clip_range" not in about else "ppo"
    if "actor.mu.weight" in weights:
        return "sac"
    if "actor.mu.0.weight" in weights:
        return "td3" if any(name.startswith("critic.qf1.") for name in weights) else "ddpg"
    some = ", ".join(list(weights)[:3]) or "none"
    raise BadArtifact(
        f"its tensors ({some}) are of no MLP policy of {', '.join(ALGORITHMS)}: {REMEDY}"
    )


def _activation(about: Mapping[str, Any], given: str | None) -> str | None:
    """The activation that the metadata names, else the one given."""
    said = _said(about, "policy_kwargs", "activation_fn")
    classes = {f"<class 'torch.nn.modules.activation.{TORCH_NAMES[n]}'>": n for n in ACTIVATIONS}
    found = classes.get(said)
    if said and not found and given is None:
        raise BadArtifact(
            f"its activation {said} is unknown: if it is one of {', '.join(ACTIVATIONS)}, give that as "
            "activation"
        )
    if found and given not in (None, found):
        raise BadArtifact(f"its activation is {found!r}, not {given!r}: leave the activation out")
    return found or given


def _said(about: Mapping[str, Any], key: str, part: str) -> str:
    """A part of an entry of the metadata as text, "" if it is not there."""
    entry = about.get(key)
    return str(entry.get(part, "")) if isinstance(entry, dict) else ""
