"""A controller or a policy with SB3's `predict`: what `evaluate_policy` asks of a model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.errors import BadInput
from hyrl_mj.policies import Controller, Policy, as_controller, check_modes
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Sb3Policy:
    """A hybrid controller, or a policy, for those who evaluate with SB3. It takes no torch.

    The mode is the state that a recurrent policy of SB3 hands from one sample to the next. The
    measurement comes from `Task.measured`, and is as exact as the float32 of the observation: nearer
    than that to the edge of a flow set, the mode may jump where the controller itself would not.

    Attributes:
        task: the task whose environments it answers.
        controller: what is evaluated, a controller or a policy.
    """

    task: Task
    controller: Controller | Policy

    def predict(
        self,
        observation: ArrayLike,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """One sample: the mode jumps if it has to, and its policy acts.

        Args:
            observation: (k,), or (n, k) of n episodes, noise included.
            state: `(q,)` with the modes (n,) int that the last call returned, n = 1 for a single
                observation; None where all episodes start.
            episode_start: (n,) bool, or one for all: where it is true, the controller picks its mode
                from this measurement. By default nowhere, if there is a state.
            deterministic: for SB3's sake; the answer always is.

        Returns:
            The action that the task's environments take, levels () or (n,) int or inputs (m,) or (n, m)
            float32, and the next state `(q,)`.

        Raises:
            BadInput: wrong shapes, values that are not finite, unknown modes, an input that is no level
                of a discrete task, or a task without `measured`.
        """
        seen = self._check_observation(observation)
        measured = self.task.measured(np.atleast_2d(seen))
        u, q = self._loop.step(self._modes(measured, state, episode_start), measured)
        actions = self._actions(u)
        return actions.squeeze(axis=0) if seen.ndim == 1 else actions, (q,)

    @property
    def _loop(self) -> Controller:
        return as_controller(self.controller)

    def _check_observation(self, observation: ArrayLike) -> np.ndarray:
        """The observation as a float array (k,) or (n, k)."""
        columns = len(self.task.observation_low)
        try:
            seen = np.asarray(observation, dtype=float)
        except (TypeError, ValueError):
            raise BadInput(
                f"an observation of {self.task.name} is {columns} numbers, got {observation!r}"
            ) from None
        if seen.ndim not in (1, 2) or seen.shape[-1] != columns:
            raise BadInput(
                f"an observation of {self.task.name} has shape ({columns},) or (n, {columns}), "
                f"got {seen.shape}"
            )
        if not np.isfinite(seen).all():
            raise BadInput(
                f"observation {seen[~np.isfinite(seen)][0]} cannot be used: it must be finite"
            )
        return seen

    def _modes(
        self,
        measured: np.ndarray,
        state: tuple[np.ndarray, ...] | None,
        episode_start: ArrayLike | None,
    ) -> np.ndarray:
        """The modes (n,) in which measurements (n, p) find the controller."""
        n = len(measured)
        if state is None:
            return self._loop.initial_mode(measured)
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
            q[starts] = self._loop.initial_mode(measured[starts])
        return check_modes(q, self._loop.modes).astype(int)

    def _actions(self, u: np.ndarray) -> np.ndarray:
        """The actions that inputs u (n, m) are: levels (n,) of a discrete task, else themselves."""
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
