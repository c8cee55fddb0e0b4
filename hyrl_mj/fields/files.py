"""Files of fields: posts, a goal and starts in JSON, whose keys hold their units."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput, brief, unknown
from hyrl_mj.files import artifacts
from hyrl_mj.tasks import Layouts, wrapped

# How far from the origin anything may be, and the largest radius [m]; the longest run and time between two
# positions [s].
FARTHEST, LONGEST = 1_000.0, 3_600.0
LEAST = 1e-9  # of what is positive: what is divided by it is a number, too
# How many posts a field may have, so that the memory suffices.
MOST_POSTS = 100
# What the keys hold.
MEANING = {
    "goal_m": "the goal [x, y] in m",
    "posts": "a list of posts",
    "starts": "a list of starts",
    "interval_s": "the time between two positions of a post in s",
    "time_s": "the time of a run in s",
    "radius_m": "the radius in m",
    "positions_m": "a list of positions [x, y] in m",
    "position_m": "the position [x, y] in m",
    "heading_rad": "the heading in rad",
}
SHOWN = 40  # characters of a value in a message


@dataclass(frozen=True)
class FieldFile:
    """What a file says of a field. Its posts and starts are numbered from 0 on.

    Attributes:
        name: path of the file.
        layouts: the field, one layout.
        starts: (n, 3) poses x, y, heading [m, m, rad].
        time: longest time of a run [s].
    """

    name: str
    layouts: Layouts
    starts: np.ndarray
    time: float

    @property
    def standing(self) -> np.ndarray:
        """(K,) bool: whether a post stands still for all time."""
        return np.asarray((np.ptp(self.layouts.tracks[0], axis=0) == 0).all(axis=1))


def read_field(path: str | Path) -> FieldFile:
    """Reads a field from a JSON file.

    A post with one position stands; one with several moves straight from each to the next in `interval_s`,
    and stands at the last one.

        {"goal_m": [0, 0], "posts": [{"radius_m": 0.5, "positions_m": [[-3, 0]]}],
         "starts": [{"position_m": [-6, 0], "heading_rad": 0}]}

    Raises:
        BadInput: the file cannot be read, a key is missing or unknown, or a value cannot be used; the
            message names the place in the file.
    """
    path = Path(path)
    keys = ("goal_m", "posts", "starts")
    whole = _Part(path, "", _content(path)).object(keys, ("interval_s", "time_s"))
    posts = [
        post.object(("radius_m", "positions_m"))
        for post in whole["posts"].items("posts", MOST_POSTS)
    ]
    tracks = [
        [place.point() for place in post["positions_m"].items("positions", 10_000)]
        for post in posts
    ]
    longest = max(map(len, tracks))
    interval = 1.0
    if "interval_s" in whole:
        interval = whole["interval_s"].number(LONGEST, "s", positive=True)
    elif longest > 1:
        moving = next(i for i, track in enumerate(tracks) if len(track) > 1)
        raise BadInput(
            f"{path}: posts[{moving}] has {len(tracks[moving])} positions, but the file has no "
            f"interval_s: give it {MEANING['interval_s']}"
        )
    # A post that has arrived stays.
    full = [track + track[-1:] * (longest - len(track)) for track in tracks]
    starts = [
        start.object(("position_m", "heading_rad"))
        for start in whole["starts"].items("starts", 1_000)
    ]
    headings = np.array([start["heading_rad"].number(FARTHEST, "rad") for start in starts])
    layouts = Layouts(
        np.array(full).transpose(1, 0, 2)[None],
        np.array([[post["radius_m"].number(FARTHEST, "m", positive=True) for post in posts]]),
        np.array([whole["goal_m"].point()]),
        interval,
    )
    time = 15.0
    if "time_s" in whole:
        time = whole["time_s"].number(LONGEST, "s", positive=True)
    # [s]: each sample of each run is kept, with what is known of each post. This takes up to 8 GB.
    most = 500_000.0 / (len(posts) + 4)
    if time * len(starts) > most:
        raise BadInput(
            f"{path} has {len(starts):,} starts with runs of {time:g} s each, and {len(posts)} post(s): give "
            f"at most {most:,.0f} s of all together"
        )
    places = np.array([start["position_m"].point() for start in starts])
    return FieldFile(str(path), layouts, np.column_stack([places, wrapped(headings)]), time)


def _content(path: Path) -> Any:
    """Returns what the JSON file holds."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        counts = Counter(name for name, _ in pairs)
        for name, count in counts.items():
            if count > 1:
                raise BadInput(f"{path} has the key {name[:SHOWN]!r} twice in a row: give it once")
        return dict(pairs)

    needed = "give the JSON file of a field"
    fewer = f"give a JSON file of a field, with at most {MOST_POSTS} posts"
    content = artifacts.read_given(path, needed, smaller=fewer)
    try:
        # Some editors begin a file with a mark of its encoding.
        return json.loads(content.decode("utf-8-sig"), object_pairs_hook=once)
    except BadInput:
        raise
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path} is not JSON ({brief(error)}): {needed}") from None


@dataclass(frozen=True)
class _Part:
    """A value of a file, with its place there: "posts[0].radius_m", "" for the whole."""

    path: Path
    place: str
    value: Any

    def object(self, needed: Iterable[str], other: Iterable[str] = ()) -> dict[str, _Part]:
        """Returns the parts of an object by their keys, or raises `BadInput`."""
        needed, allowed = [*needed], [*needed, *other]
        if not isinstance(self.value, dict):
            raise self._refused(f"an object with the keys {', '.join(needed)}")
        where = self.place or "the file"
        for key in self.value:
            if key not in allowed:
                raise BadInput(f"{self.path}: {_unknown(key, where, allowed)}")
        for key in needed:
            if key not in self.value:
                raise BadInput(f"{self.path}: {where} has no {key}: give it {MEANING[key]}")
        start = f"{self.place}." if self.place else ""
        return {k: _Part(self.path, f"{start}{k}", v) for k, v in self.value.items()}

    def items(self, what: str, most: int) -> list[_Part]:
        """Returns the parts of a list, at least one, or raises `BadInput`."""
        if not isinstance(self.value, list):
            raise self._refused(f"a list of {what}, from 1 to {most:,}")
        if not 1 <= len(self.value) <= most:
            raise BadInput(
                f"{self.path}: {self.place} has {len(self.value):,} {what}: give from 1 to {most:,}"
            )
        return [_Part(self.path, f"{self.place}[{i}]", v) for i, v in enumerate(self.value)]

    def point(self) -> list[float]:
        """Returns x and y [m], or raises `BadInput`."""
        if not isinstance(self.value, list) or len(self.value) != 2:
            raise self._refused("two numbers [x, y] in m")
        parts = [_Part(self.path, f"{self.place}[{i}]", v) for i, v in enumerate(self.value)]
        return [part.number(FARTHEST, "m") for part in parts]

    def number(self, most: float, unit: str, positive: bool = False) -> float:
        """Returns a number of that magnitude at most, or raises `BadInput`."""
        # In Python true and false are numbers. NaN is not within any limits.
        is_number = isinstance(self.value, int | float) and not isinstance(self.value, bool)
        if is_number and -most <= self.value <= most and not (positive and self.value < LEAST):
            return float(self.value)
        limits = (
            f"> 0, at least {LEAST:g} and at most {most:g}"
            if positive
            else f"from {-most:g} to {most:g}"
        )
        raise self._refused(f"a number {limits} {unit}")

    def _refused(self, meaning: str) -> BadInput:
        given = json.dumps(self.value)
        given = given if len(given) <= SHOWN else f"{given[: SHOWN - 3]}..."
        return BadInput(f"{self.path}: {self.place or 'the file'} is {given}: give {meaning}")


def _unknown(key: str, where: str, allowed: list[str]) -> BadInput:
    """Returns the error for a key that is not allowed, perhaps because it has another unit."""
    stem = key.rpartition("_")[0] or key
    for known in allowed:
        name, _, unit = known.rpartition("_")
        if unit in ("m", "rad", "s") and name in (key, stem):
            return BadInput(
                f"{where} has {key!r}, but this is measured in {unit}: give {known!r}, {MEANING[known]}"
            )
    return unknown(f"key of {where}", key, allowed)
