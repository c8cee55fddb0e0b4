"""Policies: from a measurement to an input, in NumPy alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from threadpoolctl import ThreadpoolController

from hyrl_mj import artifacts
from hyrl_mj.errors import BadArtifact
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.registry import get_task


def relu(x: np.ndarray) -> np.ndarray:
    """max(x, 0), of any shape."""
    return np.maximum(x, 0)


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"relu": relu, "tanh": np.tanh}
# Rows that go through a network at a time: the hidden layers then stay in the processor's cache.
CHUNK = 4096
# The last bits of a matrix product depend on the threads that share it, and threads that wait for a
# busy core take ten times as long as one: batches have a single one.
BLAS = ThreadpoolController()


@runtime_checkable
class Policy(Protocol):
    """Anything that answers a measurement with an input."""

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Inputs (n, m) in the plant's units for measurements (n, p)."""
        ...


@dataclass(frozen=True)
class MlpPolicy:
    """A multilayer perceptron on a task's observation; a trained SB3 policy at its mean or mode.

    Attributes:
        task: the task whose observation it reads and whose inputs it gives.
        algorithm: the SB3 algorithm that trained it, "ppo" or "dqn".
        activation: "relu" or "tanh", between the layers.
        weights: all tensors of the SB3 policy by name, critics included, so that training can go on.
    """

    task: Task
    algorithm: str
    activation: str
    weights: Mapping[str, np.ndarray] = field(repr=False)

    def __post_init__(self) -> None:
        layers = _layers(self.weights, self.algorithm)
        outputs = len(self.task.input_limits[0]) if self._levels is None else len(self._levels)
        given = (layers[0][0].shape[1], layers[-1][0].shape[0])
        wanted = (len(self.task.observation_low), outputs)
        if given != wanted:
            raise BadArtifact(
                f"the network takes {given[0]} and gives {given[1]} numbers, "
                f"the task {self.task.name} needs {wanted[0]} and {wanted[1]}"
            )
        for (_, bias), (weight, _) in pairwise(layers):
            if weight.shape[1] != len(bias):
                raise BadArtifact(
                    f"a layer gives {len(bias)} numbers and the next takes {weight.shape[1]}"
                )
        if not all(np.isfinite(w).all() and np.isfinite(b).all() for w, b in layers):
            raise BadArtifact("the network has weights that are not finite")
        if self.activation not in ACTIVATIONS:
            raise BadArtifact(
                f"activation {self.activation!r} is unknown: choose one of {', '.join(ACTIVATIONS)}"
            )
        object.__setattr__(self, "_network", layers)

    @property
    def _levels(self) -> np.ndarray | None:
        return self.task.input_levels

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(len(bias) for _, bias in self._network[:-1])  # type: ignore[attr-defined]

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Inputs for noisy measurements.

        Args:
            measured: (n, p), in the units of the measurement.

        Returns:
            (n, m) inputs in the plant's units, inside its limits.

        Raises:
            BadInput: a wrong shape, or a value that is not finite.
        """
        measured = self.task.check_measurement(measured)
        return self.inputs(self.task.observation(measured))

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        """Inputs (n, m) in the plant's units for observations (n, k)."""
        outputs = self.outputs(observation)
        if self._levels is not None:
            return self._levels[outputs.argmax(axis=1)]
        low, high = self.task.input_limits
        return np.clip(outputs.astype(float), low, high)

    def outputs(self, observation: np.ndarray) -> np.ndarray:
        """The network's last layer for observations (n, k): action values or preferences of a
        discrete task's levels, else the mean input."""
        observation = observation.astype(np.float32)
        if len(observation) <= 1:
            return self._forward(observation)
        parts = range(0, len(observation), CHUNK)
        with BLAS.limit(limits=1, user_api="blas"):
            return np.concatenate([self._forward(observation[i : i + CHUNK]) for i in parts])

    def _forward(self, x: np.ndarray) -> np.ndarray:
        activate = ACTIVATIONS[self.activation]
        *hidden, last = self._network  # type: ignore[attr-defined]
        for weight, bias in hidden:
            x = x @ weight.T
            x += bias
            x = activate(x)
        x = x @ last[0].T
        x += last[1]
        return x

    def save(self, path: Path) -> None:
        """Write `path` (safetensors) and its description beside it (JSON)."""
        artifacts.write_tensors(path, dict(self.weights))
        artifacts.write_json(
            path.with_suffix(".json"),
            {"task": self.task.name, "algorithm": self.algorithm, "activation": self.activation},
            kind="policy",
        )

    @staticmethod
    def load(path: Path) -> MlpPolicy:
        """Read what `save` wrote.

        Raises:
            BadArtifact: a file is missing, truncated, or not a policy of this version.
        """
        description = artifacts.read_json(path.with_suffix(".json"), kind="policy")
        weights = artifacts.read_tensors(path)
        with artifacts.reading(path):
            return MlpPolicy(
                task=get_task(description["task"]),
                algorithm=description["algorithm"],
                activation=description["activation"],
                weights=weights,
            )


def _layers(
    weights: Mapping[str, np.ndarray], algorithm: str
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The (weight, bias) pairs from observation to output, found by SB3's names for them."""
    prefixes = {"ppo": ("mlp_extractor.policy_net.", "action_net."), "dqn": ("q_net.q_net.",)}
    if algorithm not in prefixes:
        raise BadArtifact(f"a policy of algorithm {algorithm!r} is unknown here: ppo or dqn")
    layers = []
    for prefix in prefixes[algorithm]:
        stems = {
            name.removesuffix("weight")
            for name in weights
            if name.startswith(prefix) and name.endswith("weight")
        }
        for stem in sorted(stems, key=lambda s: (len(s), s)):
            layers.append((weights[f"{stem}weight"], weights[f"{stem}bias"]))
    if not layers:
        raise BadArtifact(f"the file holds no network of a {algorithm} policy")
    return layers
