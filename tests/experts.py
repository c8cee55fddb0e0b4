"""Rules for the robots with dynamics, an expert among them, which knows which side to take."""

from dataclasses import dataclass

import mujoco
import numpy as np

import hyrl_mj
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.simulation.rollout import LoopSettings, closed_loop


def moved(task, policy, z0, **settings):
    """Runs (n,) of a policy from chart points, quietly."""
    settings = LoopSettings(quiet=True, **settings)
    return closed_loop(task, PolicyController(policy), np.array(z0), settings=settings)


def distances(model, geoms, obstacle, positions):
    """How far the nearest of some geoms is from an obstacle, by MuJoCo, at positions (n, nq): (n,) [m]."""
    data, found = mujoco.MjData(model), []
    others, obstacle = [model.geom(name).id for name in geoms], model.geom(obstacle).id
    for qpos in positions:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        found.append(
            min(mujoco.mj_geomDistance(model, data, g, obstacle, 9.0, None) for g in others)
        )
    return np.array(found)


class Constant:
    """The same inputs for ever."""

    def __init__(self, *u):
        self.u = u

    def act(self, measured):
        return np.tile(self.u, (len(measured), 1)).astype(float)


@dataclass(frozen=True)
class Expert:
    """Passes the pillar on one side with room to spare, then goes for the set-point.

    Attributes:
        task: the rover or the quadrotor.
        side: 1 for the left, -1 for the right.
    """

    task: hyrl_mj.Task
    side: int

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Inputs (n, m) for measurements (n, p)."""
        x, y = measured[:, 0], measured[:, 1]
        centre = self.task.obstacle
        gap = self.task.clearance(np.array([[centre[0], centre[1], *measured[0, 2:]]]))[0]
        before = x < centre[0] - 0.2 * gap
        goal_y = np.where(before, self.side * (0.25 - gap), self.task.set_point[1])
        if self.task.name == "quadrotor":
            wanted = 3 * (goal_y - y)
        else:
            bearing = np.clip(1.5 * np.arctan2(goal_y - y, 0.5), -1.2, 1.2)
            wanted = 4 * (bearing - measured[:, 2])
        return np.clip(wanted[:, None], *self.task.input_limits)
