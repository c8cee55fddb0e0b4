"""The options of a replay, which `render_replay` and the command line share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral
from typing import Annotated

from hyrl_mj.errors import BadInput
from hyrl_mj.ranges import By, Checked, Integer, Number, OneOf


def _size(size: object) -> tuple[int, int]:
    """Returns width and height, if they are two integers."""
    match size:
        case (Integral() as width, Integral() as height):
            return int(width), int(height)
    raise BadInput(f"size {size!r} cannot be used: give width and height [pixels]")


@dataclass(frozen=True)
class ReplayOptions(Checked):
    """How a replay is rendered.

    Attributes:
        layout: side-by-side, or overlay (both controllers in one scene).
        camera: a camera of the MJCF, as overhead, chase or three_quarter; by default the scene's.
        size: width and height of the video [pixels], even numbers, at least 480x160 side by side.
        fps: frames per second.
        slow_motion: how many times slower the video is around jumps.
    """

    layout: Annotated[str, OneOf(("side-by-side", "overlay"))] = "side-by-side"
    camera: str | None = None
    size: Annotated[tuple[int, int], By(_size)] = (1280, 720)
    fps: Annotated[int, Integer(1, 240)] = 30
    slow_motion: Annotated[float, Number(1, 100)] = 1.0

    def lasting(self, seconds: float) -> ReplayOptions:
        """Returns these options with at most 600 frames in so many seconds [s], but at least 10 a second."""
        # An arc that ends where it begins lasts no time.
        return replace(self, fps=max(10, min(self.fps, int(600 / max(seconds, 1.0)))))


USUAL = ReplayOptions()
