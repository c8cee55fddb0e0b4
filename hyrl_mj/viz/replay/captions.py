"""The captions of a panel: a bar above the scene and one below."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hyrl_mj.simulation import HybridArc
from hyrl_mj.viz.colours import BAD, GOOD, INK, OPEN, WHITE, is_light
from hyrl_mj.viz.replay.panel import Track

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
OUTCOMES = {
    "reached": ("arrived", GOOD),
    "crashed": ("crashed", BAD),
    "out_of_bounds": ("left the arena", BAD),
    "stalled": ("stalled", BAD),
    "waited": ("waited at the goal", OPEN),
    "unstable": ("simulation broke down", BAD),
    "running": ("not there yet", OPEN),
    "missed": ("ended off the goal", OPEN),
}


# The tracks of each controller's arcs, by its title.
Groups = Mapping[str, Sequence[Track]]


@dataclass(frozen=True)
class Layout:
    """Where a panel has its captions: its size [pixels], `finer` times larger than it will be seen."""

    width: int
    height: int
    finer: int = 1

    @property
    def text(self) -> int:
        """Height of the letters [pixels]."""
        seen = min(self.width / 32, self.height / 30) / self.finer
        return max(8, int(seen)) * self.finer

    @property
    def bar(self) -> int:
        """Height of a bar [pixels]."""
        return 2 * self.text

    @property
    def scene_height(self) -> int:
        """Height that is left to the scene [pixels]."""
        return self.height - 2 * self.bar

    @cached_property
    def fonts(self) -> tuple[Font, Font]:
        """A font for titles, and a smaller one."""
        return ImageFont.load_default(self.text), ImageFont.load_default(round(0.85 * self.text))

    def above(self, title: str, arc: HybridArc) -> np.ndarray:
        """Returns the bar with title and noise: (bar, width, 3)."""
        line = _Line(self)
        quiet = arc.noise == "none" or arc.bound == 0
        noise = "no noise" if quiet else f"{arc.noise} noise, eps = {arc.bound:g}"
        line.words(line.fitting(title, self.fonts[1].getlength(noise), large=True), INK, large=True)
        line.at_right(noise)
        return line.pixels

    def below(self, groups: Groups, t: float) -> np.ndarray:
        """Returns the bar with time, modes and outcomes at time t [s]: (bar, width, 3)."""
        line = _Line(self)
        end = max(track.end for tracks in groups.values() for track in tracks)
        line.words(f"t = {min(t, end):.2f} s", INK, room="t = 00.00 s")
        for title, tracks in groups.items():
            if len(groups) > 1:
                line.words(title, INK)
            if len(tracks) == 1 and tracks[0].modes:
                (track,) = tracks
                task, arc, row = track.task, track.arc, track.arc.at(t)
                line.words(f"j = {int((track.jumps <= row).sum())}", INK, room="j = 00")
                room = self.fonts[1].getlength(OUTCOMES[arc.ending(task)][0]) + self.text
                mode = task.mode_name(int(arc.q[row]))
                line.badge(line.fitting(f"q = {mode}", room), track.colour(row))
            ended = Counter(track.arc.ending(track.task) for track in tracks if t >= track.end)
            for outcome, number in sorted(ended.items()):
                words, colour = OUTCOMES[outcome]
                share = f"{number} of {len(tracks)} " if len(tracks) > 1 else ""
                line.badge(share + words, colour)
        return line.pixels


class _Line:
    """A bar with words, from left to right."""

    def __init__(self, layout: Layout):
        self._large, self._small = layout.fonts
        self._image = Image.new("RGB", (layout.width, layout.bar), "#f6f7f9")
        self._draw = ImageDraw.Draw(self._image)
        self._gap, self._middle = layout.text, layout.bar // 2
        self._x = self._gap / 2
        edge = layout.width - 1
        self._draw.line([(edge, 0), (edge, layout.bar)], "#cdd0d5")

    @property
    def pixels(self) -> np.ndarray:
        """The bar: (height, width, 3) uint8."""
        return np.asarray(self._image)

    def fitting(self, words: str, beside: float, *, large: bool = False) -> str:
        """Returns words without what is in brackets, if they leave too little room [pixels] beside them."""
        font = self._large if large else self._small
        ends = self._x + font.getlength(words) + beside + 2 * self._gap
        return words if ends <= self._image.width else re.sub(r" \(.*\)", "", words)

    def words(self, words: str, colour: str, *, large: bool = False, room: str = "") -> None:
        """Writes words, which take at least as much room as the text `room`."""
        font = self._large if large else self._small
        self._draw.text((self._x, self._middle), words, colour, font, anchor="lm")
        self._x += max(font.getlength(words), font.getlength(room)) + self._gap

    def badge(self, words: str, colour: str) -> None:
        """Writes words on a coloured plate: white ones, or dark ones if it is light."""
        pad, half = self._gap / 3, 0.75 * self._gap
        end = self._x + self._small.getlength(words) + 2 * pad
        self._draw.rectangle((self._x, self._middle - half, end, self._middle + half), colour)
        ink = INK if is_light(colour) else WHITE
        self._draw.text((self._x + pad, self._middle), words, ink, self._small, anchor="lm")
        self._x = end + self._gap / 2

    def at_right(self, words: str) -> None:
        """Writes words at the right end."""
        x = self._image.width - self._gap / 2
        self._draw.text((x, self._middle), words, OPEN, self._small, anchor="rm")
