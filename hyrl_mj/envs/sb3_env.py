"""The batched core as a Stable-Baselines3 `VecEnv`: what training uses."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from hyrl_mj.envs.core import BatchedEnv
from hyrl_mj.envs.gym_env import action_space, observation_space
from hyrl_mj.tasks import Outcome


class TaskVecEnv(VecEnv):
    """SB3's conventions on a `BatchedEnv`: reset in the same step, infos filled only at an end."""

    def __init__(self, core: BatchedEnv):
        self.core = core
        self.render_mode = None
        self._actions = np.zeros(0)
        self._returns, self._lengths = np.zeros(core.n), np.zeros(core.n, dtype=int)
        super().__init__(core.n, observation_space(core.task), action_space(core.task))

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Restart the core's generator; one serves all episodes."""
        self.core.seed(seed)
        return [seed] * self.num_envs

    def reset(self) -> np.ndarray:
        """Start all episodes, at chart points if `set_options([{"z": z}, ...])` gave one to each."""
        given = [options.get("z") for options in self._options]
        self._reset_options()
        task, default = self.core.task, all(point is None for point in given)
        z = None if default else task.chart.check(given, task.name)
        self._returns[:], self._lengths[:] = 0, 0
        return self.core.reset(z=z)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Advance all episodes; see `VecEnv.step_wait`."""
        result = self.core.step(self.core.inputs(self._actions))
        self._returns += result.reward
        self._lengths += 1
        observation, done = result.observation, result.done
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(done)
        for i in ended:
            infos[i] = {
                "terminal_observation": observation[i].copy(),
                "TimeLimit.truncated": bool(result.truncated[i]),
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i]), "t": 0.0},
                "outcome": Outcome(result.outcome[i]).label,
            }
        if len(ended):
            observation[ended] = self.core.reset(ended)
            self._returns[ended], self._lengths[ended] = 0, 0
        return observation, result.reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to give back."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The core's attribute, once an episode: they share it."""
        owner = self if attr_name == "render_mode" else self.core
        return [getattr(owner, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set the core's attribute, for all episodes: they share it."""
        setattr(self.core, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call the core's method once and give its answer to each episode asked for."""
        answer = getattr(self.core, method_name)(*args, **kwargs)
        return [answer] * len(self._indices(indices))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """No episode is wrapped, except that returns are monitored here already."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor)] * len(self._indices(indices))

    def _indices(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))
