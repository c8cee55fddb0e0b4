"""An arm of two links beside a post: fold to a parking posture, the elbow turned one way or the other."""

from functools import cached_property

import numpy as np

from hyrl_mj.physics import mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.registry import register


@register
class Arm(Task):
    name = "arm"
    description = "fold two links beside a post, the second turned one way or the other (PPO)"
    chart = Chart(
        ("shoulder", "elbow"), ("rad", "rad"), (-np.pi, -np.pi), (np.pi, np.pi), (True, True)
    )
    inputs, input_units = ("shoulder_rate", "elbow_rate"), ("rad/s", "rad/s")
    noisy = (1.0, 1.0)
    max_steps = 120
    worst_reward = -1.0
    start_low, start_high = chart.low, chart.high
    mirror = Mirror((1, 1, -1, -1), (-1, -1))
    close = 0.35
    scene = Scene(
        starts=tuple((0.8, angle) for angle in (-0.3, -0.1, 0.0, 0.1, 0.3)),
        time=2.6,
        mode_names=("elbow clockwise", "elbow counter-clockwise"),
    )
    learning = Learning(levels=3, algorithm="ppo")
    observation_low, observation_high = (-1.0,) * 4, (1.0,) * 4

    @cached_property
    def set_point(self) -> np.ndarray:
        """The angles (2,) of the goal [rad], those of the bodies that show it."""
        turns = [self.model.body(name).quat for name in ("goal_upper", "goal_fore")]
        return np.array([2 * np.arctan2(turn[3], turn[0]) for turn in turns])

    @cached_property
    def lengths(self) -> tuple[float, float]:
        """Lengths of the two links [m]."""
        hand = mjcf.site_pos(self.model, "tracked")
        return float(self.model.body("fore").pos[0]), float(hand[0])

    def points(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the elbow and the hand (n, 2), (n, 2) [m] at joint angles (n, 2)."""
        upper, fore = self.lengths
        shoulder, sum_ = q[:, 0], q[:, 0] + q[:, 1]
        elbow = upper * np.stack([np.cos(shoulder), np.sin(shoulder)], axis=1)
        return elbow, elbow + fore * np.stack([np.cos(sum_), np.sin(sum_)], axis=1)

    def clearance(self, q: np.ndarray) -> np.ndarray:
        """Returns the distance of both links from the post (n,) [m] at joint angles (n, 2)."""
        post = mjcf.geom_pos(self.model, "obstacle")[:2]
        radius = mjcf.geom_size(self.model, "obstacle")[0]
        elbow, hand = self.points(q)
        distances = [
            to_segment(post, a, b) - mjcf.geom_size(self.model, link)[0]
            for a, b, link in ((0 * elbow, elbow, "upper_link"), (elbow, hand, "fore_link"))
        ]
        return np.minimum(*distances) - radius

    def observation(self, measured: np.ndarray) -> np.ndarray:
        return np.hstack([np.cos(measured), np.sin(measured)])

    def measured(self, observation: np.ndarray) -> np.ndarray:
        return self.chart.wrap(np.arctan2(observation[:, 2:], observation[:, :2]))

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        away = np.abs(self.chart.difference(measurement, self.set_point)).sum(axis=1) / (2 * np.pi)
        near = np.clip(1 - self.clearance(measurement) / 0.05, 0.0, 1.0)
        # A crash costs 1: as much as going on for twenty samples as far from the goal as can be.
        reward = -0.01 - 0.04 * away - 0.05 * near
        return np.where(self.failed(measurement), self.worst_reward, reward)

    def ending(self, measurement: np.ndarray) -> np.ndarray:
        ends = np.where(self.arrived(measurement), Outcome.REACHED, Outcome.RUNNING)
        return np.where(self.clearance(measurement) <= 0, Outcome.CRASHED, ends)

    def may_start(self, z: np.ndarray) -> np.ndarray:
        return (self.clearance(z) >= 0.01) & ~self.arrived(z)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        drawn = np.empty((0, 2))
        while len(drawn) < n:
            z = self.chart.draw(2 * n, rng)
            drawn = np.vstack([drawn, z[self.may_start(z)]])
        return drawn[:n]

    def direction(self, path: np.ndarray) -> np.ndarray:
        turned = path[-1, :, 1] - path[0, :, 1]
        # A run that ends elsewhere counts for the short way, as those around it would.
        short = self.chart.difference(self.set_point, path[0])[:, 1]
        turned = np.where(self.arrived(path[-1]), turned, short)
        return np.where(np.abs(turned) > self.close, np.where(turned < 0, 0, 1), -1)


def to_segment(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the distance (n,) of a point (2,) from segments between points a and b (n, 2)."""
    along = b - a
    share = ((point - a) * along).sum(axis=1) / (along**2).sum(axis=1)
    nearest = a + np.clip(share, 0.0, 1.0)[:, None] * along
    return np.linalg.norm(nearest - point, axis=1)
