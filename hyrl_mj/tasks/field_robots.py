"""The robots that drive in fields: how poses and inputs become the state and the controls of a model."""

from typing import Protocol

import numpy as np


class FieldRobot(Protocol):
    """A robot with a heading, that a forward speed and a rate of turn drive.

    The last two joints of its model are a clock [s], and the number of the layout.

    Attributes:
        hull: the cylinder of the model that touches posts; its middle is where the pose is taken.
    """

    hull: str

    def sensed(self, sensors: np.ndarray) -> np.ndarray:
        """Returns x, y, heading, clock and number of the layout (n, 5) [m, m, rad, s, 1]."""
        ...

    def state(self, pose: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Returns qpos (n, nq) and qvel (n, nv) of robots at rest, None for zero.

        Args:
            pose: (n, 3) x, y, heading [m, m, rad].
            number: (n,) of the layout.
        """
        ...

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Returns the controls (n, nu) for forward speeds and rates of turn u (n, 2) [m/s, rad/s]."""
        ...


class Unicycle:
    """x' = v cos h, y' = v sin h, h' = w: the robot follows its inputs without inertia."""

    hull = "hull"

    def sensed(self, sensors: np.ndarray) -> np.ndarray:
        return sensors

    def state(self, pose: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        return np.column_stack([pose, np.zeros(len(pose)), number]), None

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        speed, heading = u[:, 0], qpos[:, 2]
        ahead = speed * np.cos(heading), speed * np.sin(heading)
        return np.stack([*ahead, u[:, 1], np.ones(len(u)), np.zeros(len(u))], axis=1)
