"""Which post of a field is in focus, and on which side it is passed: the logic state (q, lambda).

The way to the goal bends around the posts that block it. The focus is the post that it bends around first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hyrl_mj.tasks import CLEAR, LEFT, PROJECTED, RIGHT, length, posts_of, wrapped

# Posts that leave less room between them than this are one obstacle [m].
ROOM = 0.3
# How many posts the way may bend around one after the other before the focus is found.
BENDS = 4
# Where nothing blocks the way, a post that is this near comes into focus [m].
NEARBY = 0.7
# A robot at full speed comes so close to a post, within the next second, before the post takes the focus [m].
CLOSE = 0.3
GLANCES, GLANCE = 4, 0.25
# The guard holds a robot back that is less than this farther from a post than its margin, and heads for it:
# the cosine of the angle between its heading and the post's direction is greater than this [m], [1].
HOLDING, AHEAD = 0.05, 0.0
# Obstacles are followed over 2 to the power of this many posts.
LINKS = 4
# A turn about less than this angle has a side of its own [rad].
TURNED = 2.0


def pick(values: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Returns those values (n, K, ...) (n, ...) of which own (n, K) tells."""
    return np.where(own if values.ndim == 2 else own[:, :, None], values, 0).sum(axis=1)


def only(index: np.ndarray, count: int) -> np.ndarray:
    """Returns which of so many posts has an index (n,): (n, count) bool."""
    return np.arange(count) == index[:, None]


@dataclass(frozen=True)
class Seen:
    """What n measurements of K posts say.

    Attributes:
        place, goal: (n, 2) of robot and goal [m].
        heading: (n,) [rad].
        centre, speed: (n, K, 2) of the posts [m], [m/s].
        radius: (n, K) [m].
    """

    place: np.ndarray
    goal: np.ndarray
    heading: np.ndarray
    centre: np.ndarray
    speed: np.ndarray
    radius: np.ndarray

    @staticmethod
    def of(measured: np.ndarray) -> Seen:
        posts = posts_of(measured)
        return Seen(
            measured[:, :2], measured[:, 3:5], measured[:, 2],
            posts[..., :2], posts[..., 2:4], posts[..., 4],
        )  # fmt: skip

    @cached_property
    def away(self) -> np.ndarray:
        """From the robot to the posts (n, K, 2) [m]."""
        return self.centre - self.place[:, None]

    @cached_property
    def room(self) -> np.ndarray:
        """From the robot's middle to the posts' surfaces (n, K) [m]."""
        return length(self.away) - self.radius

    @cached_property
    def axis(self) -> np.ndarray:
        """Directions (n, 2) of the robots."""
        return np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1)

    @cached_property
    def coming(self) -> np.ndarray:
        """Speeds (n, K) at which posts come towards where the robots are [m/s]."""
        far = np.maximum(length(self.away), 1e-9)
        return np.asarray(-(self.away * self.speed).sum(axis=2) / far)


def approach(seen: Seen, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns how near robots come to the posts' centres on straight ways to targets (n, 2), and when.

    Returns:
        (n, K) distances [m]; (n, K) times at a speed of 1 m/s [s].
    """
    way = target - seen.place
    far = np.maximum(length(way), 1e-9)
    relative = (way / far[:, None])[:, None] - seen.speed
    away = seen.away
    when = (away * relative).sum(axis=2) / np.maximum((relative**2).sum(axis=2), 1e-9)
    when = np.clip(when, 0.0, far[:, None])
    return length(away - relative * when[..., None]), when


def tangent(away: np.ndarray, radius: np.ndarray, side: np.ndarray | int) -> np.ndarray:
    """Returns the ways (..., 2) to where the tangents past discs touch them, for sides (...)."""
    far = np.maximum(length(away), 1e-9)
    half = np.arcsin(np.minimum(radius / far, 1.0))
    bearing = np.arctan2(away[..., 1], away[..., 0]) + np.where(side == LEFT, half, -half)
    leg = np.maximum(np.sqrt(np.maximum(far**2 - radius**2, 0.0)), CLEAR)
    return leg[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)


def clusters(seen: Seen) -> np.ndarray:
    """Returns which posts (n, K, K) bool are one obstacle, because nothing fits between them."""
    away = seen.centre[:, :, None] - seen.centre[:, None]
    going = seen.speed[:, :, None] - seen.speed[:, None]
    apart = np.minimum(length(away), length(away + PROJECTED / 2 * going))
    near = apart - seen.radius[:, :, None] - seen.radius[:, None] < ROOM
    joined = near.astype(np.float32)
    for _ in range(LINKS):  # each time over twice as many posts in between
        joined = np.minimum(joined @ joined, np.float32(1))
    return joined > 0


@dataclass(frozen=True)
class Pair:
    """Focus (n,) and side (n,)."""

    focus: np.ndarray
    side: np.ndarray


@dataclass(frozen=True)
class Bend(Pair):
    """Where the way to the goal bends first.

    Attributes:
        target: (n, 2) where the way leads first [m].
        around: (n, K) bool, the posts that the way bends around.
    """

    target: np.ndarray
    around: np.ndarray


def shorter_side(
    seen: Seen, post: np.ndarray, mine: np.ndarray, radius: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Returns the sides (n,) on which ways to targets (n, 2) past posts are shorter.

    Args:
        seen: what was measured.
        post: (n, K) bool, the post.
        mine: (n, K) bool, the posts that are one obstacle with it, and are passed on the same side.
        radius: (n, K) of the discs to pass [m].
        target: (n, 2) [m].
    """
    away, count = seen.away, post.shape[1]
    bearing = np.arctan2(away[..., 1], away[..., 0])
    half = np.arcsin(np.minimum(radius / np.maximum(length(away), 1e-9), 1.0))
    off = wrapped(bearing - pick(bearing, post)[:, None])
    lengths = []
    for side, sign in ((LEFT, 1.0), (RIGHT, -1.0)):
        last = only(np.where(mine, sign * off + half, -np.inf).argmax(axis=1), count)
        leg = tangent(pick(away, last), pick(radius, last), side)
        lengths.append(length(leg) + length(target - seen.place - leg))
    return np.where(lengths[0] <= lengths[1], LEFT, RIGHT)


def first_bend(seen: Seen, focus: np.ndarray, side: np.ndarray, wider: float) -> Bend:
    """Returns where ways bend first.

    Args:
        seen: what was measured.
        focus, side: (n,) of before, -1 for none.
        wider: by how much the disc of the post in focus is wider than others [m].
    """
    n, count = seen.radius.shape
    radius = seen.radius + CLEAR + wider * only(focus, count)
    room = seen.room
    joined = clusters(seen)
    target, passed = seen.goal, np.zeros((n, count), dtype=bool)
    best, best_side = np.full(n, -1), np.full(n, LEFT)
    for _ in range(BENDS):
        near, when = approach(seen, target)
        ahead = (seen.away * (target - seen.place)[:, None]).sum(axis=2) > 0
        blocks = (near < radius) & ahead & ~passed
        more = blocks.any(axis=1)
        if isinstance(more, np.ndarray) and not more.any():  # an export does not know
            break
        post = np.where(blocks, room, np.inf).argmin(axis=1)
        own = only(post, count)
        mine = (joined & own[:, :, None]).any(axis=1)
        together = (mine & only(best, count)).any(axis=1)
        way = np.where(together, best_side, shorter_side(seen, own, mine, radius, target))
        way = np.where(post == focus, side, way)
        best, best_side = np.where(more, post, best), np.where(more, way, best_side)
        passed = passed | (own & more[:, None])
        soon = np.minimum(pick(when, own), PROJECTED)[:, None]
        leg = tangent(pick(seen.away, own) + soon * pick(seen.speed, own), pick(radius, own), way)
        target = np.where(more[:, None], seen.place + leg, target)
    return Bend(best, best_side, target, passed)


def least_room(seen: Seen, target: np.ndarray) -> np.ndarray:
    """Returns how close robots come to the posts' surfaces, while they turn to targets (n, 2): (n, K) [m].

    This looks `GLANCES` times `GLANCE` ahead.
    """
    way = target - seen.place
    far, turn = length(way), wrapped(np.arctan2(way[:, 1], way[:, 0]) - seen.heading)
    place, least = seen.place, np.full(seen.radius.shape, np.inf)
    for k in range(GLANCES):
        most = GLANCE * (k + 0.5)
        heading = seen.heading + np.clip(turn, -most, most)
        step = np.clip(far - GLANCE * k, 0.0, GLANCE)[:, None]
        place = place + step * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        centre = seen.centre + GLANCE * (k + 1) * seen.speed
        least = np.minimum(least, length(centre - place[:, None]) - seen.radius)
    return least


def side_of_way(seen: Seen, post: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns how far (n,) posts (n, K) bool are to the right of the ways to targets (n, 2) [m]."""
    way, away = target - seen.place, pick(seen.away, post)
    across = way[:, 1] * away[:, 0] - way[:, 0] * away[:, 1]
    return across / np.maximum(length(way), 1e-9)


def ahead_of(seen: Seen, post: np.ndarray) -> np.ndarray:
    """Returns the cosines (n,) of the angles between headings and the ways to posts (n, K) bool."""
    away = pick(seen.away, post)
    ahead = away[:, 0] * np.cos(seen.heading) + away[:, 1] * np.sin(seen.heading)
    return ahead / np.maximum(length(away), 1e-9)


def choose(
    seen: Seen, focus: np.ndarray, side: np.ndarray, swing: float = 0.0, margin: float = 0.0
) -> Pair:
    """Returns the pairs of focus and side.

    Args:
        seen: what was measured.
        focus, side: (n,) of before, -1 for none.
        swing: how far two measurements of the same place can be from each other [m]. What decides changes
            by more than that before another decision follows.
        margin: distance from the posts' surfaces at which the guard holds the robot back [m].
    """
    count = seen.radius.shape[1]
    # The difference of two distances changes by twice as much as either.
    nearer = wider = 2 * swing
    bend = first_bend(seen, focus, side, wider)
    free = bend.focus < 0
    # Nothing blocks the way.
    room = seen.room
    nearest = room.argmin(axis=1)
    known = np.maximum(focus, 0)
    own = only(known, count)
    least, room_of_known = room.min(axis=1), pick(room, own)
    other = (focus < 0) | ((least < NEARBY) & (room_of_known > least + nearer))
    idle = np.where(other, nearest, known)
    right_of = side_of_way(seen, only(idle, count), seen.goal)
    idle_side = np.where(idle == focus, side, np.where(right_of > 0, LEFT, RIGHT))
    best = np.where(free, idle, bend.focus)
    best_side = np.where(free, idle_side, bend.side)
    # What is too close on the way.
    close_by = least_room(seen, bend.target) - CLOSE - swing * only(focus, count)
    close = close_by.argmin(axis=1)
    # The post in focus keeps it while it matters, unless another one that does is nearer.
    matters = ((bend.around | (close_by < 0)) & own).any(axis=1)
    urgent = (close_by.min(axis=1) < 0) & (close != best)
    close_side = np.where(side_of_way(seen, only(close, count), bend.target) > 0, LEFT, RIGHT)
    close_side = np.where(close == focus, side, close_side)
    best, best_side = np.where(urgent, close, best), np.where(urgent, close_side, best_side)
    apart = pick(room, only(best, count)) - room_of_known
    kept = (focus >= 0) & matters & (apart > -nearer)
    # A post that holds the robot back takes the focus, or the robot would stand there for ever.
    held = (pick(room, only(best, count)) < margin + HOLDING) & (apart < 0)
    kept = kept & ~(held & (ahead_of(seen, only(best, count)) > AHEAD))
    return Pair(np.where(kept, focus, best), np.where(kept, side, best_side))


def turn_sense(turn: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns the senses (n,) in which to turn by angles (n,) [rad]: 1 against the clock, -1 with it.

    `sense` (n,) are those of before, 0 for none.
    """
    shorter = np.where(turn >= 0, 1, -1)
    return np.where((np.abs(turn) <= TURNED) | (sense == 0), shorter, sense)
