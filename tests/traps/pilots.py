"""The agents that drive through the worlds."""

from dataclasses import dataclass

import numpy as np

from traps.plans import Plan


@dataclass(frozen=True)
class Pilot:
    """An agent without a memory: around the island on the nearer side, then to the goal.

    It looks a little at each number of its observation, so that its inputs tell what it saw. All that it
    computes is rounded alike for one observation and for many.

    Attributes:
        plan: of the world.
        columns: those of velocity, position and to_goal in the observation.
        weights: (k,) of the numbers of the observation.
        course: a direction (d,) that it always drives in instead; None to reach the goal.
    """

    plan: Plan
    columns: dict
    weights: np.ndarray
    course: tuple | None = None

    def __call__(self, observation):
        """Inputs (n, m), or numbers of levels (n,), for observations (n, k)."""
        o, plan = np.asarray(observation, dtype=float), self.plan
        velocity, position, to_goal = (
            o[:, self.columns[name]] for name in ("velocity", "position", "to_goal")
        )
        glance = np.cumsum(o * self.weights, axis=1)[:, -1:]
        glance = glance / (1 + np.abs(glance))
        if self.course is not None:
            course = np.broadcast_to(np.array(self.course), velocity.shape)
        elif plan.turns:
            course = _turn(to_goal, velocity)
        else:
            course = _around(plan, position, to_goal) - 0.2 * velocity
        share = (
            0.9 * np.clip(course, -1, 1) + 0.1 * glance * np.array([1.0, -0.7])[: plan.dimension]
        )
        if not plan.levels:
            return plan.scale * share
        scores = np.stack([share, -share], axis=2).reshape(len(o), -1)
        return np.where(scores.max(axis=1) < 0.05, 0, 1 + scores.argmax(axis=1))


def _turn(to_goal, velocity):
    cosine, sine = to_goal[:, :1], to_goal[:, 1:]
    push = np.where(cosine > 0, 2 * sine, np.where(sine >= 0, 1.0, -1.0))
    return -push - 0.3 * velocity


def _around(plan, position, to_goal):
    (px, py), (x, y, hx, hy) = position.T, plan.rock
    room = plan.radius + 0.12
    side = np.where(py >= y, 1.0, -1.0)
    behind, within = px < x + hx + room, np.abs(py - y) < hy + room
    corner = np.stack([x + hx + room + 0.1 - px, y + side * (hy + room + 0.05) - py], axis=1)
    aside = np.stack([0.1 + 0 * px, side], axis=1)
    ahead = np.where(behind[:, None], corner, to_goal)
    ahead = np.where((behind & within)[:, None], aside, ahead)
    length = np.sqrt(ahead[:, :1] * ahead[:, :1] + ahead[:, 1:] * ahead[:, 1:])
    return ahead / np.maximum(length, 0.3)
