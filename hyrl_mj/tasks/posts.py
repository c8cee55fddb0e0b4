"""Tasks in the plane: drive the paper's vehicle past several posts, to a line behind them."""

from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.tasks.description import Learning
from hyrl_mj.tasks.pillar import PillarTask


class PostsTask(PillarTask):
    """A vehicle, x' = 1 m/s and y' = u, among round posts: the geoms whose names begin with "obstacle"."""

    inputs, input_units = ("lateral_velocity",), ("m/s",)
    noisy = (False, True)
    worst_reward, on_the_line = 0.0, 1e-6
    learning = Learning(levels=5)

    @cached_property
    def posts(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (K, 2) and radii (K,) of the posts [m]."""
        names = mjcf.obstacles(self.model)
        centres = np.array([mjcf.geom_pos(self.model, name)[:2] for name in names])
        return centres, np.array([mjcf.geom_size(self.model, name)[0] for name in names])

    @cached_property
    def observation_low(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(2 * self.arena[0] - self.arena[1])

    @cached_property
    def observation_high(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(2 * self.arena[1] - self.arena[0])

    def clearance(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance to the nearest post: (n,) [m]; negative inside."""
        centres, radii = self.posts
        away = measured[:, None, :2] - centres
        return np.asarray((np.sqrt((away * away).sum(axis=2)) - radii).min(axis=1))

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return measured

    def measured(self, observation: np.ndarray) -> np.ndarray:
        return observation

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        wall = self.arena[1][1] - np.abs(measurement[:, 1])
        # The last 0.2 m to a post or a wall cost up to 1.
        near = np.clip(1 - np.minimum(self.clearance(measurement), wall) / 0.2, 0.0, 1.0)
        # Inputs cost a little, so that turning early costs less than turning late.
        reward = 1.5 - 0.1 * np.abs(u[:, 0]) - near
        return np.where(self.failed(measurement), 0.0, reward)

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.maximum(self.set_point[0] - z[:, 0], 0.0)  # the goal is a line
