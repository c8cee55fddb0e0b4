"""Tasks in the plane: pass a pillar, or several posts, each on its left or on its right, to a goal behind."""

from abc import abstractmethod
from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import Learning, Outcome


class PillarTask(Task):
    """A task whose MJCF has the geom "obstacle", and the sites "set_point" and "arena".

    Chart and measurement begin with x and y.
    """

    #: names and units of the chart's coordinates, and the largest magnitude of each one after x and y
    coordinates: tuple[str, ...] = ("x", "y")
    units: tuple[str, ...] = ("m", "m")
    largest: tuple[float, ...] = ()
    #: whether those after x and y live on a circle
    periodic: bool = False
    #: how far before a line the robot is on it [m]; kinematic actuators add up an error of 1e-6 in an episode
    on_the_line: float = 0.0

    @cached_property
    def chart(self) -> Chart:  # type: ignore[override]
        low = (*self.arena[0], *(-value for value in self.largest))
        high = (*self.arena[1], *self.largest)
        periodic = (False, False, *[self.periodic] * len(self.largest))
        return Chart(self.coordinates, self.units, low, high, periodic)

    @cached_property
    def arena(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the arena (2,), (2,) [m]."""
        centre, half = mjcf.site_pos(self.model, "arena"), mjcf.site_size(self.model, "arena")
        return (centre - half)[:2], (centre + half)[:2]

    @cached_property
    def set_point(self) -> np.ndarray:
        """The goal (d,), with zeros after x and y."""
        return np.append(mjcf.site_pos(self.model, "set_point")[:2], np.zeros(len(self.largest)))

    @cached_property
    def obstacle(self) -> np.ndarray:
        """Centre of the pillar (2,) [m]."""
        return mjcf.geom_pos(self.model, "obstacle")[:2]

    @abstractmethod
    def clearance(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance of the robot from the pillar: (n,) [m]."""

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        x, y = measurement[:, :2].T
        ends = np.full(len(measurement), Outcome.RUNNING)
        ends[x >= self.set_point[0] - self.on_the_line] = Outcome.REACHED
        ends[np.abs(y) >= self.chart.high[1] - self.on_the_line] = Outcome.OUT_OF_BOUNDS
        ends[self.clearance(measurement) <= 0] = Outcome.CRASHED
        return ends

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.abs(z[:, 1] - self.set_point[1])

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        return -self.clearance(measurement)


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
