"""Which post of a field is in focus, and on which side it is passed: the logic state (q, lambda).

The way to the goal bends around the posts that block it. The focus is the post that it bends around first.
A mode is this state in one number, with the sense of turning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.fields.seen import TINY, Seen, cross, dot, norm, pick
from hyrl_mj.tasks import CLEAR, LEFT, PROJECTED, RIGHT

# A turn about less than this angle has a side of its own [rad].
TURNED = 2.0
# Where nothing blocks the way, a post that is this near comes into focus [m].
NEARBY = 0.7
# A robot at full speed comes so close to a post, within the next second, before the post takes the focus [m].
CLOSE = 0.3
# A post ahead holds a robot back that is nearer to it than the margin of the guard and this [m].
HOLDING = 0.05
# The post in focus is passed on its other side if that way is shorter by more than this [m].
LONGER = 1.0
# Modes of a post: two sides, with two senses of turning each.
MODES_OF_POST = 4


def encoded(focus: np.ndarray, side: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns the modes (n,) of posts in focus (n,), sides (n,) and senses of turning (n,)."""
    return MODES_OF_POST * focus + 2 * side + np.where(sense < 0, 1, 0)


def decoded(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns focus (n,), side (n,) and sense of turning (n,) of modes (n,); -1, -1 and 0 for no mode."""
    focus = np.floor(q / MODES_OF_POST)
    rest = q - MODES_OF_POST * focus
    side = np.floor(rest / 2)
    none = q < 0
    side, sense = np.where(none, -1, side), np.where(none, 0, 1 - 2 * (rest - 2 * side))
    return focus.astype(np.int64), side.astype(np.int64), sense.astype(np.int64)


@dataclass(frozen=True)
class Bend:
    """Where the way to the goal bends first.

    Attributes:
        focus, side: (n,) the post that it bends around, -1 for none, and the side on which it passes it.
        kept_side: (n,) on which side the post that was in focus is passed.
        x, y: (n,) where the way leads first [m].
        around: (n, K) bool, the posts that the way bends around.
    """

    focus: np.ndarray
    side: np.ndarray
    kept_side: np.ndarray
    x: np.ndarray
    y: np.ndarray
    around: np.ndarray


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


def longer_on_the_left(
    seen: Seen, reach: np.ndarray, wall: np.ndarray, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Returns by how much (n,) ways to x, y (n,) are longer on the left of posts than on the right [m].

    Args:
        seen: what was measured.
        reach: (n, K) radii of the discs to pass [m].
        wall: (n, K) bool, the posts that are one obstacle, and are passed on the same side.
        x, y: the target [m].
    """
    lengths = []
    for sign in (1.0, -1.0):
        leg_x, leg_y = tangent(seen.x, seen.y, reach, sign)
        whole = norm(leg_x, leg_y) + norm(x[:, None] - leg_x, y[:, None] - leg_y)
        # Who passes all of them goes at least as far as past any of them alone.
        lengths.append(np.where(wall, whole, 0.0).max(axis=1))
    return lengths[0] - lengths[1]


def first_bend(seen: Seen, focus: np.ndarray, side: np.ndarray, wider: float) -> Bend:
    """Returns where ways bend first.

    Args:
        seen: what was measured.
        focus, side: (n,) of before, -1 for none.
        wider: by how much the disc of the post in focus is wider than others [m].
    """
    reach = seen.radius + CLEAR + wider * seen.only(focus)
    x, y, far = seen.goal_x, seen.goal_y, seen.goal_far
    passed = seen.radius < 0
    best, best_side, kept_side = np.full_like(focus, -1), np.full_like(focus, LEFT), side
    # Before the focus is found, the way may bend around four posts, one after the other.
    for bend in range(4):
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
        post = np.where(blocks, seen.room, np.inf).argmin(axis=1)
        own = seen.only(post)
        wall = seen.wall(own)
        together = (wall & seen.only(best)).any(axis=1)
        longer = longer_on_the_left(seen, reach, wall, x, y)
        way = np.where(together, best_side, np.where(longer <= 0, LEFT, RIGHT))
        # The obstacle in focus is passed on the other side only if that saves much.
        held = longer < np.where(side == LEFT, LONGER, -LONGER)
        known = (wall & seen.only(focus)).any(axis=1)
        way = np.where(known, np.where(held, LEFT, RIGHT), way)
        if bend == 0:
            # The policies drive straight to the goal where only the wider disc is in the way.
            straight = pick(nearest, own) >= (pick(reach, own) - wider) ** 2
            way = np.where((post == focus) & straight, on_side(seen, own, x, y), way)
        kept_side = np.where((post == focus) & more, way, kept_side)
        best, best_side = np.where(more, post, best), np.where(more, way, best_side)
        passed = passed | (own & more[:, None])
        soon = np.minimum(pick(when, own), PROJECTED)
        next_x, next_y = tangent(
            pick(seen.x, own) + soon * pick(seen.vx, own),
            pick(seen.y, own) + soon * pick(seen.vy, own),
            pick(reach, own),
            np.where(way == LEFT, 1.0, -1.0),
        )
        x, y = np.where(more, next_x, x), np.where(more, next_y, y)
        far = np.maximum(norm(x, y), TINY)
    return Bend(best, best_side, kept_side, x, y, passed)


def least_room(seen: Seen, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns how close robots come to the posts' surfaces, while they turn to x, y (n,): (n, K) [m].

    This looks a second ahead, four times a quarter of it.
    """
    glances, glance = 4, 0.25  # [s]
    turn = np.arctan2(cross(seen.cos, seen.sin, x, y), dot(seen.cos, seen.sin, x, y))[:, None]
    most = glance * (np.arange(glances) + 0.5)
    heading = seen.heading[:, None] + np.minimum(np.maximum(turn, -most), most)
    step = norm(x, y)[:, None] - glance * np.arange(glances)
    step = np.minimum(np.maximum(step, 0.0), glance)
    sums = np.triu(np.ones((glances, glances)))  # of the steps so far
    place_x, place_y = (step * np.cos(heading)) @ sums, (step * np.sin(heading)) @ sums
    time = glance * np.arange(1, glances + 1)[:, None]
    away_x = seen.x[:, None] + time * seen.vx[:, None] - place_x[:, :, None]
    away_y = seen.y[:, None] + time * seen.vy[:, None] - place_y[:, :, None]
    return norm(away_x, away_y).min(axis=1) - seen.radius


def on_side(seen: Seen, own: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns on which sides (n,) ways to x, y (n,) pass posts (n, K) bool."""
    return np.where(cross(x, y, pick(seen.x, own), pick(seen.y, own)) < 0, LEFT, RIGHT)


def choose(
    seen: Seen,
    focus: np.ndarray,
    side: np.ndarray,
    swing: float = 0.0,
    margin: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the posts in focus (n,), and the sides (n,) on which they are passed.

    Args:
        seen: what was measured.
        focus, side: (n,) of before, -1 for none.
        swing: how far two measurements of the same place can be from each other [m]. What decides changes
            by more than that before another decision follows.
        margin: distance from the posts' surfaces at which the guard holds the robot back [m].
    """
    # The difference of two distances changes by twice as much as either.
    nearer = wider = 2 * swing
    own = seen.only(focus)
    bend = first_bend(seen, focus, side, wider)
    # Nothing blocks the way: the nearest post.
    room, room_of_known = seen.room, pick(seen.room, own)
    least = room.min(axis=1)
    other = (focus < 0) | ((least < NEARBY) & (room_of_known > least + nearer))
    idle = np.where(other, room.argmin(axis=1), focus)
    idle_side = on_side(seen, seen.only(idle), seen.goal_x, seen.goal_y)
    idle_side = np.where(idle == focus, side, idle_side)
    free = bend.focus < 0
    best, best_side = np.where(free, idle, bend.focus), np.where(free, idle_side, bend.side)
    # What is too close on the way.
    close_by = least_room(seen, bend.x, bend.y) - CLOSE - swing * own
    close = close_by.argmin(axis=1)
    # The post in focus keeps it while it matters, unless another one that does is nearer.
    matters = ((bend.around | (close_by < 0)) & own).any(axis=1)
    urgent = (close_by.min(axis=1) < 0) & (close != best)
    close_side = on_side(seen, seen.only(close), bend.x, bend.y)
    known = (seen.wall(seen.only(close)) & own).any(axis=1)
    close_side = np.where(known, side, close_side)
    best, best_side = np.where(urgent, close, best), np.where(urgent, close_side, best_side)
    first = seen.only(best)
    room_of_best = pick(room, first)
    kept = matters & (room_of_best > room_of_known - nearer)
    # A post that holds the robot back takes the focus, or the robot would stand there for ever.
    held = (room_of_best < margin + HOLDING) & (room_of_best < room_of_known)
    kept = kept & ~(held & (pick(seen.towards, first) > 0))
    return np.where(kept, focus, best), np.where(kept, bend.kept_side, best_side)


def turn_sense(turn: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns the senses (n,) in which to turn by angles (n,) [rad]: 1 against the clock, -1 with it.

    `sense` (n,) are those of before, 0 for none.
    """
    shorter = np.where(turn >= 0, 1, -1)
    return np.where((np.abs(turn) <= TURNED) | (sense == 0), shorter, sense)
