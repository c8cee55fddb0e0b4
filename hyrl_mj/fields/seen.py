"""What robots see of a field: posts and goal from where each robot is, as arrays of x and y.

Vectors are two arrays, (n,) for n robots or (n, K) for K posts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hyrl_mj.tasks import CLEAR, posts_of

# Distances that are divided by are at least this [m].
TINY = 1e-9


def dot(ax: np.ndarray, ay: np.ndarray, bx: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Returns the scalar products of vectors."""
    return ax * bx + ay * by


def norm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the lengths of vectors."""
    return np.sqrt(x * x + y * y)


def cross(ax: np.ndarray, ay: np.ndarray, bx: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Returns the vector products of vectors: more than 0 where b is on the left of a."""
    return ax * by - ay * bx


def only(index: np.ndarray, count: int) -> np.ndarray:
    """Returns which of so many posts has an index (n,): (n, count) bool."""
    return np.arange(count) == index[:, None]


def pick(values: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Returns those of finite values (n, K) (n,) of which own (n, K) tells."""
    return (values * own).sum(axis=1)


@dataclass(frozen=True)
class Post:
    """One post for each robot, (n,) each: the way x, y to it [m], its velocity [m/s], and its radius [m]."""

    x: np.ndarray
    y: np.ndarray
    vx: np.ndarray
    vy: np.ndarray
    radius: np.ndarray


@dataclass(frozen=True)
class Seen:
    """What n measurements of K posts say.

    Attributes:
        posts: (n, K, 5) as `posts_of` returns them.
        place_x, place_y, goal_x, goal_y: (n,) robot, and the way to the goal [m].
        heading: (n,) [rad].
        x, y: (n, K) ways to the posts [m].
        vx, vy: (n, K) velocities of the posts [m/s].
        radius: (n, K) [m].
    """

    posts: np.ndarray
    place_x: np.ndarray
    place_y: np.ndarray
    goal_x: np.ndarray
    goal_y: np.ndarray
    heading: np.ndarray
    x: np.ndarray
    y: np.ndarray
    vx: np.ndarray
    vy: np.ndarray
    radius: np.ndarray

    @staticmethod
    def from_measurement(measured: np.ndarray) -> Seen:
        posts, x, y = posts_of(measured), measured[:, 0], measured[:, 1]
        return Seen(
            posts, x, y, measured[:, 3] - x, measured[:, 4] - y, measured[:, 2],
            posts[:, :, 0] - x[:, None], posts[:, :, 1] - y[:, None],
            posts[:, :, 2], posts[:, :, 3], posts[:, :, 4],
        )  # fmt: skip

    @property
    def count(self) -> int:
        """K, the number of posts."""
        return int(self.radius.shape[1])

    @cached_property
    def far(self) -> np.ndarray:
        """From the robot's middle to those of the posts (n, K) [m], more than 0."""
        return np.maximum(norm(self.x, self.y), TINY)

    @cached_property
    def room(self) -> np.ndarray:
        """From the robot's middle to the posts' surfaces (n, K) [m]."""
        return self.far - self.radius

    @cached_property
    def goal_far(self) -> np.ndarray:
        """From the robot's middle to the goal (n,) [m], more than 0."""
        return np.maximum(norm(self.goal_x, self.goal_y), TINY)

    @cached_property
    def cos(self) -> np.ndarray:
        """Cosines of the headings (n,)."""
        return np.cos(self.heading)

    @cached_property
    def sin(self) -> np.ndarray:
        """Sines of the headings (n,)."""
        return np.sin(self.heading)

    @cached_property
    def coming(self) -> np.ndarray:
        """Speeds (n, K) at which posts come towards where the robots are [m/s]."""
        return -dot(self.x, self.y, self.vx, self.vy) / self.far

    @cached_property
    def towards(self) -> np.ndarray:
        """Cosines (n, K) of the angles between headings and the ways to posts."""
        return dot(self.x, self.y, self.cos[:, None], self.sin[:, None]) / self.far

    def post(self, own: np.ndarray) -> Post:
        """Returns those posts of which own (n, K) tells."""
        x, y, vx, vy, radius = (own.astype(float)[:, None] @ self.posts)[:, 0].T
        return Post(x - self.place_x, y - self.place_y, vx, vy, radius)


def tangent(
    x: np.ndarray, y: np.ndarray, radius: np.ndarray, sign: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ways to where the tangents past discs in x, y touch them; sign 1 is left, -1 right."""
    far2 = np.maximum(x * x + y * y, TINY)
    sin = np.minimum(radius / np.sqrt(far2), 1.0)
    cos = np.sqrt(1 - sin * sin)
    # The unit vector to the disc, turned by half the angle that the disc covers, times the tangent's length.
    share = np.maximum(cos, CLEAR / np.sqrt(far2))
    sin = sign * sin
    return share * (x * cos - y * sin), share * (y * cos + x * sin)
