"""What a replay shows at a time: panels side by side or one for all, drawn on one canvas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.rendering import LARGEST, Canvas
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import Task
from hyrl_mj.viz.replay.captions import Group, Layout
from hyrl_mj.viz.replay.marks import Floor
from hyrl_mj.viz.replay.panel import Panel, Track

LAYOUTS = ("side-by-side", "overlay")
SMALLEST = (240, 160)  # [pixels] of a panel, for captions that can be read


@dataclass(frozen=True)
class Show:
    """Arcs that are played at the same time.

    Attributes:
        policy: arcs of the stage-1 policy.
        hybrid: arcs of the hybrid controller; none to show the policy alone.
        title: of the policy, as "RL policy (DQN)".
    """

    policy: Sequence[HybridArc]
    hybrid: Sequence[HybridArc] = ()
    title: str = "RL policy"


class Screen:
    """A show, laid out in panels with a title and groups of tracks.

    Args:
        task: of the arcs.
        show: the arcs.
        layout: one of `LAYOUTS`.
        camera: a camera of the MJCF.
        floor: the marks on the floor.
    """

    def __init__(self, task: Task, show: Show, layout: str, camera: str, floor: Floor | None):
        self._task, self._camera, self._floor = task, camera, floor
        policy = Group(show.title, [Track(task, arc) for arc in show.policy])
        hybrid = Group("HyRL", [Track(task, arc) for arc in show.hybrid])
        self._tracks = [*policy.tracks, *hybrid.tracks]
        self._panels = [(policy.name, [policy])]
        if show.hybrid and layout == "overlay":
            self._panels = [(f"{policy.name} and {hybrid.name}", [policy, hybrid])]
        elif show.hybrid:
            modes = {int(arc.q[0]) for arc in show.hybrid}
            where = "each mode" if len(modes) > 1 else f"q = {task.scene.mode_name(*modes)}"
            self._panels.append((f"HyRL, started in {where}", [hybrid]))

    @property
    def end(self) -> float:
        """The last time [s] of all arcs."""
        return max(track.end for track in self._tracks)

    @property
    def jumps(self) -> list[float]:
        """The times [s] of all jumps."""
        return [track.arc.t[row] for track in self._tracks for row in track.jumps]

    def check(self, size: tuple[int, int]) -> None:
        """Raises `BadInput` unless a frame of this size [pixels] has room for the panels."""
        least = len(self._panels) * SMALLEST[0], SMALLEST[1]
        if any(n % 2 or not small <= n <= LARGEST for n, small in zip(size, least, strict=True)):
            raise BadInput(
                f"a video of {size[0]} x {size[1]} pixels cannot be drawn: give even numbers from "
                f"{least[0]} x {least[1]} to {LARGEST} x {LARGEST}"
            )

    def canvas(self, size: tuple[int, int]) -> Canvas:
        """Returns a canvas for the panels of a frame [pixels]; the caller closes it."""
        layout = self._layout(size)
        return Canvas(self._task.model, layout.width, layout.scene_height)

    def open(self, size: tuple[int, int], canvas: Canvas) -> Stage:
        """Returns a stage that draws the show in frames of this size [pixels]."""
        layout, frame = self._layout(size), np.empty((size[1], size[0], 3), dtype=np.uint8)
        shape = (layout.width, layout.scene_height)
        views = []
        parts = np.split(frame, len(self._panels), axis=1)
        for part, (title, groups) in zip(parts, self._panels, strict=True):
            tracks = [track for group in groups for track in group.tracks]
            panel = Panel(self._task, tracks, canvas, *shape, self._camera, self._floor)
            views.append(_View(part, layout, title, groups, panel))
        return Stage(frame, views)

    def _layout(self, size: tuple[int, int]) -> Layout:
        return Layout(size[0] // len(self._panels), size[1])


@dataclass(frozen=True)
class Stage:
    """Draws a show, at times that never go back."""

    _frame: np.ndarray
    _views: Sequence[_View]

    def draw(self, t: float) -> np.ndarray:
        """Returns the frame (height, width, 3) at time t [s], valid until the next call."""
        for view in self._views:
            view.draw(t)
        return self._frame

    def fine(self, finer: int) -> np.ndarray:
        """Returns the last frame, `finer` times larger."""
        return np.hstack([view.fine(finer) for view in self._views])


@dataclass
class _View:
    """A panel with its captions, drawn into its part of the frame (height, width, 3)."""

    part: np.ndarray
    layout: Layout
    title: str
    groups: Sequence[Group]
    panel: Panel
    t: float = -1.0

    def __post_init__(self) -> None:
        self.part[: self.layout.bar] = self._above(self.layout)

    def draw(self, t: float) -> None:
        """Brings the part of the frame to time t [s]."""
        if t == self.t:
            return
        bar = self.layout.bar
        self.panel.draw(t, self.part[bar:-bar])
        self.part[-bar:] = self.layout.below(self.groups, t)
        self.t = t

    def fine(self, finer: int) -> np.ndarray:
        """Returns the part that was drawn last, `finer` times larger."""
        layout = Layout(finer * self.layout.width, finer * self.layout.height, finer)
        scene = self.panel.fine(finer)
        return np.vstack([self._above(layout), scene, layout.below(self.groups, self.t)])

    def _above(self, layout: Layout) -> np.ndarray:
        return layout.above(self.title, self.groups[0].tracks[0].arc)
