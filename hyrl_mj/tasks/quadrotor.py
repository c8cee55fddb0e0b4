"""A quadrotor: fly past a pillar at speed, on its left or on its right, to a gate behind it."""

from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.tasks.description import FullState, Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.flight import Rotors, rotation
from hyrl_mj.tasks.pillar import PillarTask
from hyrl_mj.tasks.registry import register


@register
class Quadrotor(PillarTask):
    name = "quadrotor"
    description = "fly past a pillar on its left or on its right (PPO)"
    coordinates, units, largest = ("x", "y", "drift"), ("m", "m", "m/s"), (1.2,)
    inputs, input_units = ("lateral_velocity",), ("m/s",)
    # Columns of the measurement: x, y, velocity to the side, tilt to the side, height.
    noisy = (1.0, 1.0, 0.0, 0.0, 0.0)
    max_steps = 80
    worst_reward = 0.0
    start_low, start_high = (0.0, -0.7, -0.3), (0.3, 0.7, 0.3)
    scene = Scene(
        starts=tuple((0.0, y, 0.0) for y in (-0.15, -0.055, 0.0, 0.055, 0.15)),
        time=3.4,
        mode_names=("left", "right"),
    )
    # The way lasts 60 samples and more, and only the last one tells whether a mode arrives.
    learning = Learning(
        levels=5,
        training={"samples": 200_000, "hidden": (64, 64)},
        modes={"gamma": 0.95},
    )
    mirror = Mirror((1, -1, -1, -1), (-1,))
    # The opening of the gate, and where in it 0.1 m are left on both sides [m].
    close, precision = 0.4, 0.3
    observation_low = (-5.0, -4.0, -6.0, -1.0)
    observation_high = (5.0, 4.0, 6.0, 1.0)

    @cached_property
    def cruise(self) -> tuple[float, float]:
        """Speed ahead [m/s] and height [m] that the inner loop keeps."""
        speed, height = (mjcf.numeric(self.model, name, 1)[0] for name in ("speed", "height"))
        return float(speed), float(height)

    @cached_property
    def rotors(self) -> Rotors:
        """The rotors and the loop that commands them."""
        return Rotors(self.model, lift=(0.5, 1.3))

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        tilt = rotation(sensors[:, 6:10])[:, 1, 2]
        return np.column_stack([sensors[:, [0, 1, 4]], tilt, sensors[:, 2]])

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        speed, height = self.cruise
        climb = 2.0 * (height - qpos[:, 2])
        velocity = np.column_stack([np.full(len(u), speed), u[:, 0], climb])
        return self.rotors.thrusts(velocity, qpos, qvel)

    def state(self, z: np.ndarray, rng: np.random.Generator | None = None) -> FullState:
        tilt = np.zeros(len(z)) if rng is None else rng.uniform(-1, 1, len(z)) * 0.05
        speed, height = self.cruise
        qpos, qvel = np.zeros((len(z), 7)), np.zeros((len(z), 6))
        qpos[:, :2], qpos[:, 2] = z[:, :2], height
        qpos[:, 3], qpos[:, 4] = np.cos(tilt / 2), np.sin(tilt / 2)
        qvel[:, 0], qvel[:, 1] = speed, z[:, 2]
        return qpos, qvel

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return np.hstack([self.obstacle[0] - measured[:, :1], measured[:, 1:4]])

    def measured(self, observation: np.ndarray) -> np.ndarray:
        height = np.full((len(observation), 1), self.cruise[1])  # no network reads it
        return np.hstack([self.obstacle[0] - observation[:, :1], observation[:, 1:], height])

    def clearance(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance of the hull from the pillar: (n,) [m]."""
        radii = sum(mjcf.geom_size(self.model, name)[0] for name in ("obstacle", "hull"))
        return np.asarray(np.linalg.norm(measured[:, :2] - self.obstacle, axis=1) - radii)

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        x, y = measurement[:, :2].T
        near = np.clip(1 - self.clearance(measurement) / 0.3, 0.0, 1.0)
        # Before the pillar y is free: else the middle would pay, and who gets there from one side passes on
        # the other.
        reward = np.maximum(3 - np.where(x < self.obstacle[0], 0.0, np.abs(y)) - near, 0.0)
        return np.where(self.failed(measurement), 0.0, reward)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        ends = super().ending(measurement)
        on_floor = measurement[:, 4] <= mjcf.geom_size(self.model, "hull")[0]
        ends[on_floor] = Outcome.CRASHED
        return ends
