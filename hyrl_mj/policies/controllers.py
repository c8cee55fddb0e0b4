"""The interface of a controller, and a single policy as a controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.policies.mlp import Policy


class Controller(Protocol):
    """A pure function of mode and measurement; see `hyrl_mj.stages.hybrid.HybridController`."""

    @property
    def modes(self) -> tuple[int, ...]:
        """The numbers of its modes."""

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        """Returns the modes (n,) to start in, from the first measurements (n, p)."""

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,) for modes (n,) and measurements (n, p)."""


@dataclass(frozen=True)
class PolicyController:
    """A single policy as a controller with one mode, 0, that never jumps."""

    policy: Policy

    @property
    def modes(self) -> tuple[int, ...]:
        return (0,)

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        return np.zeros(len(measured), dtype=int)

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.policy.act(measured), q


def as_controller(loop: Controller | Policy) -> Controller:
    """Returns a controller itself, or a policy as a controller."""
    return PolicyController(loop) if isinstance(loop, Policy) else loop


def check_modes(q: np.ndarray, modes: Sequence[int]) -> np.ndarray:
    """Returns q (n,) itself; raises `BadInput` unless all of it is among `modes`."""
    unknown = q[~np.isin(q, modes)]
    if len(unknown):
        raise BadInput(f"mode {unknown[0]} is unknown: choose one of {tuple(modes)}")
    return q
