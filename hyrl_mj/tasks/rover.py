"""A rover on wheels: drive past a pillar on its left or on its right, to a goal behind it."""

from functools import cached_property

import mujoco
import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.tasks.description import FullState, Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.flight import rotation
from hyrl_mj.tasks.pillar import PillarTask
from hyrl_mj.tasks.registry import register


class Wheels:
    """The two wheels of a rover.

    Args:
        model: the compiled model.

    Attributes:
        radius: of a wheel [m].
        half: half the distance between the two [m].
        height: of the rover's body [m].
    """

    def __init__(self, model: mujoco.MjModel):
        self.radius = float(mjcf.geom_size(model, "left_tyre")[0])
        self.half = float(model.body("left_wheel").pos[1])
        self.height = float(model.body("rover").pos[2])

    def rates(self, speed: np.ndarray | float, turn: np.ndarray) -> np.ndarray:
        """Returns rates (n, 2) of both wheels [rad/s] at a speed (n,) or one [m/s] and turns (n,) [rad/s]."""
        sides = [speed - turn * self.half, speed + turn * self.half]
        return np.stack(sides, axis=1) / self.radius

    def positions(self, pose: np.ndarray) -> np.ndarray:
        """Returns positions (n, 9) of all joints for poses x, y, heading (n, 3) [m, m, rad]."""
        (x, y, heading), nothing = pose.T, np.zeros(len(pose))
        turned = [np.cos(heading / 2), nothing, nothing, np.sin(heading / 2)]
        height = np.full(len(pose), self.height)
        return np.stack([x, y, height, *turned, nothing, nothing], axis=1)


def heading_of(attitude: np.ndarray) -> np.ndarray:
    """Returns the headings (n,) [rad] of quaternions (n, 4)."""
    axes = rotation(attitude)
    return np.asarray(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))


@register
class Rover(PillarTask):
    name = "rover"
    description = "drive on wheels past a pillar on its left or on its right (PPO)"
    coordinates, units, largest = ("x", "y", "heading"), ("m", "m", "rad"), (1.4,)
    inputs, input_units = ("turn_rate",), ("rad/s",)
    # Columns of the measurement: x, y, heading, rate of turn.
    noisy = (0.0, 1.0, 0.5, 0.0)
    max_steps = 110
    worst_reward = 0.0
    start_low, start_high = (0.0, -0.6, -0.3), (0.3, 0.6, 0.3)
    scene = Scene(
        starts=tuple((0.0, y, 0.0) for y in (-0.15, -0.055, 0.0, 0.055, 0.15)),
        time=5.0,
        mode_names=("left", "right"),
    )
    learning = Learning(levels=5, training={"samples": 200_000, "hidden": (64, 64)})
    steady_control = True
    mirror = Mirror((1, -1, -1), (-1,))
    close = 0.3
    observation_low = (-5.0, -3.0, -np.pi)
    observation_high = (5.0, 3.0, np.pi)

    @cached_property
    def wheels(self) -> Wheels:
        """The wheels that turn and move it."""
        return Wheels(self.model)

    @cached_property
    def speed(self) -> float:
        """Speed ahead [m/s]."""
        return float(mjcf.numeric(self.model, "speed", 1)[0])

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        return np.column_stack([sensors[:, :2], heading_of(sensors[:, 3:7]), sensors[:, 9]])

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return self.wheels.rates(self.speed, u[:, 0])

    def state(self, z: np.ndarray, rng: np.random.Generator | None = None) -> FullState:
        turn = np.zeros(len(z)) if rng is None else rng.uniform(-1, 1, len(z)) * 0.3
        heading, nothing = z[:, 2], np.zeros(len(z))
        ahead = [self.speed * np.cos(heading), self.speed * np.sin(heading), nothing]
        rates = self.wheels.rates(self.speed, turn)
        qvel = np.column_stack([*ahead, nothing, nothing, turn, rates])
        return self.wheels.positions(z), qvel

    def observation(self, measured: np.ndarray) -> np.ndarray:
        ahead = self.obstacle[0] - measured[:, :1]
        return np.hstack([ahead, measured[:, 1:3]])

    def measured(self, observation: np.ndarray) -> np.ndarray:
        unseen = np.zeros((len(observation), 1))
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
        near = np.clip(1 - self.clearance(measurement) / 0.25, 0.0, 1.0)
        # Before the pillar y is free: else the middle would pay, and who gets there from one side passes on
        # the other.
        off = np.where(x < self.obstacle[0], 0.0, np.abs(y)) + 0.15 * heading**2
        reward = np.maximum(3 - off - near, 0.0)
        # Arriving must pay more than going on in detours.
        reward = np.where(x >= self.set_point[0], 10 * reward, reward)
        return np.where(self.failed(measurement), 0.0, reward)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        ends = super().ending(measurement)
        astray = np.abs(measurement[:, 2]) >= self.largest[0]
        ends[astray & (ends != Outcome.CRASHED)] = Outcome.OUT_OF_BOUNDS
        return ends
