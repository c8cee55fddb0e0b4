"""A quadrotor: fly past a pillar at speed, on its left or on its right, to a gate behind it."""

from functools import cached_property

import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.tasks.description import Learning, Mirror, Scene
from hyrl_mj.tasks.pillar import PillarTask
from hyrl_mj.tasks.registry import register

# Gains of the inner loop: velocity, height, tilt and its rate [1/s, 1/s, 1/s^2, 1/s].
VELOCITY, HEIGHT, TILT, RATE = 4.0, 2.0, 225.0, 24.0
# Largest tilt that the inner loop commands, as sideways over upward acceleration.
STEEPEST = 0.6
# Distance from the pillar within which the reward is less [m]; largest drift to the side in the chart [m/s].
NEAR, FASTEST = 0.3, 1.2
# Largest tilt to the side of a start [rad].
START_TILT = 0.05


@register
class Quadrotor(PillarTask):
    name = "quadrotor"
    description = "fly past a pillar on its left or on its right (DQN)"
    coordinates, units, largest = ("x", "y", "drift"), ("m", "m", "m/s"), (FASTEST,)
    inputs, input_units = ("lateral_velocity",), ("m/s",)
    # Columns of the measurement: x, y, velocity to the side, tilt to the side, touching pillar or floor.
    noisy = (1.0, 1.0, 0.0, 0.0, 0.0)
    max_steps = 80
    worst_reward = 0.0
    start_low, start_high = (0.0, -0.7, -0.3), (0.3, 0.7, 0.3)
    scene = Scene(
        starts=tuple((0.0, y, 0.0) for y in (-0.15, -0.055, 0.0, 0.055, 0.15)),
        time=3.4,
        mode_names=("left", "right"),
    )
    learning = Learning(levels=5)
    mirror = Mirror((1, -1, -1, -1), (-1,))
    close = 0.4
    observation_low = (-5.0, -4.0, -6.0, -1.0)
    observation_high = (5.0, 4.0, 6.0, 1.0)

    @cached_property
    def cruise(self) -> tuple[float, float]:
        """Speed ahead [m/s] and height [m] that the inner loop keeps."""
        speed, height = (mjcf.numeric(self.model, name, 1)[0] for name in ("speed", "height"))
        return float(speed), float(height)

    @cached_property
    def mixer(self) -> np.ndarray:
        """The matrix (4, 4) from thrust [N] and torques about the body's axes [Nm] to the rotors' thrusts."""
        gear = self.model.actuator_gear
        arm = self.model.site_pos[self.model.actuator_trnid[:, 0]]
        # A rotor at (x, y) with thrust f turns the body by (y f, -x f) about its x and y axis.
        return np.linalg.inv(np.stack([gear[:, 2], arm[:, 1], -arm[:, 0], gear[:, 5]]))

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        return sensors[:, [0, 1, 4, 7, 9]]

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The inner loop from velocity over tilt to the thrusts of the rotors (n, 4) [N]."""
        body = self.model.body("quadrotor")
        (speed, height), gravity = self.cruise, -self.model.opt.gravity[2]
        axes = rotation(qpos[:, 3:7])
        climb = HEIGHT * (height - qpos[:, 2])
        error = np.column_stack([np.full(len(u), speed), u[:, 0], climb]) - qvel[:, :3]
        push = VELOCITY * error + [0.0, 0.0, gravity]
        push[:, 2] = np.clip(push[:, 2], 0.5 * gravity, 1.3 * gravity)
        sideways = np.linalg.norm(push[:, :2], axis=1)
        room = STEEPEST * push[:, 2]
        push[:, :2] *= np.minimum(1.0, room / np.maximum(sideways, 1e-9))[:, None]
        up = axes[:, :, 2]
        thrust = body.mass * (push * up).sum(axis=1)
        # The rotation, in the body's axes, from the body's up to the direction of the push, and to yaw 0.
        goal = push / np.linalg.norm(push, axis=1, keepdims=True)
        turn = np.einsum("nji,nj->ni", axes, np.cross(up, goal))
        turn[:, 2] = -np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
        torque = body.inertia * (TILT * turn - RATE * qvel[:, 3:6])
        return self.share_out(thrust, torque)

    def share_out(self, thrust: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Returns thrusts (n, 4) of the rotors [N] within their limits, for a thrust (n,) and torques (n, 3).

        Where the limits do not allow both, the torques [Nm] come before the thrust [N].
        """
        most = self.model.actuator_ctrlrange[0, 1]
        turning = torque @ self.mixer[:, 1:].T
        spread = turning.max(axis=1) - turning.min(axis=1)
        turning *= np.minimum(1.0, most / np.maximum(spread, 1e-9))[:, None]
        even = thrust * self.mixer[0, 0]
        even = np.clip(even, -turning.min(axis=1), most - turning.max(axis=1))
        return even[:, None] + turning

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        tilt = np.zeros(len(z)) if rng is None else rng.uniform(-1, 1, len(z)) * START_TILT
        speed, height = self.cruise
        qpos, qvel = np.zeros((len(z), 7)), np.zeros((len(z), 6))
        qpos[:, :2], qpos[:, 2] = z[:, :2], height
        qpos[:, 3], qpos[:, 4] = np.cos(tilt / 2), np.sin(tilt / 2)
        qvel[:, 0], qvel[:, 1] = speed, z[:, 2]
        return qpos, qvel

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return np.hstack([self.obstacle[0] - measured[:, :1], measured[:, 1:4]])

    def measured(self, observation: np.ndarray) -> np.ndarray:
        unseen = np.zeros((len(observation), 1))
        return np.hstack([self.obstacle[0] - observation[:, :1], observation[:, 1:], unseen])

    def clearance(self, measured: np.ndarray) -> np.ndarray:
        """Returns the distance of the hull from the pillar: (n,) [m]."""
        radii = sum(mjcf.geom_size(self.model, name)[0] for name in ("obstacle", "hull"))
        return np.asarray(np.linalg.norm(measured[:, :2] - self.obstacle, axis=1) - radii)

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        near = np.clip(1 - self.clearance(measurement) / NEAR, 0.0, 1.0)
        reward = np.maximum(3 - np.abs(measurement[:, 1]) - near, 0.0)
        return np.where(self.failed(measurement), 0.0, reward)


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Returns rotation matrices (n, 3, 3) of unit quaternions (n, 4): columns are the body's axes."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
