"""A puck that glides past a pillar, on its left or on its right.

hyrl-mj run my_robot.py
python -m pytest test_my_robot.py
"""

import numpy as np

import hyrl_mj
from hyrl_mj import Chart, Learning, Mirror, Outcome, Scene, mjcf

WALL = 1.4  # [m] to either side


@hyrl_mj.register
class MyRobot(hyrl_mj.Task):
    name = "my_robot"
    description = "glide past a pillar on its left or on its right"
    # The coordinates in which the decision falls: those of the critical set and of all other sets.
    chart = Chart(("x", "y"), ("m", "m"), (0.0, -1.5), (3.2, 1.5), (False, False))
    inputs, input_units = ("lateral",), ("m/s",)
    noisy = (False, True, False, False)  # of the measurement: x, y, vy, touching
    max_steps = 70
    worst_reward = 0.0  # a crash must not be a way out of a bad reward
    start_low, start_high = (0.0, -0.8), (0.3, 0.8)
    # What replays and figures show: runs from these starts, for so long [s], and the ways that they go.
    scene = Scene(
        starts=((0.0, -0.15), (0.0, 0.0), (0.0, 0.15)), time=3.2, mode_names=("left", "right")
    )
    # What trains it by default: PPO, which chooses among levels of the input.
    learning = Learning(levels=5, horizon=0.3)
    # Mirrored observations call for mirrored inputs.
    mirror = Mirror(observation=(1, -1, -1), inputs=(-1,))
    observation_low, observation_high = (-1.0, -3.0, -3.0), (5.0, 3.0, 3.0)
    set_point = np.array([3.0, 0.0])
    close = 0.3  # [m] from the set-point counts as arrived

    def state(self, z, rng=None):
        """The full state of a start: at full speed ahead, with a random drift aside."""
        drift = np.zeros(len(z)) if rng is None else rng.uniform(-0.2, 0.2, len(z))
        return z, np.stack([np.ones(len(z)), drift], axis=1)

    def observation(self, measured):
        return measured[:, :3]

    def measured(self, observation):
        """The inverse of observation(), for SB3's evaluate_policy; no network reads `touching`."""
        return np.hstack([observation, np.zeros((len(observation), 1))])

    def clearance(self, measured):
        """Distance of the puck from the nearest pillar, a geom "obstacle...": (n,) [m]."""
        away, puck = [], mjcf.geom_size(self.model, "puck")[0]
        for name in mjcf.obstacles(self.model):
            centre, radius = (
                mjcf.geom_pos(self.model, name)[:2],
                mjcf.geom_size(self.model, name)[0],
            )
            away.append(np.linalg.norm(measured[:, :2] - centre, axis=1) - (radius + puck))
        return np.maximum(np.min(away, axis=0), 0.0)

    def reward(self, measured, u):
        """The reward of a step with inputs u (n, m) that led to these measurements."""
        close = np.maximum(1 - self.clearance(measured) / 0.2, 0.0)
        return np.where(self.failed(measured), 0.0, 3 - np.abs(measured[:, 1]) - close)

    def danger(self, measured):
        """What adversarial noise makes as large as it can."""
        return -self.clearance(measured)

    def ending(self, measured):
        ends = np.full(len(measured), Outcome.RUNNING)
        ends[measured[:, 0] >= self.set_point[0]] = Outcome.REACHED
        ends[np.abs(measured[:, 1]) >= WALL] = Outcome.OUT_OF_BOUNDS
        touching = (measured[:, 3] > 0) | (self.clearance(measured) <= 0)
        ends[touching] = Outcome.CRASHED
        return ends

    def miss(self, z):
        return np.abs(z[:, 1])
