"""One robot at a time, in plain Python: for a dozen posts NumPy takes longer to call than to compute.

`Single` does what `FocusController.answer` does, line by line, and the tests hold it to that. What the steps
are for is said there, and in `focus` and `guard`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import acos, asin, atan2, cos, hypot, inf, pi, sin, sqrt, tanh

from hyrl_mj.fields.focus import (
    BENDS,
    CLOSE,
    CLOSING,
    GLANCE,
    GLANCES,
    HOLDING,
    LONGER,
    NEARBY,
    ROOM,
    TURNED,
)
from hyrl_mj.fields.guard import (
    COMING,
    GAIN,
    LEAST,
    LOOK,
    LOOKS,
    RATE,
    SLOWEST,
    STEEP,
    Guard,
)
from hyrl_mj.fields.modes import MODES_OF_POST
from hyrl_mj.fields.seen import TINY
from hyrl_mj.tasks import CLEAR, LEFT, OF_POST, POSE, PROJECTED, RIGHT

Inputs = Callable[[int, list[float]], Sequence[float]]


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi


def _tangent(x: float, y: float, radius: float, sign: float) -> tuple[float, float]:
    far = sqrt(max(x * x + y * y, TINY))
    sine = min(radius / far, 1.0)
    cosine = sqrt(1 - sine * sine)
    share = max(cosine, CLEAR / far)
    sine *= sign
    return share * (x * cosine - y * sine), share * (y * cosine + x * sine)


@dataclass
class _Seen:
    """A measurement of one robot: see `seen.Seen`, with a number for each post in the lists."""

    goal_x: float
    goal_y: float
    goal_far: float
    heading: float
    cos: float
    sin: float
    x: list[float]
    y: list[float]
    vx: list[float]
    vy: list[float]
    radius: list[float]
    far: list[float]
    room: list[float]

    @staticmethod
    def from_row(row: list[float]) -> _Seen:
        place_x, place_y, heading, goal_x, goal_y = row[:POSE]
        end = len(row) - (len(row) - POSE) % OF_POST
        columns = [row[POSE + i : end : OF_POST] for i in range(OF_POST)]
        x, y = [a - place_x for a in columns[0]], [a - place_y for a in columns[1]]
        vx, vy, radius = columns[2:]
        far = [max(hypot(a, b), TINY) for a, b in zip(x, y, strict=True)]
        goal_x, goal_y = goal_x - place_x, goal_y - place_y
        return _Seen(
            goal_x, goal_y, max(hypot(goal_x, goal_y), TINY), heading, cos(heading), sin(heading),
            x, y, vx, vy, radius, far, [f - r for f, r in zip(far, radius, strict=True)],
        )  # fmt: skip


@dataclass(frozen=True)
class Single:
    """The step of a `FocusController` for one robot.

    Attributes:
        guard: of the controller.
        swing: of the controller [m].
        inputs: returns the inputs of the policy of a side for an observation (17,).
    """

    guard: Guard
    swing: float
    inputs: Inputs

    def __call__(self, q: int, row: list[float]) -> tuple[float, float, int]:
        """Returns speed [m/s], rate of turn [rad/s] and next mode, for a mode and a measurement."""
        seen = _Seen.from_row(row)
        focus, rest = divmod(q, MODES_OF_POST)
        side, sense = rest // 2, 1 - 2 * (rest % 2)
        focus, side = self._choose(seen, focus, side)
        turn, sense, observed = _way(seen, focus, side, sense)
        speed, rate = self.inputs(side, observed)
        speed, rate = self._guarded(seen, speed, rate, turn, sense)
        return speed, rate, MODES_OF_POST * focus + 2 * side + (sense < 0)

    def _choose(self, seen: _Seen, focus: int, side: int) -> tuple[int, int]:
        count, nearer, room = range(len(seen.x)), 2 * self.swing, seen.room
        best, best_side, kept_side, x, y, around = _first_bend(seen, focus, side, nearer)
        known = room[focus]
        least = min(room)
        if best < 0:
            best = room.index(least) if least < NEARBY and known > least + nearer else focus
            best_side = side if best == focus else _on_side(seen, best, seen.goal_x, seen.goal_y)
        close_by = _least_room(seen, x, y)
        close_by = [close_by[i] - CLOSE - (self.swing if i == focus else 0.0) for i in count]
        tightest = min(close_by)
        close = close_by.index(tightest)
        if tightest < 0 and close != best:
            best, best_side = close, side if close == focus else _on_side(seen, close, x, y)
        of_best = room[best]
        kept = (focus in around or close_by[focus] < 0) and of_best > known - nearer
        if of_best < self.guard.margin + HOLDING and of_best < known:
            kept = kept and seen.x[best] * seen.cos + seen.y[best] * seen.sin <= 0
        return (focus, kept_side) if kept else (best, best_side)

    def _guarded(
        self, seen: _Seen, speed: float, rate: float, turn: float, sense: int
    ) -> tuple[float, float]:
        guard = self.guard
        creep = LEAST * cos(turn)
        if creep < 0:
            speed, rate = 0.0, sense * guard.rate
        else:
            x, y, far = seen.goal_x, seen.goal_y, seen.goal_far
            behind = seen.cos * x + seen.sin * y < 0
            aside = far if behind else abs(seen.cos * y - seen.sin * x)
            fastest = max(guard.rate * far * far / (2 * max(aside, TINY)), SLOWEST)
            speed = min(max(speed, creep), fastest)
        least, most, away = self._bounds(seen)
        bounded = (least + most) / 2 if least > most else min(max(speed, least), most)
        if away and most < min(speed, creep):
            rate = away * guard.rate
        return self._evading(seen, bounded, rate)

    def _bounds(self, seen: _Seen) -> tuple[float, float, float]:
        guard, margin = self.guard, self.guard.margin
        least, most, first = -inf, inf, 0
        lateral = sqrt(2.0) * guard.noise
        for i, (x, y, far, room) in enumerate(
            zip(seen.x, seen.y, seen.far, seen.room, strict=True)
        ):
            towards = (x * seen.cos + y * seen.sin) / far
            allowed = RATE * max(room - margin, 0.0) + (x * seen.vx[i] + y * seen.vy[i]) / far
            across = sqrt(max(1 - towards * towards, 0.0)) * (lateral / far + guard.noise / 2)
            ahead, behind = towards + across, across - towards
            fast = allowed / max(ahead, 1e-3) if ahead > 0 else inf
            slow = -allowed / max(behind, 1e-3) if behind > 0 else -inf
            if allowed < 0:
                fast = max(fast, 0.0) if towards < STEEP else fast
                slow = min(slow, 0.0) if towards > -STEEP else slow
            if fast < most:
                most, first = fast, i
            least = max(least, slow)
        x, y = seen.x[first], seen.y[first]
        beside = (x * seen.cos + y * seen.sin) / seen.far[first] < STEEP
        away = 0.0
        if beside:
            away = -1.0 if seen.cos * y - seen.sin * x > 0 else 1.0
        low, high = guard.low, guard.high
        return min(max(least, low), high), min(max(most, low), high), away

    def _evading(self, seen: _Seen, speed: float, rate: float) -> tuple[float, float]:
        posts = [*zip(seen.x, seen.y, seen.vx, seen.vy, seen.radius, strict=True)]
        coming = [
            -(p[0] * p[2] + p[1] * p[3]) > COMING * far
            for p, far in zip(posts, seen.far, strict=True)
        ]
        if not any(coming):
            return speed, rate
        guard, heading = self.guard, seen.heading

        def rooms(v: float, w: float) -> list[float]:
            least = [inf] * len(posts)
            for k in range(1, LOOKS + 1):
                time = k * LOOK
                angle = heading + w * (time / 2)
                step_x, step_y = v * time * cos(angle), v * time * sin(angle)
                for i, (x, y, vx, vy, radius) in enumerate(posts):
                    room = hypot(x + time * vx - step_x, y + time * vy - step_y) - radius
                    least[i] = min(least[i], room)
            return least

        now = rooms(speed, rate)
        if min(r for r, comes in zip(now, coming, strict=True) if comes) >= guard.margin:
            return speed, rate
        best = min(min(now) + GAIN, guard.margin)
        own = rate
        for w in (own, guard.rate, -guard.rate):
            for v in (guard.high, guard.low):
                if (other := min(rooms(v, w))) > best:
                    best, speed, rate = other, v, w
        return speed, rate


def _on_side(seen: _Seen, post: int, x: float, y: float) -> int:
    return LEFT if x * seen.y[post] - y * seen.x[post] < 0 else RIGHT


def _wall(seen: _Seen, post: int) -> set[int]:
    """Returns the posts that are one obstacle with a post."""
    mine, waiting, count = {post}, [post], len(seen.x)
    while waiting:
        i = waiting.pop()
        x, y, vx, vy, reach = seen.x[i], seen.y[i], seen.vx[i], seen.vy[i], seen.radius[i] + ROOM
        for j in range(count):
            if j in mine:
                continue
            dx, dy, apart = x - seen.x[j], y - seen.y[j], reach + seen.radius[j]
            sx, sy = dx + CLOSING * (vx - seen.vx[j]), dy + CLOSING * (vy - seen.vy[j])
            if min(dx * dx + dy * dy, sx * sx + sy * sy) < apart * apart:
                mine.add(j)
                waiting.append(j)
    return mine


def _longer(
    seen: _Seen, post: int, mine: set[int], reach: list[float], x: float, y: float
) -> float:
    own_x, own_y, lengths = seen.x[post], seen.y[post], []
    ends = []
    for i in sorted(mine):
        xi, yi = seen.x[i], seen.y[i]
        off = atan2(own_x * yi - own_y * xi, own_x * xi + own_y * yi)
        ends.append((off, asin(min(reach[i] / seen.far[i], 1.0)), i))
    for sign in (1.0, -1.0):
        last = max(ends, key=lambda end: sign * end[0] + end[1])[2]
        leg_x, leg_y = _tangent(seen.x[last], seen.y[last], reach[last], sign)
        lengths.append(hypot(leg_x, leg_y) + hypot(x - leg_x, y - leg_y))
    return lengths[0] - lengths[1]


def _first_bend(
    seen: _Seen, focus: int, side: int, wider: float
) -> tuple[int, int, int, float, float, set[int]]:
    """Returns focus, side, the side of the post that was in focus, the target x, y, and the posts around."""
    reach = [r + CLEAR for r in seen.radius]
    reach[focus] += wider
    x, y, far = seen.goal_x, seen.goal_y, seen.goal_far
    best, best_side, kept_side, passed = -1, LEFT, side, set[int]()
    for bend in range(BENDS):
        ux, uy, post, nearest, when, least = x / far, y / far, -1, inf, 0.0, 0.0
        for i, (px, py) in enumerate(zip(seen.x, seen.y, strict=True)):
            if px * x + py * y <= 0 or seen.room[i] >= nearest or i in passed:
                continue
            vx, vy = ux - seen.vx[i], uy - seen.vy[i]
            time = (px * vx + py * vy) / max(vx * vx + vy * vy, TINY)
            time = min(max(time, 0.0), far)
            near_x, near_y = px - vx * time, py - vy * time
            near = near_x * near_x + near_y * near_y
            if near < reach[i] * reach[i]:
                post, nearest, when, least = i, seen.room[i], time, near
        if post < 0:
            break
        mine = _wall(seen, post)
        longer = _longer(seen, post, mine, reach, x, y)
        if post == focus:
            way = LEFT if longer < (LONGER if side == LEFT else -LONGER) else RIGHT
            if bend == 0 and least >= (reach[post] - wider) ** 2:
                way = _on_side(seen, post, x, y)
            kept_side = way
        elif best in mine:
            way = best_side
        else:
            way = LEFT if longer <= 0 else RIGHT
        best, best_side = post, way
        passed.add(post)
        soon = min(when, PROJECTED)
        x, y = _tangent(
            seen.x[post] + soon * seen.vx[post],
            seen.y[post] + soon * seen.vy[post],
            reach[post],
            1.0 if way == LEFT else -1.0,
        )
        far = max(hypot(x, y), TINY)
    return best, best_side, kept_side, x, y, passed


def _least_room(seen: _Seen, x: float, y: float) -> list[float]:
    turn = atan2(seen.cos * y - seen.sin * x, seen.cos * x + seen.sin * y)
    far, place_x, place_y, least = hypot(x, y), 0.0, 0.0, [inf] * len(seen.x)
    for k in range(GLANCES):
        most = GLANCE * (k + 0.5)
        heading = seen.heading + min(max(turn, -most), most)
        step = min(max(far - GLANCE * k, 0.0), GLANCE)
        place_x, place_y = place_x + step * cos(heading), place_y + step * sin(heading)
        time = GLANCE * (k + 1)
        least = [
            min(a, hypot(px + time * vx - place_x, py + time * vy - place_y))
            for a, px, py, vx, vy in zip(least, seen.x, seen.y, seen.vx, seen.vy, strict=True)
        ]
    return [a - r for a, r in zip(least, seen.radius, strict=True)]


def _way(seen: _Seen, post: int, side: int, sense: int) -> tuple[float, int, list[float]]:
    """Returns the turn to the way past a post, the sense of turning, and what the policies observe."""
    x, y, vx, vy, radius = (a[post] for a in (seen.x, seen.y, seen.vx, seen.vy, seen.radius))
    away, goal_x, goal_y = hypot(x, y), seen.goal_x, seen.goal_y
    soon = min(max(away - radius - CLEAR, 0.0), PROJECTED)
    ways = _ways_round(x + soon * vx, y + soon * vy, goal_x, goal_y, radius + CLEAR)
    (left, left_length), (right, right_length) = ways
    left, right = left - seen.heading, right - seen.heading
    turn = _wrapped(left if side == LEFT else right)
    if abs(turn) <= TURNED:
        sense = 1 if turn >= 0 else -1
    offset = sense * pi / 2
    turn_left, turn_right = (_wrapped(angle - offset) + offset for angle in (left, right))
    c, s, far, room = seen.cos, seen.sin, hypot(goal_x, goal_y), max(away - radius, 0.0)
    at_goal = max(hypot(x - goal_x, y - goal_y) - radius, 0.0)
    far_, away_ = max(far, 1e-6), max(away, 1e-6)
    cos_l, sin_l, cos_r, sin_r = cos(left), sin(left), cos(right), sin(right)
    observed = [
        (goal_x * c + goal_y * s) / far_, (goal_y * c - goal_x * s) / far_, far / (0.5 + far),
        (x * c + y * s) / away_, (y * c - x * s) / away_, room / (0.5 + room),
        radius, at_goal / (0.5 + at_goal), vx * c + vy * s, vy * c - vx * s,
        (cos_l + cos_r) / 2, (sin_l + sin_r) / 2, (cos_l - cos_r) / 2, (sin_l - sin_r) / 2,
        tanh(left_length - right_length),
        (turn_left + turn_right) / 8, (turn_left - turn_right) / 8,
    ]  # fmt: skip
    return turn, sense, observed


def _ways_round(
    post_x: float, post_y: float, goal_x: float, goal_y: float, radius: float
) -> list[tuple[float, float]]:
    """Returns direction and length of the ways on the left and on the right, as `tasks.field.ways_round`."""
    from_x, from_y = goal_x - post_x, goal_y - post_y
    away, far, goal_away = hypot(post_x, post_y), hypot(goal_x, goal_y), hypot(from_x, from_y)
    radius = min(radius, goal_away)
    deep = max(radius - away, 0.0)
    away = max(away, 1e-9)
    radius = min(radius, away)
    bearing, goal = atan2(post_y, post_x), atan2(goal_y, goal_x)
    back, ahead = atan2(-post_y, -post_x), atan2(from_y, from_x)
    own = acos(radius / away)
    both = own + acos(radius / max(goal_away, 1e-9))
    half = pi / 2 - own + min(deep / CLEAR, 1.0) * (pi / 2)
    off = _wrapped(goal - bearing)
    legs = sqrt(away * away - radius * radius) + sqrt(goal_away * goal_away - radius * radius)
    ways = []
    for sign in (1.0, -1.0):
        turn = sign * (back - ahead)
        if abs(_wrapped(turn)) <= both:
            leads_out = deep > 0 and abs(off) < half
            ways.append((bearing + (half if off >= 0 else -half) if leads_out else goal, far))
        else:
            around = radius * max(turn % (2 * pi) - both, 0.0)
            ways.append((bearing + sign * half, legs + around))
    return ways
