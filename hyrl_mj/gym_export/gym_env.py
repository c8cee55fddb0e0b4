"""The batched core as a Gymnasium environment and as a Gymnasium vector environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.physics import mjcf
from hyrl_mj.simulation import AnyNoise
from hyrl_mj.tasks import Outcome, Task, described_task

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def observation_space(task: Task) -> spaces.Box:
    """Returns the space of a task's observations."""
    low, high = np.array([task.observation_low, task.observation_high], dtype=np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def action_space(task: Task) -> spaces.Space[Any]:
    """Returns the space of a task's actions: levels, or inputs in physical units within the MJCF's limits."""
    if task.input_levels is not None:
        return spaces.Discrete(len(task.input_levels))
    low, high = task.input_limits
    return spaces.Box(np.float32(low), np.float32(high), dtype=np.float32)


class TaskEnv(gym.Env[np.ndarray, Any]):
    """One episode of a task, for `gymnasium.make`.

    `info["measured"]` (1, p) is the noisy measurement of which the observation is made, as controllers take
    it. An action may also be the input (m,) that a controller gives. `info["z"]` is the true chart point
    (d,). When an episode is over, `info["outcome"]` is "reached", "crashed", "out_of_bounds" or "stalled",
    and `info["is_success"]` whether it is "reached".

    `model` and `data` are MuJoCo's, as in environments of Gymnasium's own: who writes to the data moves it.

    Args:
        task: name of the task, or a file of one that this machine has run before.
        noise: measurement noise on the observation.
        render_mode: None or "rgb_array".
        camera: name of a camera of the MJCF, by default that of the task's scene.
        width, height: size of the rendered picture [pixels].

    Raises:
        BadInput: a value that cannot be used.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self,
        task: str,
        *,
        noise: AnyNoise | None = None,
        render_mode: str | None = None,
        camera: str | None = None,
        width: int = 640,
        height: int = 480,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise BadInput(f"render_mode {render_mode!r} is unknown: use None or 'rgb_array'")
        self.core = BatchedEnv(described_task(task), 1, noise=noise, threads=1)
        self.metadata = {**self.metadata, "render_fps": max(round(1 / self.core.task.dt), 1)}
        self.observation_space = observation_space(self.core.task)
        self.action_space = action_space(self.core.task)
        self.render_mode, self._size = render_mode, (width, height)
        self._camera = str(camera or self.core.task.scene.camera)
        mjcf.camera_of(self.core.task.model, self._camera)
        self._renderer: Any = None  # a `SceneRenderer`, opened by the first picture
        self.model = self.core.task.model
        self.data = mujoco.MjData(self.model)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode, at the chart point `options["z"]` if given."""
        super().reset(seed=seed)
        self.core.seed(int(self.np_random.integers(2**63)))
        observation = self.core.reset(z=starts(self.core.task, options))[0]
        self._show()
        return observation, self._info()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Applies one action for one sample; see `gymnasium.Env.step`."""
        self._take()
        result = self.core.step(self.core.inputs([action]))
        self._show()
        info = self._info()
        if result.done[0]:
            info["outcome"] = Outcome(result.outcome[0]).label
            info["is_success"] = bool(result.outcome[0] == Outcome.REACHED)
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0])
        return result.observation[0], float(result.reward[0]), terminated, truncated, info

    def _info(self) -> dict[str, Any]:
        return {"z": self.core.z[0], "measured": self.core.measured.copy()}

    def _get_obs(self) -> np.ndarray:
        """Returns the observation of the present state, as environments of Gymnasium's own have it."""
        self._take()
        measured = self.core.task.observation(self.core._measure(np.arange(1)))
        return np.asarray(measured[0].astype(np.float32))

    def _show(self) -> None:
        """Puts the state into MuJoCo's data, with what follows from it."""
        state = self.core.plant.state[0]
        mujoco.mj_setState(self.model, self.data, state, _STATE)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, state, _STATE)

    def _take(self) -> None:
        """Takes the state from MuJoCo's data, if somebody has written there."""
        state = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        if not np.array_equal(state, self.core.plant.state[0], equal_nan=True):
            self.core.plant.resume(state[None])

    def render(self) -> np.ndarray | None:
        """Returns the scene as (height, width, 3) uint8 in render mode "rgb_array", else None."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            from hyrl_mj.physics.rendering import SceneRenderer

            task = self.core.task
            self._renderer = SceneRenderer(task.model, *self._size, mocap=task.mocap)
        self._renderer.place(self.core.plant.qpos[0], self._camera)
        return self._renderer.draw()

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_renderer": None}  # a copy draws with a renderer of its own

    def close(self) -> None:
        """Frees the GL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class TaskVectorEnv(VectorEnv):
    """n episodes of a task at once, for `gymnasium.make_vec` with the mode "vector_entry_point".

    Episodes that end restart in the same step: `infos["final_obs"]` holds their last
    observations and `infos["final_info"]` their outcomes, both masked by `infos["_final_obs"]`. What a
    controller takes is `infos["measured"]` (n, p), and its inputs (n, m) may be actions.

    Args:
        task: name of the task, or a file of one that this machine has run before.
        num_envs: number of episodes n.
        noise, threads: as in `BatchedEnv`.
        max_episode_steps: samples until truncation, by default the task's limit.
        render_mode: None: many episodes at once draw no pictures.

    Raises:
        BadInput: a value that cannot be used.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        noise: AnyNoise | None = None,
        max_episode_steps: int | None = None,
        threads: int = 0,
        render_mode: None = None,
    ):
        if render_mode is not None:
            raise BadInput(
                f"render_mode {render_mode!r} cannot be used with many episodes at once: use gymnasium.make "
                'for one, or gymnasium.make_vec(..., vectorization_mode="sync")'
            )
        self.core = BatchedEnv(
            described_task(task),
            num_envs,
            noise=noise,
            max_steps=max_episode_steps,
            threads=threads,
        )
        self.num_envs, self.render_mode = self.core.n, None
        self.single_observation_space = observation_space(self.core.task)
        self.single_action_space = action_space(self.core.task)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes, at the chart points `options["z"]` (n, d) if given."""
        super().reset(seed=seed)
        if seed is not None:
            self.core.seed(seed)
        return self.core.reset(z=starts(self.core.task, options)), self._infos()

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Applies one action to each episode for one sample; see `VectorEnv.step`."""
        result = self.core.step(self.core.inputs(actions))
        observation, z = result.observation, self.core.z
        infos: dict[str, Any] = {}
        ended = np.flatnonzero(result.done)
        for i in ended:
            info = {"outcome": Outcome(result.outcome[i]).label, "z": z[i]}
            last = {"final_obs": observation[i].copy(), "final_info": info}
            infos = self._add_info(infos, last, int(i))
        if len(ended):
            observation[ended] = self.core.reset(ended)
        infos |= self._infos()
        return observation, result.reward, result.terminated, result.truncated, infos

    def _infos(self) -> dict[str, Any]:
        return {"z": self.core.z, "measured": self.core.measured.copy()}

    def render(self) -> None:
        """Returns None: many episodes at once draw no pictures."""


def starts(task: Task, options: dict[str, Any] | None) -> np.ndarray | None:
    """Returns the chart points `options["z"]`, checked, or None."""
    options = {} if options is None else options
    check_options(options)
    z = options.get("z")
    return None if z is None else task.chart.check(z, task.name)


def check_options(options: dict[str, Any]) -> None:
    """Raises `BadInput` unless the options of a reset hold nothing but a start "z"."""
    if not isinstance(options, dict):
        raise BadInput(
            f"options {options!r} cannot be used: give a dictionary with the start, as {{'z': z}}"
        )
    for name in options:
        if name != "z":
            raise unknown("option", name, ["z"])
