"""What flies on four rotors: the inner loop from a wanted velocity to the thrusts, for robots of one body."""

from functools import cached_property

import mujoco
import numpy as np


class Rotors:
    """The rotors of the body "quadrotor" (`models/common/quadrotor.xml`), and the loop that commands them.

    Args:
        model: the compiled MJCF.
        lift: least and largest upward thrust that the loop commands, as shares of the weight.
    """

    def __init__(self, model: mujoco.MjModel, lift: tuple[float, float]):
        self.model, self.lift = model, lift

    @cached_property
    def mixer(self) -> np.ndarray:
        """The matrix (4, 4) from thrust [N] and torques about the body's axes [Nm] to the rotors' thrusts."""
        gear = self.model.actuator_gear
        arm = self.model.site_pos[self.model.actuator_trnid[:, 0]]
        # A rotor at (x, y) with thrust f turns the body by (y f, -x f) about its x and y axis.
        return np.linalg.inv(np.stack([gear[:, 2], arm[:, 1], -arm[:, 0], gear[:, 5]]))

    @cached_property
    def body(self) -> tuple[float, np.ndarray]:
        """Mass [kg] and principal moments of inertia (3,) [kg m2] of the robot."""
        body = self.model.body("quadrotor")
        return float(body.mass[0]), body.inertia.copy()

    def thrusts(self, velocity: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Returns the thrusts of the rotors (n, 4) [N] towards a velocity (n, 3) [m/s], over the tilt.

        The state is that of the free body: qpos (n, 7) and qvel (n, 6).
        """
        (mass, inertia), gravity = self.body, -self.model.opt.gravity[2]
        axes = rotation(qpos[:, 3:7])
        error = velocity - qvel[:, :3]
        push = 4.0 * error + [0.0, 0.0, gravity]
        push[:, 2] = np.clip(push[:, 2], *np.multiply(self.lift, gravity))
        sideways = np.linalg.norm(push[:, :2], axis=1)
        room = 0.6 * push[:, 2]  # the largest tilt: sideways over upward acceleration
        push[:, :2] *= np.minimum(1.0, room / np.maximum(sideways, 1e-9))[:, None]
        up = axes[:, :, 2]
        thrust = mass * (push * up).sum(axis=1)
        # The rotation, in the body's axes, from the body's up to the direction of the push, and to yaw 0.
        goal = push / np.linalg.norm(push, axis=1, keepdims=True)
        turn = np.einsum("nji,nj->ni", axes, np.cross(up, goal))
        turn[:, 2] = -np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
        torque = inertia * (225.0 * turn - 24.0 * qvel[:, 3:6])
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


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Returns rotation matrices (n, 3, 3) of unit quaternions (n, 4): columns are the body's axes."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
