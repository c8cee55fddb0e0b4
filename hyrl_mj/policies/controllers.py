"""The interface of a controller, and a single policy as a controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.policies.functions import check_act, declares_memory
from hyrl_mj.policies.mlp import MemoryPolicy, Policy


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

    One with memory acts with it in closed loops, which ask by `answer`; `step` answers without it.
    """

    policy: Policy

    @property
    def modes(self) -> tuple[int, ...]:
        return (0,)

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        return np.zeros(len(measured), dtype=int)

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.policy.act(measured), q


def memory_at_start(controller: Controller, n: int) -> np.ndarray:
    """Returns the memory (n, ...) of n runs at their start; most controllers have none, (n, 0)."""
    policy = controller.policy if isinstance(controller, PolicyController) else None
    return np.array(policy.start(n) if isinstance(policy, MemoryPolicy) else np.zeros((n, 0)))


def is_memory(memory: np.ndarray) -> bool:
    """Returns whether a memory (n, ...) holds anything."""
    return 0 not in memory.shape[1:]


def answer(
    controller: Controller, q: np.ndarray, measured: np.ndarray, memory: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns inputs (n, m), next modes (n,) and the next memory (n, ...) of a controller.

    The memory that it is given stays as it is, so that asking changes no run.
    """
    if is_memory(memory) and isinstance(controller, PolicyController):
        assert isinstance(controller.policy, MemoryPolicy)
        u, memory = controller.policy.act_after(memory, measured)
        return u, q, memory
    return *controller.step(q, measured), memory


def check_inputs(u: np.ndarray, n: int, m: int) -> np.ndarray:
    """Returns inputs for n measurements themselves; raises `BadInput` unless their shape is (n, m)."""
    if np.shape(u) != (n, m):
        raise BadInput(
            f"a policy gives inputs of shape {np.shape(u)} for {n} measurements: give ({n}, {m})"
        )
    return u


def as_controller(loop: Controller | Policy) -> Controller:
    """Returns a controller itself, or a policy as a controller.

    Raises:
        BadInput: it is neither.
    """
    if not declares_memory(loop):
        if isinstance(loop, Policy):
            check_act(loop)
            return PolicyController(loop)
        if callable(getattr(loop, "step", None)):
            return loop
    raise BadInput(
        f"{loop!r:.80} can close no loop: give a controller or a policy, and a function or an agent with a "
        "memory as hyrl_mj.from_callable(function, task)"
    )


def check_modes(q: np.ndarray, modes: Sequence[int]) -> np.ndarray:
    """Returns q (n,) itself; raises `BadInput` unless all of it is among `modes`."""
    unknown = q[~np.isin(q, modes)]
    if len(unknown):
        raise BadInput(f"mode {unknown[0]} is unknown: choose one of {tuple(modes)}")
    return q
