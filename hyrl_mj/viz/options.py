"""The options of a replay, which `render_replay` and the command line share."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ReplayOptions:
    """How a replay is rendered.

    Attributes:
        layout: side-by-side, or overlay (both controllers in one scene).
        camera: a camera of the MJCF, as overhead, chase or three_quarter; by default the scene's.
        size: width and height of the video [pixels], even numbers, at least 480x160 side by side.
        fps: frames per second.
        slow_motion: how many times slower the video is around jumps.
    """

    layout: str = "side-by-side"
    camera: str | None = None
    size: tuple[int, int] = (1280, 720)
    fps: int = 30
    slow_motion: float = 1.0

    def lasting(self, seconds: float) -> ReplayOptions:
        """Returns these options with at most 600 frames in so many seconds [s], but at least 10 a second."""
        # An arc that ends where it begins lasts no time.
        return replace(self, fps=max(10, min(self.fps, int(600 / max(seconds, 1.0)))))


USUAL = ReplayOptions()
