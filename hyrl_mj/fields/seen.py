"""What robots see of a field: posts and goal from where each robot is, as arrays of x and y.

Vectors are two arrays, (n,) for n robots or (n, K) for K posts.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from hyrl_mj.tasks import posts_of

# Distances that are divided by are at least this [m].
TINY = 1e-9
# Posts that leave less room between them than this, now or in 2 s, are one obstacle [m].
ROOM = 0.3


def dot(ax: np.ndarray, ay: np.ndarray, bx: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Returns the scalar products of vectors."""
    return ax * bx + ay * by


def norm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the lengths of vectors."""
    return np.sqrt(x * x + y * y)


def cross(ax: np.ndarray, ay: np.ndarray, bx: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Returns the vector products of vectors: more than 0 where b is on the left of a."""
    return ax * by - ay * bx


def pick(values: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Returns those of finite values (n, K) (n,) of which own (n, K) tells."""
    return (values * own).sum(axis=1)


def neighbours(posts: np.ndarray) -> np.ndarray:
    """Returns between which posts (n, K, 5) there is no room now or soon: (n, K, K), 1 or 0."""
    x, y, vx, vy, radius = (posts[:, :, i] for i in range(5))
    dx, dy = x[:, :, None] - x[:, None], y[:, :, None] - y[:, None]
    sx, sy = x + 2.0 * vx, y + 2.0 * vy
    sx, sy = sx[:, :, None] - sx[:, None], sy[:, :, None] - sy[:, None]
    reach = radius[:, :, None] + (radius + ROOM)[:, None]
    least = np.minimum(dx * dx + dy * dy, sx * sx + sy * sy)
    return (least < reach * reach).astype(float)


class Seen:
    """What n measurements of K posts say.

    Args:
        measured: (n, 5 + 5 K) measurements of a `FieldTask`.

    Attributes:
        posts: (n, K, 5) as `posts_of` returns them.
        near: (n, K, K) more than 0 for posts that up to four gaps without room link.
        heading, cos, sin: (n,) heading [rad], its cosine and its sine.
        goal_x, goal_y, goal_far: (n,) way to the goal, and its length, more than 0 [m].
        x, y, far: (n, K) ways to the posts' middles, and their lengths, more than 0 [m].
        vx, vy: (n, K) velocities of the posts [m/s].
        radius: (n, K) [m].
        room: (n, K) from the robot's middle to the posts' surfaces [m].
        coming: (n, K) speeds at which posts come towards where the robots are [m/s].
        towards: (n, K) cosines of the angles between headings and the ways to posts.
    """

    def __init__(self, measured: np.ndarray):
        self.posts = posts_of(measured)
        place_x, place_y, self.heading = (measured[:, i] for i in range(3))
        self.cos, self.sin = np.cos(self.heading), np.sin(self.heading)
        self.goal_x, self.goal_y = measured[:, 3] - place_x, measured[:, 4] - place_y
        self.goal_far = np.maximum(norm(self.goal_x, self.goal_y), TINY)
        x, y, self.vx, self.vy, self.radius = (self.posts[:, :, i] for i in range(5))
        self.x, self.y = x - place_x[:, None], y - place_y[:, None]
        self.far = np.maximum(norm(self.x, self.y), TINY)
        self.room = self.far - self.radius
        self.coming = -dot(self.x, self.y, self.vx, self.vy) / self.far
        self.towards = dot(self.x, self.y, self.cos[:, None], self.sin[:, None]) / self.far

    @cached_property
    def near(self) -> np.ndarray:
        near = neighbours(self.posts)
        near = near @ near
        return near @ near

    def wall(self, own: np.ndarray) -> np.ndarray:
        """Returns the posts that are one obstacle with posts own (n, K) bool: (n, K) bool."""
        near = self.near
        # Up to 16 gaps, one after the other.
        row = own.astype(float)[:, None] @ near @ near @ near @ near
        return row[:, 0] > 0

    def only(self, index: np.ndarray) -> np.ndarray:
        """Returns which of the posts has an index (n,): (n, K) bool."""
        return np.arange(self.radius.shape[1]) == index[:, None]
