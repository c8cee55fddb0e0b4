"""Policies: from a measurement to an input, in NumPy alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from threadpoolctl import ThreadpoolController

from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.policies.algorithms import ALGORITHMS, Algorithm

if TYPE_CHECKING:
    from hyrl_mj.tasks import Task


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(0.5 * x))  # never overflows


def _gelu(x: np.ndarray) -> np.ndarray:
    from scipy.special import erf  # slow to import, and seldom needed

    return np.asarray(0.5 * x * (1 + erf(x / np.sqrt(np.float32(2)))))


# The functions between the layers, of arrays of any shape.
ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "leaky_relu": lambda x: np.where(x > 0, x, 0.01 * x),
    "silu": lambda x: x * _sigmoid(x),
    "gelu": _gelu,
    "sigmoid": _sigmoid,
}
# Their classes in `torch.nn`.
TORCH_NAMES = {
    "relu": "ReLU", "tanh": "Tanh", "elu": "ELU", "leaky_relu": "LeakyReLU", "silu": "SiLU",
    "gelu": "GELU", "sigmoid": "Sigmoid",
}  # fmt: skip
# A linear layer: weight (outputs, inputs) and bias (outputs,).
Layer = tuple[np.ndarray, np.ndarray]
# Rows that go through a network at a time: the hidden layers then stay in the processor's cache.
CHUNK = 4096
# The last bits of a matrix product depend on the number of threads, and threads that wait for a busy core
# take ten times as long as one: batches run on a single thread.
BLAS = ThreadpoolController()


@runtime_checkable
class Policy(Protocol):
    """Anything that answers a measurement with an input."""

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) in the plant's units for measurements (n, p)."""


@runtime_checkable
class MemoryPolicy(Policy, Protocol):
    """A policy that acts with a memory in closed loops; its `act` answers as if there were none.

    A memory is an array (n, ...) of floats with a row for each run, so that rows can be picked and copied; of
    width 0, (n, 0), it is none. The next memory is a function of the memory and the measurement alone.
    """

    def start(self, n: int) -> np.ndarray:
        """Returns the memory (n, ...) of n runs at their start: that of a robot at rest there."""

    def act_after(self, memory: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) for measurements (n, p), and the next memory (n, ...)."""


class ObservationPolicy(ABC):
    """A policy that sees a measurement only through its task's observation.

    Attributes:
        task: the task whose observation it reads and whose inputs it gives.
    """

    task: Task

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) in the plant's units, inside its limits, for noisy measurements (n, p).

        Raises:
            BadInput: a wrong shape, or a value that is not finite.
        """
        measured = self.task.check_measurement(measured)
        return self.inputs(self.task.observation(measured))

    @abstractmethod
    def inputs(self, observation: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) in the plant's units for observations (n, k)."""


@dataclass(frozen=True)
class MlpPolicy(ObservationPolicy):
    """A multilayer perceptron on a task's observation: the mean or mode of a trained SB3 policy.

    Attributes:
        algorithm: the SB3 algorithm that trained it, one of `ALGORITHMS`.
        activation: the function between the layers, one of `ACTIVATIONS`.
        weights: all tensors of the SB3 policy by name, including its critics, so that training can continue.
        frames: number of observations that it sees at once; more than one takes a `PreprocessedPolicy`.
    """

    task: Task
    algorithm: str
    activation: str
    weights: Mapping[str, np.ndarray] = field(repr=False)
    frames: int = 1

    def __post_init__(self) -> None:
        layers, task, levels = self.layers, self.task, self._algorithm.levels
        if levels is None and "log_std" in self.weights:
            levels = False
        if levels is not None:
            check_kind(task, levels)
        sizes = (layers[0][0].shape[1], layers[-1][0].shape[0])
        outputs = len(task.inputs) if task.input_levels is None else len(task.input_levels)
        k = len(task.observation_low)
        needed = (self.frames * k, outputs)
        if sizes != needed:
            stacked = sizes[1] == outputs and sizes[0] > k and sizes[0] % k == 0
            hint = (
                f": give --n-stack {sizes[0] // k} if VecFrameStack showed it as many at once; a "
                "FrameStackObservation belongs into the environment"
            ) * stacked
            raise BadArtifact(
                f"the network takes {sizes[0]} and gives {sizes[1]} numbers, "
                f"the task {task.name} needs {needed[0]} and {needed[1]}{hint}"
            )
        for (_, bias), (weight, _) in pairwise(layers):
            if weight.shape[1] != len(bias):
                raise BadArtifact(
                    f"a layer gives {len(bias)} numbers and the next takes {weight.shape[1]}"
                )
        if not all(np.isfinite(array).all() for layer in layers for array in layer):
            raise BadArtifact("the network has weights that are not finite")
        if self.activation not in ACTIVATIONS:
            raise BadArtifact(
                f"activation {self.activation!r} is unknown: choose one of {', '.join(ACTIVATIONS)}"
            )

    @property
    def _algorithm(self) -> Algorithm:
        if self.algorithm not in ALGORITHMS:
            raise BadArtifact(
                f"algorithm {self.algorithm!r} of the policy is unknown: choose one of "
                f"{', '.join(ALGORITHMS)}"
            )
        return ALGORITHMS[self.algorithm]

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(len(bias) for _, bias in self.layers[:-1])

    @cached_property
    def layers(self) -> list[Layer]:
        """Weight (outputs, inputs) and bias (outputs,) of each layer, from observation to output."""
        parts = [_linear(self.weights, part) for part in self._algorithm.parts]
        if not parts[-1]:
            raise BadArtifact(f"the file holds no network of a {self.algorithm} policy")
        return [layer for part in parts for layer in part]

    @property
    def output(self) -> str:
        """What the last layer returns: the value of each "level", or the input, to "clip" or "squash"."""
        if self.task.input_levels is not None:
            return "level"
        return "squash" if self._algorithm.squashed else "clip"

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        return self._chosen(self.outputs(observation))

    def sample(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draws inputs (n, m) for observations (n, k) from the distribution that was trained.

        Raises:
            BadInput: a policy of DQN, TD3 or DDPG, which has no distribution to draw from.
        """
        if self._algorithm.log_std is None:
            raise BadInput(
                f"a {self.algorithm} policy has no distribution to draw from: use it as it is, "
                "without stochastic"
            )
        outputs = self.outputs(observation)
        if self.task.input_levels is not None:
            # The greatest of preferences with Gumbel noise is a draw from their softmax.
            return self._chosen(outputs + rng.gumbel(size=outputs.shape))
        spread = np.exp(self._log_std(observation))
        return self._chosen(outputs + spread * rng.standard_normal(outputs.shape))

    def _log_std(self, observation: np.ndarray) -> np.ndarray:
        """Returns the logarithm of the Gaussian's standard deviation, (n, m) or (m,)."""
        name = self._algorithm.log_std or ""
        if name in self.weights:
            return self.weights[name]
        layer = _linear(self.weights, f"{name}.")
        if not layer:
            raise BadArtifact(f"the {self.algorithm} policy has no log_std to draw with")
        return np.clip(self._run(observation, layer[0]), -20, 2)  # as SB3 does

    def _chosen(self, outputs: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for the outputs of the last layer."""
        if self.task.input_levels is not None:
            return np.take(self.task.input_levels, outputs.argmax(axis=1), axis=0)
        u, (low, high) = outputs.astype(float), self.task.input_limits
        if self._algorithm.squashed:
            u = low + (np.tanh(u) + 1) / 2 * (high - low)
        return np.clip(u, low, high)

    def outputs(self, observation: np.ndarray) -> np.ndarray:
        """Returns the network's last layer for observations (n, k).

        These are action values or preferences of a discrete task's levels (n, levels), else mean inputs
        (n, m), before the squashing if there is one.
        """
        return self._run(observation, self.layers[-1])

    def _run(self, observation: np.ndarray, last: Layer) -> np.ndarray:
        """Returns the output of `last` on top of the hidden layers, for observations (n, k)."""
        observation = observation.astype(np.float32)
        # A trace takes all rows at once.
        if len(observation) <= 1 or not isinstance(observation, np.ndarray):
            return self._forward(observation, last)
        parts = range(0, len(observation), CHUNK)
        with BLAS.limit(limits=1, user_api="blas"):
            return np.concatenate([self._forward(observation[i : i + CHUNK], last) for i in parts])

    def _forward(self, x: np.ndarray, last: Layer) -> np.ndarray:
        activate = ACTIVATIONS[self.activation]
        for weight, bias in self.layers[:-1]:
            x = x @ weight.T
            x += bias
            x = activate(x)
        x = x @ last[0].T
        x += last[1]
        return x

    def save(self, path: Path) -> None:
        """Writes `path` (safetensors) and its description beside it (JSON)."""
        artifacts.write_tensors(path, dict(self.weights))
        about = {"task": self.task.name, "algorithm": self.algorithm, "activation": self.activation}
        artifacts.write_json(path.with_suffix(".json"), about, kind="policy")

    @staticmethod
    def load(path: Path, task: Task | None = None, frames: int = 1) -> MlpPolicy:
        """Reads what `save` wrote.

        Args:
            path: the safetensors file, with its description beside it.
            task: the task of the policy; by default the one that the description names.
            frames: number of observations that the policy sees at once.

        Raises:
            BadArtifact: a file is missing, truncated, or not a policy of this version; or the policy is for
                another task.
        """
        from hyrl_mj.tasks import get_task, task_names  # for who does not give the task

        weights = artifacts.read_tensors(path)

        def described(about: dict[str, Any]) -> MlpPolicy:
            name = about["task"]
            known = task or (get_task(name) if name in task_names() else None)
            if known is None:
                raise BadArtifact(f"it is for the unknown task {name!r}: give the task")
            if name != known.name:
                raise BadArtifact(f"it is a policy for {name}: {known.name} needs its own")
            return MlpPolicy(known, about["algorithm"], about["activation"], weights, frames)

        return artifacts.read_json(path.with_suffix(".json"), "policy", described)


@dataclass(frozen=True)
class SampledPolicy(ObservationPolicy):
    """A trained policy that draws its inputs, as it did during training.

    It is reproducible call by call only: the same seed and the same calls in the same order give the
    same inputs, but the same measurement twice does not.

    Attributes:
        policy: the policy whose distributions are drawn from.
        rng: the random number generator of the draws.
    """

    policy: MlpPolicy
    rng: np.random.Generator

    def __post_init__(self) -> None:
        # A policy without a distribution is refused now, and not in the middle of a run.
        observation = np.zeros((1, self.policy.frames * len(self.task.observation_low)))
        self.policy.sample(observation, np.random.default_rng(0))

    @property
    def task(self) -> Task:  # type: ignore[override]
        return self.policy.task

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        return self.policy.sample(observation, self.rng)


def check_kind(task: Task, levels: bool) -> None:
    """Raises `BadArtifact` if a network with levels, or without, does not have the inputs of a task."""
    if levels == (task.input_levels is not None):
        return
    gives = "chooses among discrete levels" if levels else "gives continuous inputs"
    ours = task.input_levels
    takes = "continuous inputs" if ours is None else f"one of {len(ours)} discrete levels"
    raise BadArtifact(f"the network {gives}, the task {task.name} takes {takes}")


def layer_names(weights: Mapping[str, np.ndarray], prefix: str) -> list[str]:
    """Returns the names of weights and biases of the linear layers whose names begin with `prefix`."""
    return [f"{stem}{part}" for stem in _stems(weights, prefix) for part in ("weight", "bias")]


def _stems(weights: Mapping[str, np.ndarray], prefix: str) -> list[str]:
    names = [n for n in weights if n.startswith(prefix) and n.endswith("weight")]
    return sorted((name.removesuffix("weight") for name in names), key=lambda s: (len(s), s))


def _linear(weights: Mapping[str, np.ndarray], prefix: str) -> list[Layer]:
    """Returns the linear layers whose names begin with `prefix`, in order."""
    layers = []
    for stem in _stems(weights, prefix):
        weight, bias = weights[f"{stem}weight"], weights.get(f"{stem}bias")
        if weight.ndim != 2 or bias is None or bias.shape != weight.shape[:1]:
            raise BadArtifact(
                f"{stem[:80]}weight belongs to no linear layer with a bias: only plain multilayer "
                "perceptrons can be used"
            )
        layers.append((weight, bias))
    return layers
