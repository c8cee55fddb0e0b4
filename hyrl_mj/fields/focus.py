"""Which post of a field is in focus, and on which side it is passed: the logic state (q, lambda).

The way to the goal bends around the posts that block it. The focus is the post that it bends around first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.fields.seen import TINY, Seen, cross, dot, norm, only, pick, tangent
from hyrl_mj.tasks import CLEAR, LEFT, PROJECTED, RIGHT

# Posts that leave less room between them than this, now or after so long, are one obstacle [m], [s].
ROOM, CLOSING = 0.3, 2.0
# How many posts the way may bend around one after the other before the focus is found.
BENDS = 4
# Where nothing blocks the way, a post that is this near comes into focus [m].
NEARBY = 0.7
# A robot at full speed comes so close to a post, within the next second, before the post takes the focus [m].
CLOSE = 0.3
GLANCES, GLANCE = 4, 0.25
# A post ahead holds a robot back that is nearer to it than the margin of the guard and this [m].
HOLDING = 0.05
# Obstacles are followed over 4 `FOLDED` posts.
FOLDED = 4
# Turns steps into ways.
SUMS = np.triu(np.ones((GLANCES, GLANCES)))
# The post in focus is passed on its other side if that way is shorter by more than this [m].
LONGER = 1.0
# A turn about less than this angle has a side of its own [rad].
TURNED = 2.0


def neighbours(posts: np.ndarray) -> np.ndarray:
    """Returns between which posts (n, K, 5) there is no room now or soon: (n, K, K), 1 or 0."""
    x, y, vx, vy, radius = (posts[:, :, i] for i in range(5))
    dx, dy = x[:, :, None] - x[:, None], y[:, :, None] - y[:, None]
    sx, sy = x + CLOSING * vx, y + CLOSING * vy
    sx, sy = sx[:, :, None] - sx[:, None], sy[:, :, None] - sy[:, None]
    reach = radius[:, :, None] + (radius + ROOM)[:, None]
    least = np.minimum(dx * dx + dy * dy, sx * sx + sy * sy)
    return (least < reach * reach).astype(float)


def wall(near: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Returns the posts (n, K) bool that are one obstacle with those of which own (n, K) tells.

    `near` is what `neighbours` returns, to the power of `FOLDED`.
    """
    row = own.astype(float)[:, None]
    for _ in range(FOLDED):
        row = row @ near
    return row[:, 0] > 0


@dataclass(frozen=True)
class Pair:
    """Focus (n,) and side (n,)."""

    focus: np.ndarray
    side: np.ndarray


@dataclass(frozen=True)
class Bend(Pair):
    """Where the way to the goal bends first.

    Attributes:
        x, y: (n,) where the way leads first [m].
        around: (n, K) bool, the posts that the way bends around.
        kept_side: (n,) on which side the post that was in focus is passed.
    """

    x: np.ndarray
    y: np.ndarray
    around: np.ndarray
    kept_side: np.ndarray


class _Sides:
    """The ways past obstacles on their left and right.

    Args:
        seen: what was measured.
        reach: (n, K) radii of the discs to pass [m].
    """

    def __init__(self, seen: Seen, reach: np.ndarray):
        self.seen = seen
        near = neighbours(seen.posts)
        near = near @ near
        self.near = near @ near
        self.half = np.arcsin(np.minimum(reach / seen.far, 1.0))
        # To the ends of the tangents, and how long that is.
        self.legs = []
        for sign in (1.0, -1.0):
            x, y = tangent(seen.x, seen.y, reach, sign)
            self.legs.append((sign, x, y, norm(x, y)))

    def longer(self, own: np.ndarray, mine: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Returns by how much (n,) ways to x, y (n,) are longer on the left of posts than on the right [m].

        Args:
            own: (n, K) bool, the post.
            mine: (n, K) bool, the posts that are one obstacle with it, and are passed on the same side.
            x, y: the target [m].
        """
        seen = self.seen
        post = seen.post(own)
        px, py = post.x[:, None], post.y[:, None]
        off = np.arctan2(cross(px, py, seen.x, seen.y), dot(px, py, seen.x, seen.y))
        lengths = []
        for sign, leg_x, leg_y, leg in self.legs:
            last = np.where(mine, sign * off + self.half, -np.inf).argmax(axis=1)
            whole = leg + norm(x[:, None] - leg_x, y[:, None] - leg_y)
            lengths.append(pick(whole, only(last, seen.count)))
        return lengths[0] - lengths[1]


def first_bend(seen: Seen, focus: np.ndarray, side: np.ndarray, wider: float) -> Bend:
    """Returns where ways bend first.

    Args:
        seen: what was measured.
        focus, side: (n,) of before, -1 for none.
        wider: by how much the disc of the post in focus is wider than others [m].
    """
    count, kept = seen.count, only(focus, seen.radius.shape[1])
    reach = seen.radius + CLEAR + wider * kept
    sides: _Sides | None = None
    x, y, far = seen.goal_x, seen.goal_y, seen.goal_far
    passed = seen.radius < 0
    best, best_side, kept_side = np.full_like(focus, -1), np.full_like(focus, LEFT), side
    for bend in range(BENDS):
        # How near robots come to the posts on straight ways at 1 m/s, and when.
        vx, vy = (x / far)[:, None] - seen.vx, (y / far)[:, None] - seen.vy
        when = dot(seen.x, seen.y, vx, vy) / np.maximum(dot(vx, vy, vx, vy), TINY)
        when = np.minimum(np.maximum(when, 0.0), far[:, None])
        near_x, near_y = seen.x - vx * when, seen.y - vy * when
        ahead = dot(seen.x, seen.y, x[:, None], y[:, None]) > 0
        nearest = dot(near_x, near_y, near_x, near_y)
        blocks = (nearest < reach * reach) & ahead & ~passed
        more: Any = blocks.any(axis=1)
        if isinstance(more, np.ndarray) and not more.any():  # an export does not know
            break
        sides = sides or _Sides(seen, reach)
        post = np.where(blocks, seen.room, np.inf).argmin(axis=1)
        own = only(post, count)
        mine = wall(sides.near, own)
        together = (mine & only(best, count)).any(axis=1)
        longer = sides.longer(own, mine, x, y)
        way = np.where(together, best_side, np.where(longer <= 0, LEFT, RIGHT))
        # The post in focus is passed on the other side only if that saves much.
        held = longer < np.where(side == LEFT, LONGER, -LONGER)
        way = np.where(post == focus, np.where(held, LEFT, RIGHT), way)
        if bend == 0:
            # The policies drive straight to the goal where only the wider disc is in the way.
            straight = pick(nearest, own) >= (pick(reach, own) - wider) ** 2
            way = np.where((post == focus) & straight, on_side(seen, own, x, y), way)
        kept_side = np.where((post == focus) & more, way, kept_side)
        best, best_side = np.where(more, post, best), np.where(more, way, best_side)
        passed = passed | (own & more[:, None])
        first, soon = seen.post(own), np.minimum(pick(when, own), PROJECTED)
        next_x, next_y = tangent(
            first.x + soon * first.vx,
            first.y + soon * first.vy,
            pick(reach, own),
            np.where(way == LEFT, 1.0, -1.0),
        )
        x, y = np.where(more, next_x, x), np.where(more, next_y, y)
        far = np.maximum(norm(x, y), TINY)
    return Bend(best, best_side, x, y, passed, kept_side)


def least_room(seen: Seen, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns how close robots come to the posts' surfaces, while they turn to x, y (n,): (n, K) [m].

    This looks `GLANCES` times `GLANCE` ahead.
    """
    turn = np.arctan2(cross(seen.cos, seen.sin, x, y), dot(seen.cos, seen.sin, x, y))[:, None]
    most = GLANCE * (np.arange(GLANCES) + 0.5)
    heading = seen.heading[:, None] + np.minimum(np.maximum(turn, -most), most)
    step = norm(x, y)[:, None] - GLANCE * np.arange(GLANCES)
    step = np.minimum(np.maximum(step, 0.0), GLANCE)
    place_x, place_y = (step * np.cos(heading)) @ SUMS, (step * np.sin(heading)) @ SUMS
    time = GLANCE * np.arange(1, GLANCES + 1)[:, None]
    away_x = seen.x[:, None] + time * seen.vx[:, None] - place_x[:, :, None]
    away_y = seen.y[:, None] + time * seen.vy[:, None] - place_y[:, :, None]
    return norm(away_x, away_y).min(axis=1) - seen.radius


def on_side(seen: Seen, own: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns on which sides (n,) ways to x, y (n,) pass posts (n, K) bool."""
    post = seen.post(own)
    return np.where(cross(x, y, post.x, post.y) < 0, LEFT, RIGHT)


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
    count = seen.count
    # The difference of two distances changes by twice as much as either.
    nearer = wider = 2 * swing
    own = only(focus, count)
    bend = first_bend(seen, focus, side, wider)
    # Nothing blocks the way: the nearest post.
    room, room_of_known = seen.room, pick(seen.room, own)
    least = room.min(axis=1)
    other = (focus < 0) | ((least < NEARBY) & (room_of_known > least + nearer))
    idle = np.where(other, room.argmin(axis=1), focus)
    idle_side = on_side(seen, only(idle, count), seen.goal_x, seen.goal_y)
    idle_side = np.where(idle == focus, side, idle_side)
    free = bend.focus < 0
    best, best_side = np.where(free, idle, bend.focus), np.where(free, idle_side, bend.side)
    # What is too close on the way.
    close_by = least_room(seen, bend.x, bend.y) - CLOSE - swing * own
    close = close_by.argmin(axis=1)
    # The post in focus keeps it while it matters, unless another one that does is nearer.
    matters = ((bend.around | (close_by < 0)) & own).any(axis=1)
    urgent = (close_by.min(axis=1) < 0) & (close != best)
    close_side = on_side(seen, only(close, count), bend.x, bend.y)
    close_side = np.where(close == focus, side, close_side)
    best, best_side = np.where(urgent, close, best), np.where(urgent, close_side, best_side)
    first = only(best, count)
    room_of_best = pick(room, first)
    kept = matters & (room_of_best > room_of_known - nearer)
    # A post that holds the robot back takes the focus, or the robot would stand there for ever.
    held = (room_of_best < margin + HOLDING) & (room_of_best < room_of_known)
    kept = kept & ~(held & (pick(seen.towards, first) > 0))
    return Pair(np.where(kept, focus, best), np.where(kept, bend.kept_side, best_side))


def turn_sense(turn: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns the senses (n,) in which to turn by angles (n,) [rad]: 1 against the clock, -1 with it.

    `sense` (n,) are those of before, 0 for none.
    """
    shorter = np.where(turn >= 0, 1, -1)
    return np.where((np.abs(turn) <= TURNED) | (sense == 0), shorter, sense)
