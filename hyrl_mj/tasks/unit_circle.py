"""The unit circle: turn a pointer to the set-point, clockwise or counter-clockwise (paper, Example 1)."""

from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.registry import register


@register
class UnitCircle(Task):
    name = "unit_circle"
    env_id = "hyrl_mj/UnitCircle-v0"
    description = "turn a pointer to the set-point, clockwise or counter-clockwise (PPO)"
    chart = Chart(("theta",), ("rad",), (0.0,), (2 * np.pi,), (True,))
    inputs, input_units = ("turn_rate",), ("rad/s",)
    noisy = (True,)
    max_steps = 150
    worst_reward = -1.0
    start_low, start_high = chart.low, chart.high
    precision, close = 0.015, 0.3
    scene = Scene(
        starts=tuple((factor * np.pi,) for factor in (0.75, 0.9, 1.0, 1.1, 1.25)),
        time=4.0,
        mode_names=("clockwise", "counter-clockwise"),
        policy_starts=tuple(
            (float(np.arctan2(y, x)) % (2 * np.pi),)
            for x, y in ((-0.81, 0.59), (-0.95, -0.31), (-1.0, 0.0))
        ),
    )
    learning = Learning(
        search="rods",
        training={
            "samples": 160_000,
            "hidden": (64, 64),
            "spread": False,
            "normalize": False,
            "rehearse": 0.0,
        },
    )
    mirror = Mirror((1, -1), (-1,))
    observation_low, observation_high = (-1.0, -1.0), (1.0, 1.0)

    @cached_property
    def set_point(self) -> np.ndarray:
        """The angle of the goal (1,) [rad]."""
        x, y, _ = mjcf.site_pos(self.model, "set_point")
        return np.arctan2([y], [x])

    def error(self, theta: np.ndarray) -> np.ndarray:
        """Returns the angle from the set-point in [-pi, pi]: (n,) [rad]."""
        return self.chart.difference(theta, self.set_point)[:, 0]

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return np.hstack([np.cos(measured), np.sin(measured)])

    def measured(self, observation: np.ndarray) -> np.ndarray:
        cosine, sine = observation[:, :1], observation[:, 1:]
        return self.chart.wrap(np.arctan2(sine, cosine))

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        return -np.abs(self.error(measurement)) / np.pi

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        return np.full(len(measurement), Outcome.RUNNING)

    def miss(self, z: np.ndarray) -> np.ndarray:
        return np.abs(self.error(z))

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        # Half of them are the paper's, around the decision; the others lie all over the circle.
        opposite = self.set_point + np.pi + rng.uniform(-0.2, 0.2, (n, 1))
        anywhere = self.chart.draw(n, rng)
        return np.where(rng.random((n, 1)) < 0.5, opposite, anywhere)

    def direction(self, path: np.ndarray) -> np.ndarray:
        turned = path[-1, :, 0] - path[0, :, 0]
        decided = np.abs(self.error(path[0])) > self.close
        return np.where(decided, np.where(turned < 0, 0, 1), -1)
