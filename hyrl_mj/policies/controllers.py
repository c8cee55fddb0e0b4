"""The interface of a controller, and a single policy as a controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.policies.mlp import Policy
from hyrl_mj.policies.preprocessing import PreprocessedPolicy


class Controller(Protocol):
    """A pure function of mode and measurement; see `hyrl_mj.policies.hybrid.HybridController`."""

    @property
    def modes(self) -> tuple[int, ...]:
        """The numbers of its modes."""

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        """Returns the modes (n,) to start in, from the first measurements (n, p)."""

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,) for modes (n,) and measurements (n, p)."""


@dataclass(frozen=True)
class PolicyController:
    """A single policy as a controller with one mode, 0, that never jumps.

    A policy with memory needs the past measurements; without them it gives its steady answer.
    """

    policy: Policy

    @property
    def modes(self) -> tuple[int, ...]:
        return (0,)

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        return np.zeros(len(measured), dtype=int)

    @property
    def memory(self) -> int:
        """The number of past measurements that `step` takes."""
        return self.policy.memory if isinstance(self.policy, PreprocessedPolicy) else 0

    def step(
        self, q: np.ndarray, measured: np.ndarray, past: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,); `past` (n, memory, p) is NaN before the start."""
        if past is not None and isinstance(self.policy, PreprocessedPolicy) and self.memory:
            return self.policy.act_after(measured, past), q
        return self.policy.act(measured), q


def nothing_past(controller: Controller, n: int, columns: int) -> np.ndarray:
    """Returns the past (n, memory, p) of n runs at their start; most controllers have a memory of 0."""
    return np.full((n, getattr(controller, "memory", 0), columns), np.nan)


def answer(
    controller: Controller, q: np.ndarray, measured: np.ndarray, past: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns inputs (n, m) and next modes (n,) of a controller that may have a memory."""
    if past.shape[1] and isinstance(controller, PolicyController):
        return controller.step(q, measured, past)
    return controller.step(q, measured)


def check_inputs(u: np.ndarray, n: int, m: int) -> np.ndarray:
    """Returns inputs for n measurements themselves; raises `BadInput` unless their shape is (n, m)."""
    if np.shape(u) != (n, m):
        raise BadInput(
            f"a policy gives inputs of shape {np.shape(u)} for {n} measurements: give ({n}, {m})"
        )
    return u


def remembering(past: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Returns the past (n, memory, p) after measurements (n, p)."""
    return np.concatenate([past[:, 1:], measured[:, None]], axis=1) if past.shape[1] else past


def as_controller(loop: Controller | Policy) -> Controller:
    """Returns a controller itself, or a policy as a controller.

    Raises:
        BadInput: it is neither.
    """
    if isinstance(loop, Policy):
        return PolicyController(loop)
    if not callable(getattr(loop, "step", None)):
        raise BadInput(
            f"{loop!r:.80} can close no loop: give a controller or a policy, and a function as "
            "hyrl_mj.from_callable(function, task)"
        )
    return loop


def check_modes(q: np.ndarray, modes: Sequence[int]) -> np.ndarray:
    """Returns q (n,) itself; raises `BadInput` unless all of it is among `modes`."""
    unknown = q[~np.isin(q, modes)]
    if len(unknown):
        raise BadInput(f"mode {unknown[0]} is unknown: choose one of {tuple(modes)}")
    return q
