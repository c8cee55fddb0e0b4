"""Fields for the rover: drive on wheels to a goal among posts, with policies trained on one."""

from functools import cached_property

import mujoco
import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.tasks.description import FullState
from hyrl_mj.tasks.field import Field, FieldRobot
from hyrl_mj.tasks.registry import register
from hyrl_mj.tasks.rover import Wheels, heading_of


class RoverOnWheels(FieldRobot):
    """The rover as a robot in fields: its wheels reach the rates that its inputs ask for after a while.

    Its pose is that of the middle of its bumper, which is what touches posts.

    Args:
        model: the compiled model.
    """

    hull = "bumper"

    def __init__(self, model: mujoco.MjModel):
        self.wheels = Wheels(model)
        # From the middle of the axle ahead to that of the bumper [m].
        self.ahead = float(mjcf.geom_pos(model, self.hull)[0])

    def sensed(self, sensors: np.ndarray) -> np.ndarray:
        heading = heading_of(sensors[:, 3:7])
        middle = sensors[:, :2] + self._ahead(heading)
        return np.column_stack([middle, heading, sensors[:, 7:9]])

    def state(self, pose: np.ndarray, number: np.ndarray) -> FullState:
        heading = pose[:, 2]
        axle = np.column_stack([pose[:, :2] - self._ahead(heading), heading])
        return np.column_stack([self.wheels.positions(axle), np.zeros(len(pose)), number]), None

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return np.column_stack([self.wheels.rates(u[:, 0], u[:, 1]), np.ones(len(u))])

    def _ahead(self, heading: np.ndarray) -> np.ndarray:
        """Returns the ways (n, 2) from the middle of the axle to that of the bumper [m]."""
        return self.ahead * np.stack([np.cos(heading), np.sin(heading)], axis=1)


@register
class RoverField(Field):
    name = "rover_field"
    description = "drive on wheels to a goal among posts, with policies trained on one (PPO)"

    @cached_property
    def robot(self) -> FieldRobot:  # type: ignore[override]
        return RoverOnWheels(self.model)
