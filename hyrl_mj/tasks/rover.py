"""A rover on wheels: drive past a pillar on its left or on its right, to a goal behind it."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.chart import Chart
from hyrl_mj.tasks.base import Mirror, Outcome, Task
from hyrl_mj.tasks.learning import Learning
from hyrl_mj.tasks.registry import register
from hyrl_mj.tasks.scene import Scene

# Largest heading [rad], and distance from the pillar within which the reward is less [m].
ASTRAY, NEAR = 1.4, 0.25
# Weights of the reward: of arriving (in samples), of the distance off the middle before the pillar [1/m],
# of the heading [1/rad2].
FINISH, BEFORE, TURNED = 10, 0.5, 0.15
# Largest rate of turn of a start [rad/s].
START_RATE = 0.3


@register
class Rover(Task):
    name = "rover"
    description = "drive on wheels past a pillar on its left or on its right (DQN)"
    inputs, input_units = ("turn_rate",), ("rad/s",)
    # Columns of the measurement: x, y, heading, rate of turn, touching the pillar.
    noisy = (0.0, 1.0, 0.5, 0.0, 0.0)
    max_steps = 110
    worst_reward = 0.0
    start_low, start_high = (0.0, -0.6, -0.3), (0.3, 0.6, 0.3)
    scene = Scene(
        starts=tuple((0.0, y, 0.0) for y in (-0.15, -0.055, 0.0, 0.055, 0.15)),
        time=5.0,
        mode_names=("left", "right"),
    )
    learning = Learning(levels=5)
    mirror = Mirror((1, -1, -1), (-1,))
    close = 0.3
    observation_low = (-5.0, -3.0, -np.pi)
    observation_high = (5.0, 3.0, np.pi)

    @cached_property
    def chart(self) -> Chart:  # type: ignore[override]
        centre, half = mjcf.site_pos(self.model, "arena"), mjcf.site_size(self.model, "arena")
        low, high = (centre - half)[:2], (centre + half)[:2]
        return Chart(
            ("x", "y", "heading"),
            ("m", "m", "rad"),
            (*low, -ASTRAY),
            (*high, ASTRAY),
            (False, False, False),
        )

    @cached_property
    def set_point(self) -> np.ndarray:
        """The goal, with the heading straight ahead (3,) [m, m, rad]."""
        return np.append(mjcf.site_pos(self.model, "set_point")[:2], 0.0)

    @cached_property
    def obstacle(self) -> np.ndarray:
        """Centre of the pillar (2,) [m]."""
        return mjcf.geom_pos(self.model, "obstacle")[:2]

    @cached_property
    def wheels(self) -> tuple[float, float, float]:
        """Radius of a wheel, half the distance between the two [m], speed of the rover [m/s]."""
        radius = float(mjcf.geom_size(self.model, "left_tyre")[0])
        return radius, float(self.model.body("left_wheel").pos[1]), self.speed

    @cached_property
    def speed(self) -> float:
        """Speed ahead [m/s]."""
        return float(mjcf.numeric(self.model, "speed", 1)[0])

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        heading = np.arctan2(sensors[:, 4], sensors[:, 3])
        return np.column_stack([sensors[:, :2], heading, sensors[:, 8], sensors[:, 9]])

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return self.rates(u[:, 0])

    def rates(self, turn: np.ndarray) -> np.ndarray:
        """Returns rates (n, 2) of both wheels [rad/s] that turn the rover at rates (n,) [rad/s]."""
        radius, half, speed = self.wheels
        return np.stack([speed - turn * half, speed + turn * half], axis=1) / radius

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        turn = np.zeros(len(z)) if rng is None else rng.uniform(-1, 1, len(z)) * START_RATE
        x, y, heading = z.T
        nothing = np.zeros(len(z))
        height = np.full(len(z), self.model.body("rover").pos[2])
        turned = [np.cos(heading / 2), nothing, nothing, np.sin(heading / 2)]
        qpos = np.stack([x, y, height, *turned, nothing, nothing], axis=1)
        ahead = [self.speed * np.cos(heading), self.speed * np.sin(heading), nothing]
        qvel = np.column_stack([*ahead, nothing, nothing, turn, self.rates(turn)])
        return qpos, qvel

    def z(self, measured: np.ndarray) -> np.ndarray:
        return measured[:, :3]

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.hstack([z, measured[:, 3:]])

    def observation(self, measured: np.ndarray) -> np.ndarray:
        ahead = self.obstacle[0] - measured[:, :1]
        return np.hstack([ahead, measured[:, 1:3]])

    def measured(self, observation: np.ndarray) -> np.ndarray:
        unseen = np.zeros((len(observation), 2))
        return np.hstack([self.obstacle[0] - observation[:, :1], observation[:, 1:], unseen])

    def clearance(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance of the bumper from the pillar: (n,) [m]."""
        bumper = mjcf.geom_pos(self.model, "bumper")[0]
        heading = measured[:, 2]
        middle = measured[:, :2] + bumper * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        radii = sum(mjcf.geom_size(self.model, name)[0] for name in ("obstacle", "bumper"))
        return np.asarray(np.linalg.norm(middle - self.obstacle, axis=1) - radii)

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        x, y, heading = measurement[:, :3].T
        near = np.clip(1 - self.clearance(measurement) / NEAR, 0.0, 1.0)
        # A full weight before the pillar would draw the rover to the middle, where it decides late.
        off = np.abs(y) * np.where(x < self.obstacle[0], BEFORE, 1.0) + TURNED * heading**2
        reward = np.maximum(3 - off - near, 0.0)
        # Arriving must pay more than going on in detours.
        reward = np.where(x >= self.set_point[0], FINISH * reward, reward)
        return np.where(self.failed(measurement), 0.0, reward)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        x, y, heading, _, touching = measurement.T
        ends = np.full(len(measurement), Outcome.RUNNING)
        ends[x >= self.set_point[0]] = Outcome.REACHED
        ends[(np.abs(y) >= self.chart.high[1]) | (np.abs(heading) >= ASTRAY)] = (
            Outcome.OUT_OF_BOUNDS
        )
        ends[(touching > 0) | (self.clearance(measurement) <= 0)] = Outcome.CRASHED
        return ends

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.abs(z[:, 1] - self.set_point[1])

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        return -self.clearance(measurement)
