"""Policies that were not trained here: SB3 agents, ONNX files, and functions.

A file of somebody else's is data. Of an SB3 zip only the tensors are read, by torch's unpickler that
builds nothing else, and the part of its metadata that is plain JSON. What is pickled in it stays closed.
"""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile, ZipFile, is_zipfile

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadArtifact, BadInput, brief, unknown
from hyrl_mj.noise import check_seed
from hyrl_mj.policies import (
    ACTIVATIONS,
    ACTOR_CRITIC,
    LAYOUTS,
    TORCH_NAMES,
    MlpPolicy,
    ObservationPolicy,
    check_kind,
)
from hyrl_mj.tasks.base import Task

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


# ---- what acts


@dataclass(frozen=True)
class SampledPolicy(ObservationPolicy):
    """A trained policy that draws its inputs, as it did while it learned.

    It is reproducible call by call only: the same seed and the same calls in the same order give the
    same inputs, but the same measurement twice does not.

    Attributes:
        policy: gives the distributions.
        rng: draws from them.
    """

    policy: MlpPolicy
    rng: np.random.Generator

    def __post_init__(self) -> None:
        # What cannot be drawn from is refused now, and not in the middle of a run.
        k = len(self.task.observation_low)
        self.policy.sample(np.zeros((1, k)), np.random.default_rng(0))

    @property
    def task(self) -> Task:  # type: ignore[override]
        return self.policy.task

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        return self.policy.sample(observation, self.rng)


@dataclass(frozen=True)
class FunctionPolicy(ObservationPolicy):
    """A function of the observation as a policy.

    Attributes:
        task: the task whose observation it reads and whose inputs it gives.
        function: observations (n, k) float32 -> inputs (n, m) in the plant's units, which are clipped to
            the task's limits; or the numbers of a discrete task's levels (n,) int.
        name: what messages call it.
    """

    task: Task
    function: Callable[[np.ndarray], Any]
    name: str = "the function"

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        n, m = len(observation), len(self.task.inputs)
        if not n:
            return np.zeros((0, m))
        try:
            actions = np.asarray(self.function(observation.astype(np.float32)))
        except Exception as error:  # a user's code raises what it likes
            what = error if isinstance(error, BadInput) else f"it raised {brief(error)}"
            raise BadInput(f"{self.name} cannot be used: {what}") from error
        discrete = self.task.input_levels is not None
        wanted = (n,) if discrete else (n, m)
        if actions.shape != wanted:
            what = "integers" if discrete else "inputs"
            raise BadInput(
                f"{self.name} gives shape {actions.shape} for {n} observations, {self.task.name} takes "
                f"{what} of shape {wanted}"
            )
        if discrete:
            return self.task.at_levels(actions)
        return np.clip(self._finite(actions), *self.task.input_limits)

    def _finite(self, actions: np.ndarray) -> np.ndarray:
        """Inputs (n, m) as floats, all of them finite numbers."""
        try:
            actions = actions.astype(float)
        except (TypeError, ValueError):
            raise BadInput(f"{self.name} gives {actions.flat[0]!r}: an input is a number") from None
        finite = np.isfinite(actions)
        if not finite.all():
            raise BadInput(
                f"{self.name} gives {actions[~finite][0]}: inputs of {self.task.name} are finite numbers"
            )
        return actions


def from_callable(function: Callable[[np.ndarray], Any], task: Task) -> FunctionPolicy:
    """A function of the observation as a policy.

    Args:
        function: observations (n, k) float32, as the task's environments give them -> inputs (n, m) in
            the plant's units, which are clipped to the task's limits. For a discrete task: the numbers of
            the levels, (n,) integers.
        task: the task whose observation it reads and whose inputs it gives.

    Raises:
        BadInput: it is not callable; and whenever the policy is asked: the function raises, or gives
            another shape, a number that is not finite, or an integer out of range.
    """
    if not callable(function):
        raise BadInput(
            f"{function!r} cannot be called: give a function from observations (n, k) to inputs (n, m)"
        )
    return FunctionPolicy(task, function)


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
        activation: between the layers, one of `hyrl_mj.policies.ACTIVATIONS`, for a zip that does not
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
        return _from_onnx(path, task)
    if path.suffix == ".safetensors":
        policy = _from_safetensors(path, task, activation)
    else:
        with artifacts.reading(path, REMEDY):
            weights, about = _read_zip(path)
            policy = _from_tensors(weights, about, task, activation)
    return SampledPolicy(policy, np.random.default_rng(seed)) if stochastic else policy


def _from_safetensors(path: Path, task: Task, activation: str | None) -> MlpPolicy:
    """The policy that `MlpPolicy.save` wrote."""
    policy = MlpPolicy.load(path)
    if policy.task.name != task.name:
        raise BadArtifact(f"{path} is a policy for {policy.task.name}: {task.name} needs its own")
    if activation not in (None, policy.activation):
        raise BadArtifact(f"{path} has activation {policy.activation!r}: leave the activation out")
    return policy


# ---- SB3


def _read_zip(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
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


def _from_tensors(
    weights: dict[str, np.ndarray], about: dict[str, Any], task: Task, activation: str | None
) -> MlpPolicy:
    """The policy of an SB3 agent whose tensors and metadata have been read."""
    _check_plain(weights, about)
    algorithm = infer_algorithm(weights, about)
    if LAYOUTS[algorithm] is ACTOR_CRITIC:
        check_kind(task, levels="log_std" not in weights)
    wrong = [name for name, weight in weights.items() if not np.isfinite(weight).all()]
    if wrong:
        raise BadArtifact(f"its tensor {wrong[0]} has weights that are not finite")
    activation = _activation(about, activation) or LAYOUTS[algorithm].activation
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
        f"its tensors ({some}) are of no MLP policy of {', '.join(LAYOUTS)}: {REMEDY}"
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


# ---- ONNX


def _from_onnx(path: Path, task: Task) -> FunctionPolicy:
    """The policy of an ONNX file; it has been tried once."""
    try:
        import onnxruntime
    except ImportError:
        raise BadInput('an .onnx file takes onnxruntime: pip install "hyrl-mj[onnx]"') from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what goes wrong is raised, too
    with artifacts.reading(path, REMEDY):
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        batched = _check_onnx_input(session.get_inputs(), task)
    policy = FunctionPolicy(task, _onnx_function(session, batched, task), f"the model of {path}")
    try:
        policy.inputs(np.zeros((2, len(task.observation_low))))
    except BadInput as error:
        raise BadArtifact(str(error)) from error
    return policy


def _check_onnx_input(inputs: list[Any], task: Task) -> bool:
    """Whether a model takes many observations at once; the other ones take one."""
    k = len(task.observation_low)
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(inputs[0].shape) != 2:
        takes = ", ".join(f"{i.name}: {i.type} of shape {i.shape}" for i in inputs) or "nothing"
        raise BadArtifact(
            f"the model takes {takes}: it has to take one input, observations (n, {k}) float32"
        )
    rows, columns = inputs[0].shape
    if isinstance(columns, int) and columns != k:
        raise BadArtifact(
            f"the model takes {columns} numbers, an observation of {task.name} has {k}"
        )
    if isinstance(rows, int) and rows != 1:
        raise BadArtifact(
            f"the model takes {rows} observations at a time: export it for any number of them, or for one"
        )
    return rows != 1


def _onnx_function(session: Any, batched: bool, task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """What a model answers to observations (n, k), as `FunctionPolicy` wants it."""
    given, first = session.get_inputs()[0].name, session.get_outputs()[0].name

    def answer(observation: np.ndarray) -> np.ndarray:
        parts = [observation] if batched else np.split(observation, len(observation))
        actions = np.concatenate([session.run([first], {given: part})[0] for part in parts])
        preferences = task.input_levels is not None and np.issubdtype(actions.dtype, np.floating)
        return _preferred(actions, task) if preferences else actions

    return answer


def _preferred(preferences: np.ndarray, task: Task) -> np.ndarray:
    """The levels (n,) int that are preferred, by preferences (n, levels)."""
    if preferences.ndim != 2 or preferences.shape[1] != task.levels:
        raise BadInput(
            f"{task.name} takes preferences of shape (n, {task.levels}) or integers (n,), got "
            f"{preferences.dtype} of shape {preferences.shape}"
        )
    if not np.isfinite(preferences).all():
        raise BadInput("a preference is not a finite number")
    return preferences.argmax(axis=1)
