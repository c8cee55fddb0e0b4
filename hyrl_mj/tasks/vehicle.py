"""Obstacle avoidance: drive past a pillar on its left or on its right (paper, Example 2)."""

from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.tasks.description import Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.obstacles import length
from hyrl_mj.tasks.pillar import PillarTask
from hyrl_mj.tasks.registry import register


@register
class Vehicle(PillarTask):
    name = "vehicle"
    env_id = "hyrl_mj/ObstacleAvoidance-v0"
    description = "drive past a pillar on its left or on its right (DQN)"
    inputs, input_units = ("lateral_velocity",), ("m/s",)
    noisy = (False, True)
    max_steps = 60
    worst_reward, on_the_line = 0.0, 1e-6
    start_low, start_high = (0.0, -1.0), (0.5, 1.0)
    precision, close = 0.04, 0.2
    scene = Scene(
        starts=((0.0, -0.15), (0.0, -0.055), (0.0, 0.0), (0.0, 0.055), (0.0, 0.15)),
        time=3.0,
        mode_names=("left", "right"),
        policy_starts=((0.0, -0.15), (0.0, 0.0), (0.0, 0.15)),
    )
    learning = Learning(algorithm="dqn", levels=5, search="rods", horizon=0.3)
    mirror = Mirror((1, 1, -1), (-1,))

    @cached_property
    def radius(self) -> float:
        """Radius of the obstacle [m]."""
        return float(mjcf.geom_size(self.model, "obstacle")[0])

    @cached_property
    def observation_low(self) -> tuple[float, ...]:  # type: ignore[override]
        return (0.0, 0.0, 2 * self.arena[0][1])

    @cached_property
    def observation_high(self) -> tuple[float, ...]:  # type: ignore[override]
        diagonal = float(np.linalg.norm(self.arena[1] - self.arena[0]))
        return (2 * diagonal, 2 * diagonal, 2 * self.arena[1][1])

    def clearance(self, z: np.ndarray) -> np.ndarray:
        """Returns the distance to the obstacle's surface, d_o: (n,) [m]."""
        return np.maximum(length(z - self.obstacle) - self.radius, 0.0)

    def distance_to_go(self, z: np.ndarray) -> np.ndarray:
        """Returns the distance to the set-point, d_g: (n,) [m]."""
        return length(z - self.set_point)

    def observation(self, measured: np.ndarray) -> np.ndarray:
        seen = np.empty((len(measured), 3))
        seen[:, 0] = self.clearance(measured)
        seen[:, 1] = self.distance_to_go(measured)
        seen[:, 2] = measured[:, 1]
        return seen

    def measured(self, observation: np.ndarray) -> np.ndarray:
        d_o, d_g, y = observation.T
        (x_o, y_o), (x_g, y_g) = self.obstacle, self.set_point
        # The squared distances along x from obstacle and set-point.
        to_obstacle = (d_o + self.radius) ** 2 - (y - y_o) ** 2
        to_go = d_g**2 - (y - y_g) ** 2
        x = (x_o + x_g) / 2 + (to_obstacle - to_go) / (2 * (x_g - x_o))
        # Inside the obstacle, where noise may put a measurement, the clearance is always 0.
        inside = x_g - np.sqrt(np.maximum(to_go, 0.0))
        return np.stack([np.where(d_o > 0, x, inside), y], axis=1)

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        d_o = self.clearance(measurement)
        barrier = (d_o - 1.5) ** 2 - np.log(np.maximum(d_o, 1e-6))
        return np.maximum(0.0, 3.5 - self.distance_to_go(measurement) - 0.1 * barrier)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        x, y = measurement.T
        (low, high), slack = self.arena, self.on_the_line
        ends = np.full(len(measurement), Outcome.RUNNING)
        ends[x > self.set_point[0] + slack] = Outcome.REACHED
        ends[(y <= low[1] + slack) | (y >= high[1] - slack)] = Outcome.OUT_OF_BOUNDS
        ends[self.clearance(measurement) <= 1e-3] = Outcome.CRASHED
        return ends

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        passed = measurement[:, 0] >= self.set_point[0] - self.on_the_line
        return np.where(passed, Outcome.REACHED, Outcome.RUNNING)

    def direction(self, path: np.ndarray) -> np.ndarray:
        # Runs start before the pillar; one that never comes beside it is judged by its last point.
        beside = path[:, :, 0] >= self.obstacle[0]
        when = np.where(beside.any(axis=0), beside.argmax(axis=0), len(path) - 1)
        y = path[when, np.arange(path.shape[1]), 1]
        return np.where(beside[0], -1, np.where(y > self.obstacle[1], 0, 1))
