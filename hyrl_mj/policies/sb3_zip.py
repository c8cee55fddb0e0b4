"""Reads the policy of an SB3 agent from the zip that `model.save` wrote.

The file is data: nothing in it is unpickled.
"""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np

from hyrl_mj.errors import BadArtifact, printable
from hyrl_mj.files import archives, artifacts
from hyrl_mj.policies import sb3_metadata, torch_file
from hyrl_mj.policies.algorithms import ALGORITHMS
from hyrl_mj.policies.mlp import ACTIVATIONS, TORCH_NAMES, MlpPolicy, check_kind, layer_names
from hyrl_mj.policies.preprocessing import Preprocessing
from hyrl_mj.tasks import Task

REMEDY = "give the zip that SB3's model.save wrote, an .onnx file, or a policy.safetensors of a run"
# How to go on with a policy that is more than an MLP.
INSTEAD = "export it to .onnx, or give a function that calls model.predict in Python"
PLAIN = f"only plain multilayer perceptrons on a vector of numbers can be used: {INSTEAD}"
# Limit on the metadata [bytes]: those of SB3 take some ten kilobytes.
LARGEST_METADATA = 2**22


def from_zip(
    path: Path, task: Task, activation: str | None, preprocessing: Preprocessing, plain: bool
) -> tuple[MlpPolicy, Preprocessing]:
    """Returns the network of the agent in a zip, and its preprocessing, both for the task's observation.

    `plain` says that it was trained on plain observations, whatever its metadata tell.
    """
    with artifacts.reading(path, REMEDY):
        tensors, about = _read(path)
        _check_plain(tensors, about, task)
        shape = _entry(about, "observation_space", "_shape")
        if preprocessing.n_stack > 1 and len(re.findall(r"\d+", shape)) > 1:
            raise BadArtifact(
                f"it saw observations of shape {shape}, as FrameStackObservation gives, which begins with "
                "copies of the first one where VecFrameStack begins with zeros: put that wrapper into the "
                "environment, or give an object with the methods start and act in Python"
            )
        algorithm = infer_algorithm(tensors, about)
        _check_used(tensors, algorithm)
        known = ALGORITHMS[algorithm]
        if known.is_actor_critic:
            check_kind(task, levels="log_std" not in tensors)
        weights = {name: t for name, t in tensors.items() if t.dtype == np.float32}
        if _observes_dict(about):
            keys = list(_observed_parts(about))
            order = _by_frames(task, preprocessing.n_stack, keys)
            first = next(name for part in known.parts for name in layer_names(weights, part))
            if weights[first].shape[1:] == order.shape:  # else the policy says what does not fit
                weights[first] = np.ascontiguousarray(weights[first][:, order])
            preprocessing = _framewise(preprocessing, task, keys)
        for name, weight in weights.items():
            if not np.isfinite(weight).all():
                raise BadArtifact(f"its tensor {_short(name)} has weights that are not finite")
        activation = _activation(about, activation) or known.activation
        policy = MlpPolicy(task, algorithm, activation, weights, preprocessing.n_stack)
        sb3_metadata.check_inputs(about, task)
        if preprocessing.normalization is not None:
            sb3_metadata.check_original(about, task)
        elif not plain:
            n_stack = preprocessing.n_stack
            sb3_metadata.check_observations(about, task, known.is_actor_critic, n_stack)
    return policy, preprocessing


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns the tensors of an SB3 zip by name, and its metadata, {} if it has none."""
    if not is_zipfile(path):
        raise BadArtifact(f"it is not a zip: {REMEDY}")
    with archives.open_zip(artifacts.read_limited(path)) as file:
        names = set(file.namelist())
        if "policy.pth" not in names:
            data = (
                archives.read_member(file, "data", torch_file.LARGEST) if "data" in names else b""
            )
            if re.search(rb"[\"']sbx\.", data):  # SBX has SB3's interface
                raise BadArtifact(
                    "it is an agent of SBX, whose networks are in JAX and saved as a pickle, which is not "
                    f"opened: {INSTEAD}"
                )
            raise BadArtifact(f"it has no policy.pth, and so no weights: {REMEDY}")
        metadata = b"{}"
        if "data" in names:
            metadata = archives.read_member(file, "data", LARGEST_METADATA)
        content = archives.read_member(file, "policy.pth", torch_file.LARGEST)
    about = json.loads(metadata)
    if not isinstance(about, dict):
        raise BadArtifact("its metadata is no JSON object")
    return torch_file.read_tensors(content), about


def _check_plain(tensors: Mapping[str, np.ndarray], about: Mapping[str, Any], task: Task) -> None:
    """Raises `BadArtifact` if an agent is more than an MLP on a vector, or on a Dict of vectors."""
    if any("lstm" in name for name in tensors):
        raise BadArtifact(
            "it has a recurrent policy (lstm): load it with sb3-contrib in Python, and give the model "
            "itself, as hyrl_mj.diagnose(task, model)"
        )
    # Parts of tensor names, and what they mean.
    foreign = {
        "features_extractor.extractors.": "its observations are a dict",
        "features_extractor.cnn.": "it has a CNN policy, which looks at images",
        "features_extractor.": "it has a features extractor of its own",
        ".ra_mean": "it has batch renormalisation between its layers (ra_mean), as CrossQ's",
    }
    for part, what in foreign.items():
        if any(part in name for name in tensors):
            raise BadArtifact(f"{what}: {PLAIN}")
    of_dict = _observes_dict(about)
    if of_dict:
        _check_parts(about, task)
    # SB3's extractor of a Dict puts vectors one after the other, in the order of their keys.
    usual = "torch_layers.CombinedExtractor" if of_dict else "torch_layers.FlattenExtractor"
    extractor = _entry(about, "policy_kwargs", "features_extractor_class")
    if extractor and usual not in extractor:
        raise BadArtifact(f"it has a features extractor of its own, {extractor}: {PLAIN}")
    own = _entry(about, "policy_class", "__module__")
    if own and not own.startswith(("stable_baselines3.", "sb3_contrib.")):
        raise BadArtifact(f"its policy is of a class of its own, of {own:.80}: {PLAIN}")
    if ".maskable." in own:
        raise BadArtifact(
            f"it chooses among the actions that a mask allows (MaskablePPO), and {task.name} has no masks: "
            "if each action is allowed everywhere, give a function that calls model.predict in Python"
        )
    if "actor.log_std" in tensors or np.ndim(tensors.get("log_std", 0)) == 2:
        raise BadArtifact("it was trained with use_sde: train it without, or export it to .onnx")


def _observes_dict(about: Mapping[str, Any]) -> bool:
    """Returns whether an agent with this metadata observes a Dict."""
    return "spaces.dict" in _entry(about, "observation_space", ":type:")


def _check_parts(about: Mapping[str, Any], task: Task) -> None:
    """Raises `BadArtifact` if an agent observes a Dict with other keys than that of a task."""
    ours = task.observation_parts
    theirs = _observed_parts(about)
    # The sizes are those of the task, or all as many times larger as observations are stacked.
    if theirs.keys() == ours.keys() and len({theirs[key] / ours[key] for key in ours}) == 1:
        return
    of_task = _dict_of(ours) if ours else f"a vector of {len(task.observation_low)}"
    raise BadArtifact(
        f"its observations are {_dict_of(theirs)}, those of {task.name} {of_task}: give an agent that was "
        "trained on this environment"
    )


def _observed_parts(about: Mapping[str, Any]) -> dict[str, int]:
    """Returns the sizes of the vectors of an agent's Dict by key, in the order in which SB3 joins them."""
    text = str(about["observation_space"].get("spaces"))[: 2**14]
    # "'goal': Box(-inf, inf, (2,), float32)", or "('goal', Box(..." of an OrderedDict; vectors have a size.
    part = r"'([^']*)'(?::|,) Box\([^()]*\((?:(\d{1,9}),|[^()]*)\)[^()]*\)"
    return {key: int(size or 0) for key, size in re.findall(part, text)}


def _dict_of(parts: Mapping[str, int]) -> str:
    """Returns a Dict of vectors in words: "Dict(goal (2,), observation (4,))"."""
    words = ", ".join(f"{printable(key)} ({size},)" for key, size in parts.items())
    return f"Dict({words})" if words else "a Dict"


def _by_frames(task: Task, n_stack: int, keys: Sequence[str]) -> np.ndarray:
    """Returns where an agent of a Dict has the numbers of stacked observations, frame by frame: (n_stack k,).

    `VecFrameStack` stacks each vector of a Dict by itself, and SB3 puts these stacks one after the other, in
    the order of the `keys` of its space. The task's own observation has its parts in an order of its own.
    """
    parts = task.observation_parts
    ends = n_stack * np.cumsum([parts[key] for key in keys])
    stacks = dict(zip(keys, np.split(np.arange(ends[-1]), ends[:-1]), strict=True))
    return np.hstack([stacks[key].reshape(n_stack, -1) for key in parts]).ravel()


def _framewise(preprocessing: Preprocessing, task: Task, keys: list[str]) -> Preprocessing:
    """Returns the preprocessing of an agent of a Dict with `keys` for the task's order, frame by frame.

    Raises:
        BadArtifact: its statistics are in an order that is not known.
    """
    if preprocessing.normalization is None:
        return preprocessing
    if preprocessing.normalization.by_key:
        keys = list(task.observation_parts)
    elif keys != sorted(keys):
        raise BadArtifact(
            f"its Dict has the keys {', '.join(keys)}, which are not sorted, so that a row of statistics may "
            "be in one order or the other: give arrays mean.KEY and var.KEY for each of them"
        )
    for n in {1, preprocessing.n_stack}:
        preprocessing = preprocessing.reordered(_by_frames(task, n, keys))
    return preprocessing


def _check_used(tensors: Mapping[str, np.ndarray], algorithm: str) -> None:
    """Raises `BadArtifact` if an agent has tensors that the policy of its algorithm does not have."""
    known = ALGORITHMS[algorithm]
    spread = known.log_std or ""
    prefixes = (*known.parts, f"{spread}.") if spread else known.parts
    used = {name for prefix in prefixes for name in layer_names(tensors, prefix)} | {spread}
    of_training = (
        "value_net.", "mlp_extractor.value_net.", "critic.", "critic_target.", "actor_target.",
        "q_net_target.",
    )  # fmt: skip
    other = [n for n in tensors if n not in used and not n.startswith(of_training)]
    if other:
        names = _short(", ".join(other[:3])) + (", ..." if len(other) > 3 else "")
        raise BadArtifact(f"no {algorithm} policy of SB3 has its tensors {names}: {PLAIN}")


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
    first = _short(", ".join(list(weights)[:3])) or "none"
    raise BadArtifact(
        f"its tensors ({first}) are of no MLP policy of {', '.join(ALGORITHMS)}: {INSTEAD}"
    )


def _activation(about: Mapping[str, Any], chosen: str | None) -> str | None:
    """Returns the activation that the metadata names, else the chosen one."""
    named = _entry(about, "policy_kwargs", "activation_fn")
    classes = {f"<class 'torch.nn.modules.activation.{TORCH_NAMES[n]}'>": n for n in ACTIVATIONS}
    # What is done in place gives the same numbers.
    name = classes.get(re.sub(r"functools\.partial\((.*), inplace=\w+\)", r"\1", named))
    if named and not name and "torch.nn." in named:
        raise BadArtifact(
            f"its activation {named} is none of {', '.join(ACTIVATIONS)} with torch's defaults: {INSTEAD}"
        )
    if named and not name and chosen is None:
        raise BadArtifact(
            f"its activation {named} is unknown: if it is one of {', '.join(ACTIVATIONS)}, give that as "
            "activation"
        )
    if name and chosen not in (None, name):
        raise BadArtifact(f"its activation is {name!r}, not {chosen!r}: leave the activation out")
    return name or chosen


def _entry(about: Mapping[str, Any], key: str, part: str) -> str:
    """Returns a part of an entry of the metadata as text, "" if there is none."""
    found = about.get(key)
    return _short(str(found.get(part, ""))) if isinstance(found, dict) else ""


def _short(text: str) -> str:
    """Returns the beginning of a text from a file, for messages."""
    return text if len(text) <= 120 else f"{text[:120]}..."
