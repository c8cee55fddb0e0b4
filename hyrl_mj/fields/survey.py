"""A look at a field before anything drives: what makes it impossible, and what the policies do not know."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.fields.files import FieldFile
from hyrl_mj.fields.seen import ROOM
from hyrl_mj.tasks import FASTEST, RADII, TAKEN, length

# How many posts, or gaps, a sentence names.
NAMED = 4


def check_passable(field: FieldFile, body: float) -> None:
    """Raises `BadInput` if no robot of radius `body` [m] can start, or arrive.

    This is so where a post overlaps a start or stands over the goal, and where posts that stand leave no way
    from a start to the goal.
    """
    goal, tracks = field.layouts.goals[0], field.layouts.tracks[0]
    radii, standing = field.layouts.radii[0], field.standing
    for number, start in enumerate(field.starts):
        room = length(tracks[0] - start[:2]) - radii
        if room[post := int(room.argmin())] <= body:
            raise BadInput(
                f"{field.name}: post {post} is {_gap(room[post])} from start {number}, where the robot of "
                f"radius {body:g} m touches it: move one of the two"
            )
    room = np.where(standing, length(tracks[0] - goal) - radii, np.inf)
    if room[post := int(room.argmin())] <= body:
        raise BadInput(
            f"{field.name}: post {post} is {_gap(room[post])} from the goal, where the robot of radius "
            f"{body:g} m cannot stand: move one of the two"
        )
    if standing.any():
        _check_ways(field, body)


def _check_ways(field: FieldFile, body: float) -> None:
    """Raises `BadInput` if posts that stand leave no way from a start to the goal.

    Cells count as free if any place in them is: where they are parted, there is no way.
    """
    from scipy import ndimage  # slow to import

    standing = field.standing
    posts, reach = field.layouts.tracks[0][0, standing], field.layouts.radii[0, standing] + body
    # Around all posts a robot can pass: what is farther away is free.
    low, high = (posts - reach[:, None]).min(axis=0), (posts + reach[:, None]).max(axis=0)
    cell = max(0.02, float((high - low).max()) / 1_000)  # [m]
    low, high = low - 3 * cell, high + 3 * cell
    x, y = (np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True))
    room = np.full((len(x), len(y)), np.inf)
    for post, radius in zip(posts, reach, strict=True):
        away = np.hypot(x[:, None] - post[0], y - post[1])
        np.minimum(room, away - radius, out=room)
    parts, _ = ndimage.label(room >= -cell / np.sqrt(2), structure=np.ones((3, 3)))

    def part_of(place: np.ndarray) -> int:
        inside = np.clip(np.rint((place - low) / cell).astype(int), 0, np.array(parts.shape) - 1)
        return int(parts[tuple(inside)])

    goal = part_of(field.layouts.goals[0])
    for number, start in enumerate(field.starts):
        if (begun := part_of(start[:2])) != goal:
            # The part that does not reach around all posts is shut in.
            shut = begun if goal == parts[0, 0] else goal
            cells = np.argwhere(parts == shut) * cell + low
            ring = [
                np.hypot(*(cells - post).T).min() - radius < 2 * cell
                for post, radius in zip(posts, reach, strict=True)
            ]
            names = _listed(np.flatnonzero(standing)[ring], "post", "posts")
            what = f"start {number}" if shut == begun else "the goal"
            raise BadInput(
                f"{field.name}: {names} shut {what} in, for a robot of radius {body:g} m: leave it a way "
                f"of more than {2 * body:g} m, so that it can get to the goal"
            )


def cautions(field: FieldFile, body: float, speed: float = 1.0) -> list[str]:
    """Returns a sentence about each thing in a field that the policies were not made for.

    `body` is the radius of the robot [m], `speed` its greatest speed [m/s].
    """
    return [f"{field.name}: {text}" for text in _cautions(field, body, speed)]


def _cautions(field: FieldFile, body: float, speed: float) -> Iterator[str]:
    layouts, standing = field.layouts, field.standing
    radii, places = layouts.radii[0], layouts.tracks[0, 0]
    gaps = length(places[:, None] - places) - radii[:, None] - radii
    first, second = np.triu_indices(len(radii), 1)
    both = standing[first] & standing[second]
    first, second = first[both], second[both]
    gap = gaps[first, second]
    order = np.argsort(gap, kind="stable")
    pairs = [(int(first[i]), int(second[i]), float(gap[i])) for i in order]
    one = [pair for pair in pairs if pair[2] < ROOM]
    made_for = 0.8  # the gap that the policies were made for [m]
    narrow = [pair for pair in pairs if ROOM <= pair[2] < made_for]
    if one:
        yield (
            f"{_pairs(one)}, less than {ROOM:g} m (the robot is {2 * body:g} m wide): such posts are passed "
            "around as one obstacle, and a robot may stay in front of a row of many, or of a bent one"
        )
    if narrow:
        yield (
            f"{_pairs(narrow)}, less than the {made_for:g} m that the policies were made for: a robot under "
            "noise may touch a post there"
        )
    odd = np.flatnonzero((radii < RADII[0]) | (radii > RADII[1]))
    if len(odd):
        values = _range(radii[odd], "m")
        yield (
            f"{_listed(odd, 'post has a radius', 'posts have radii')} of {values}: the policies were "
            f"trained with {RADII[0]:g} to {RADII[1]:g} m"
        )
    speeds = length(np.diff(layouts.tracks[0], axis=0)).max(axis=0, initial=0.0) / layouts.interval
    fast = np.flatnonzero(speeds > FASTEST * (1 + 1e-9))
    if len(fast):
        yield (
            f"{_listed(fast, 'post moves', 'posts move')} at up to {_range(speeds[fast], 'm/s')}: the "
            f"policies were trained with at most {FASTEST:g} m/s"
        )
    ways = length(field.starts[:, :2] - layouts.goals[0])
    late = np.flatnonzero(ways > speed * field.time)
    if len(late):
        yield (
            f"{_listed(late, 'start is', 'starts are')} {_range(ways[late], 'm')} from the goal, farther "
            f"than a robot of {speed:g} m/s drives within {field.time:g} s: give a longer time_s"
        )
    away = length(layouts.tracks[0, -1] - layouts.goals[0]) - radii
    close = np.flatnonzero(away < TAKEN)
    if len(close):
        yield (
            f"{_listed(close, 'post ends', 'posts end')} {_range(away[close], 'm')} from the goal: where "
            f"less than {TAKEN:g} m are left, a robot may wait near it and not arrive"
        )


def _gap(room: float) -> str:
    """Returns a distance from a surface: "0.05 m"; "0 m" inside."""
    return f"{max(room, 0.0):.2g} m"


def _pairs(pairs: Sequence[tuple[int, int, float]]) -> str:
    """Returns which posts are how far apart, the closest first."""
    texts = [
        f"posts {a} and {b} " + (f"are {gap:.2g} m apart" if gap > 0 else "overlap")
        for a, b, gap in pairs[:NAMED]
    ]
    more = f" and {len(pairs) - NAMED} more pairs" if len(pairs) > NAMED else ""
    return f"{', '.join(texts)}{more}"


def _listed(numbers: Sequence[int] | np.ndarray, one: str, several: str) -> str:
    """Returns "post 3 moves", "posts 1, 2, 5 and 4 more move" of "post moves", "posts move"."""
    noun, _, rest = (one if len(numbers) == 1 else several).partition(" ")
    named = ", ".join(str(int(n)) for n in numbers[:NAMED])
    more = f" and {len(numbers) - NAMED} more" if len(numbers) > NAMED else ""
    return f"{noun} {named}{more} {rest}".strip()


def _range(values: np.ndarray, unit: str) -> str:
    """Returns "0.2 m", or "0.2 to 1.5 m"."""
    low, high = (f"{v:.3g}" for v in (values.min(), values.max()))
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"
