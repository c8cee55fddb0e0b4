"""Which post of a field is in focus, and on which side it is passed: the logic state (q, lambda).

The way to the goal bends around the posts that block it. The focus is the post that it bends around first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrl_mj.tasks import CLEAR, LEFT, PROJECTED, RIGHT, length, posts_of, wrapped

# By how much the disc of the post in focus is wider than that of others: what keeps the focus [m].
WIDER = 0.2
# Posts that leave less room between them than this are one obstacle [m].
ROOM = 0.3
# How many posts the way may bend around one after the other before the focus is found.
BENDS = 4
# Where nothing blocks the way, a post that is this near comes into focus, if it is so much nearer than the
# one in focus [m].
NEARBY, NEARER = 0.7, 0.45
# A robot at full speed comes so close to a post, within the next second, before the post takes the focus; and
# the post that has it keeps it for so much longer [m].
CLOSE, KEPT = 0.2, 0.15
GLANCES, GLANCE = 4, 0.25
# Where nothing blocks the way, the side changes when the post is so far on its other side [m].
ASIDE = 0.35
# A turn about less than this angle has a side of its own [rad].
TURNED = 2.0


def at(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Returns values (n, K, ...) at indices (n,): (n, ...)."""
    return values[np.arange(len(index)), index]


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

    @property
    def away(self) -> np.ndarray:
        """From the robot to the posts (n, K, 2) [m]."""
        return self.centre - self.place[:, None]


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


def tangent(away: np.ndarray, radius: np.ndarray, side: np.ndarray) -> np.ndarray:
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
    joined = apart - seen.radius[:, :, None] - seen.radius[:, None] < ROOM
    for _ in range(4):  # each time over twice as many posts in between
        joined = (joined[:, :, :, None] & joined[:, None]).any(axis=2)
    return joined


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
    seen: Seen, post: np.ndarray, joined: np.ndarray, radius: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Returns the sides (n,) on which ways to targets (n, 2) past posts (n,) are shorter.

    Posts that are one obstacle with these are passed on the same side.
    """
    away = seen.away
    rows = np.arange(len(post))
    mine = joined[rows, post]
    bearing = np.arctan2(away[..., 1], away[..., 0])
    half = np.arcsin(np.minimum(radius / np.maximum(length(away), 1e-9), 1.0))
    lengths = []
    for side, sign in ((LEFT, 1.0), (RIGHT, -1.0)):
        angle = sign * wrapped(bearing - at(bearing, post)[:, None]) + half
        last = np.where(mine, angle, -np.inf).argmax(axis=1)
        leg = tangent(at(away, last), at(radius, last), np.full(len(post), side))
        lengths.append(length(leg) + length(target - seen.place - leg))
    return np.where(lengths[0] <= lengths[1], LEFT, RIGHT)


def first_bend(seen: Seen, focus: np.ndarray, side: np.ndarray) -> Bend:
    """Returns where ways bend first, after a focus (n,) and side (n,) of before, -1 for none."""
    n, count = seen.radius.shape
    own = np.arange(count) == focus[:, None]
    radius = seen.radius + CLEAR + WIDER * own
    room = length(seen.away) - seen.radius
    joined = clusters(seen)
    target, passed = seen.goal, np.zeros((n, count), dtype=bool)
    best, best_side = np.full(n, -1), np.zeros(n, dtype=int)
    more = np.ones(n, dtype=bool)
    rows = np.arange(n)
    for _ in range(BENDS):
        near, when = approach(seen, target)
        ahead = (seen.away * (target - seen.place)[:, None]).sum(axis=2) > 0
        blocks = (near < radius) & ahead & ~passed & more[:, None]
        more = blocks.any(axis=1)
        if not more.any():
            break
        post = np.where(blocks, room, np.inf).argmin(axis=1)
        together = joined[rows, post, np.maximum(best, 0)] & (best >= 0)
        way = np.where(together, best_side, shorter_side(seen, post, joined, radius, target))
        way = np.where(post == focus, side, way)
        best, best_side = np.where(more, post, best), np.where(more, way, best_side)
        passed = passed | ((np.arange(count) == post[:, None]) & more[:, None])
        soon = np.minimum(at(when, post), PROJECTED)[:, None]
        leg = tangent(at(seen.away, post) + soon * at(seen.speed, post), at(radius, post), way)
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
    """Returns how far (n,) posts (n,) are to the right of the ways to targets (n, 2) [m]."""
    way, away = target - seen.place, at(seen.away, post)
    across = way[:, 1] * away[:, 0] - way[:, 0] * away[:, 1]
    return across / np.maximum(length(way), 1e-9)


def choose(seen: Seen, focus: np.ndarray, side: np.ndarray) -> Pair:
    """Returns the pairs of focus and side, for those of before, -1 for none."""
    count = seen.radius.shape[1]
    bend = first_bend(seen, focus, side)
    free = bend.focus < 0
    # Nothing blocks the way.
    room = length(seen.away) - seen.radius
    nearest = room.argmin(axis=1)
    known = np.maximum(focus, 0)
    least = at(room, nearest)
    nearer = (focus < 0) | ((least < NEARBY) & (at(room, known) > least + NEARER))
    idle = np.where(nearer, nearest, known)
    right_of = side_of_way(seen, idle, seen.goal)
    same = (idle == focus) & (np.where(side == LEFT, right_of, -right_of) > -ASIDE)
    idle_side = np.where(same, side, np.where(right_of > 0, LEFT, RIGHT))
    best = np.where(free, idle, bend.focus)
    best_side = np.where(free, idle_side, bend.side)
    # What is too close on the way.
    least = least_room(seen, bend.target) - CLOSE - KEPT * (np.arange(count) == focus[:, None])
    close = least.argmin(axis=1)
    # The post in focus keeps it while it matters, unless another one that does is nearer.
    matters = at(bend.around, known) | (at(least, known) < 0)
    urgent = (at(least, close) < 0) & (close != best)
    close_side = np.where(side_of_way(seen, close, bend.target) > 0, LEFT, RIGHT)
    close_side = np.where(close == focus, side, close_side)
    best, best_side = np.where(urgent, close, best), np.where(urgent, close_side, best_side)
    kept = (focus >= 0) & matters & (at(room, best) > at(room, known) - NEARER)
    return Pair(np.where(kept, focus, best), np.where(kept, side, best_side))


def turn_sense(turn: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns the senses (n,) in which to turn by angles (n,) [rad]: 1 against the clock, -1 with it.

    `sense` (n,) are those of before, 0 for none.
    """
    shorter = np.where(turn >= 0, 1, -1)
    return np.where((np.abs(turn) <= TURNED) | (sense == 0), shorter, sense)
