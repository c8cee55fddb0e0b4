"""The batched core as a Stable-Baselines3 `VecEnv`, for training."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.gym_env import action_space, check_options, observation_space, starts
from hyrl_mj.tasks import Outcome


class TaskVecEnv(VecEnv):
    """A `BatchedEnv` with SB3's conventions: reset in the same step, infos filled only at an end.

    Raises:
        BadInput: `core` is something else.
    """

    def __init__(self, core: BatchedEnv):
        if not isinstance(core, BatchedEnv):
            raise BadInput(f"{core!r} cannot be used: give a BatchedEnv(task, n)")
        self.core = core
        self.render_mode = None
        self._actions = np.zeros(0)
        self._returns = np.zeros(core.n)
        super().__init__(core.n, observation_space(core.task), action_space(core.task))

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Restarts the core's generator, which all episodes share."""
        self.core.seed(seed)
        return [seed] * self.num_envs

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Keeps the options of the next `reset`: one dictionary for each episode, or one for all.

        Raises:
            BadInput: options that no episode takes.
        """
        for each in options if isinstance(options, list) else [options or {}]:
            check_options(each)
        super().set_options(options)

    def reset(self) -> np.ndarray:
        """Starts all episodes, at chart points if `set_options([{"z": z}, ...])` has set one for each."""
        points = [options.get("z") for options in self._options]
        self._reset_options()
        default = all(point is None for point in points)
        self._returns[:] = 0
        return self.core.reset(z=starts(self.core.task, {} if default else {"z": points}))

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Advances all episodes; see `VecEnv.step_wait`."""
        result = self.core.step(self.core.inputs(self._actions))
        self._returns += result.reward
        observation, lengths = result.observation, self.core.samples
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(result.done)
        for i in ended:
            infos[i] = {
                "terminal_observation": observation[i].copy(),
                "TimeLimit.truncated": bool(result.truncated[i]),
                "episode": {"r": float(self._returns[i]), "l": int(lengths[i]), "t": 0.0},
                "outcome": Outcome(result.outcome[i]).label,
            }
        if len(ended):
            observation[ended] = self.core.reset(ended)
            self._returns[ended] = 0
        return observation, result.reward.astype(np.float32), result.done, infos

    def get_images(self) -> list[None]:
        """Returns None for each episode: many episodes at once draw no pictures."""
        return [None] * self.num_envs

    def close(self) -> None:
        """Does nothing: there are no resources to free."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Returns the core's attribute, once for each episode: they share it."""
        owner = self if attr_name == "render_mode" else self.core
        return [getattr(owner, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets the core's attribute for all episodes: they share it."""
        setattr(self.core, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Calls the core's method once and returns its result for each of the episodes."""
        result = getattr(self.core, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Returns True for `Monitor` alone, because this class records returns itself."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]
