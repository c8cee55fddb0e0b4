"""A controller or a policy with SB3's `predict`, for `evaluate_policy`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.errors import BadInput
from hyrl_mj.policies import (
    Controller,
    Policy,
    as_controller,
    check_modes,
    is_memory,
    memory_at_start,
)
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Sb3Policy:
    """A hybrid controller or a policy, for evaluation with SB3 on environments of a task, without torch.

    The mode is passed from one sample to the next as the state of SB3's recurrent policies. The measurement
    comes from `Task.measured`, with the precision of float32 observations: closer than that to the edge of a
    flow set, the mode may jump where the controller itself would not.
    """

    task: Task
    controller: Controller | Policy

    def __post_init__(self) -> None:
        if is_memory(memory_at_start(as_controller(self.controller), 1)):
            raise BadInput(
                "the policy has a memory, and SB3 only passes on its mode: use hyrl_mj.simulate or "
                "closed_loop, where it has its memory"
            )

    def predict(
        self,
        observation: ArrayLike,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Returns the actions of one sample, after the jumps of the modes, and the next state.

        Args:
            observation: (k,), or (n, k) of n episodes, noise included.
            state: `(q,)` with the modes (n,) int that the last call returned, n = 1 for a single
                observation; None where all episodes start.
            episode_start: (n,) bool, or one for all: where it is true, the controller picks its mode
                from this measurement. By default false, if there is a state.
            deterministic: ignored, because actions are always deterministic.

        Returns:
            Levels () or (n,) int, or inputs (m,) or (n, m) float32; and the next state `(q,)`.

        Raises:
            BadInput: wrong shapes, values that are not finite, unknown modes, an input that is no level
                of a discrete task, or a task without `measured`.
        """
        checked = self._check_observation(observation)
        measured = self.task.measured(np.atleast_2d(checked))
        loop = as_controller(self.controller)
        u, q = loop.step(_modes(loop, measured, state, episode_start), measured)
        actions = self._actions(u)
        return actions.squeeze(axis=0) if checked.ndim == 1 else actions, (q,)

    def _check_observation(self, observation: ArrayLike) -> np.ndarray:
        """Returns the observation as a float array (k,) or (n, k)."""
        columns, what = len(self.task.observation_low), f"an observation of {self.task.name}"
        try:
            values = np.asarray(observation, dtype=float)
        except (TypeError, ValueError):
            raise BadInput(f"{what} is {columns} numbers, got {observation!r}") from None
        if values.ndim not in (1, 2) or values.shape[-1] != columns:
            raise BadInput(f"{what} has shape ({columns},) or (n, {columns}), got {values.shape}")
        bad = values[~np.isfinite(values)]
        if len(bad):
            raise BadInput(f"observation {bad[0]} cannot be used: it must be finite")
        return values

    def _actions(self, u: np.ndarray) -> np.ndarray:
        """Returns the actions of inputs u (n, m): levels (n,) of a discrete task, else the inputs."""
        levels = self.task.input_levels
        if levels is None:
            return u.astype(np.float32)
        actions = np.abs(u[:, None] - levels).max(axis=2).argmin(axis=1)
        off = ~np.isclose(levels[actions], u).all(axis=1)
        if off.any():
            raise BadInput(
                f"input {u[off][0]} is none of the {len(levels)} levels that {self.task.name} takes"
            )
        return actions


def _modes(
    loop: Controller,
    measured: np.ndarray,
    state: tuple[np.ndarray, ...] | None,
    episode_start: ArrayLike | None,
) -> np.ndarray:
    """Returns the modes (n,) of a controller before measurements (n, p)."""
    n = len(measured)
    if state is None:
        return loop.initial_mode(measured)
    if not isinstance(state, tuple) or len(state) != 1 or np.shape(state[0]) != (n,):
        raise BadInput(
            f"{n} observation(s) need the state (q,) with the modes q of shape ({n},), got {state!r}"
        )
    starts = np.asarray(False if episode_start is None else episode_start, dtype=bool)
    if starts.shape not in ((), (n,)):
        raise BadInput(
            f"{n} observation(s) need an episode_start of shape ({n},), got {starts.shape}"
        )
    starts, q = np.broadcast_to(starts, n), np.array(state[0])
    if starts.any():
        q[starts] = loop.initial_mode(measured[starts])
    return check_modes(q, loop.modes).astype(int)
