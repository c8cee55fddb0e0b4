"""What is seen at a time: panels side by side or one for all, drawn on one canvas."""

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


class Screen:
    """Arcs that are played together, laid out in panels: a title and groups of tracks for each.

    Args:
        task: of the arcs.
        policy: title and arcs of the stage-1 policy.
        hybrid: arcs of the hybrid controller; without them the policy is shown alone.
        layout: one of `LAYOUTS`.
        camera: a camera of the MJCF.
        floor: what lies on the floor.
    """

    def __init__(
        self,
        task: Task,
        policy: tuple[str, Sequence[HybridArc]],
        hybrid: Sequence[HybridArc],
        layout: str,
        camera: str,
        floor: Floor | None,
    ):
        self._task, self._camera, self._floor = task, camera, floor
        title, arcs = policy
        learned = Group(title, [Track(task, arc) for arc in arcs])
        if not hybrid:
            self._panels: list[tuple[str, list[Group]]] = [(learned.name, [learned])]
            return
        joined = Group("HyRL", [Track(task, arc) for arc in hybrid])
        started = {int(arc.q[0]) for arc in hybrid}
        where = "each mode" if len(started) > 1 else f"q = {task.scene.mode_name(*started)}"
        self._panels = [(f"{learned.name} and {joined.name}", [learned, joined])]
        if layout == "side-by-side":
            self._panels = [
                (learned.name, [learned]),
                (f"HyRL, started in {where}", [joined]),
            ]

    @property
    def end(self) -> float:
        """The last time [s] of all arcs."""
        return max(track.end for track in self._tracks)

    @property
    def jumps(self) -> list[float]:
        """The times [s] of all jumps."""
        return [track.arc.t[row] for track in self._tracks for row in track.jumps]

    @property
    def _tracks(self) -> list[Track]:
        return [t for _, groups in self._panels for group in groups for t in group.tracks]

    def check(self, size: tuple[int, int]) -> None:
        """Raise `BadInput` unless it has room in so many pixels."""
        least = len(self._panels) * SMALLEST[0], SMALLEST[1]
        if any(n % 2 or not small <= n <= LARGEST for n, small in zip(size, least, strict=True)):
            raise BadInput(
                f"a video of {size[0]} x {size[1]} pixels cannot be drawn: give even numbers from "
                f"{least[0]} x {least[1]} to {LARGEST} x {LARGEST}"
            )

    def canvas(self, size: tuple[int, int]) -> Canvas:
        """What it can be drawn on, in so many pixels. Close it in the end."""
        layout = self._layout(size)
        return Canvas(self._task.model, layout.width, layout.scene_height)

    def open(self, size: tuple[int, int], canvas: Canvas) -> Stage:
        """Get ready to draw it, in so many pixels."""
        layout, frame = self._layout(size), np.empty((size[1], size[0], 3), dtype=np.uint8)
        parts = np.split(frame, len(self._panels), axis=1)
        views = []
        for part, (title, groups) in zip(parts, self._panels, strict=True):
            tracks = [track for group in groups for track in group.tracks]
            at = (layout.width, layout.scene_height, self._camera, self._floor)
            views.append(_View(part, layout, title, groups, Panel(self._task, tracks, canvas, *at)))
        return Stage(frame, views)

    def _layout(self, size: tuple[int, int]) -> Layout:
        return Layout(size[0] // len(self._panels), size[1])


@dataclass(frozen=True)
class Stage:
    """A screen that is being drawn, at times that never go back."""

    _frame: np.ndarray
    _views: Sequence[_View]

    def draw(self, t: float) -> np.ndarray:
        """The frame (height, width, 3) at time t [s], valid until the next."""
        for view in self._views:
            view.draw(t)
        return self._frame

    def fine(self, finer: int) -> np.ndarray:
        """The frame that was drawn last, `finer` times larger."""
        return np.hstack([view.fine(finer) for view in self._views])


class _View:
    """A panel with its captions, drawn into its part of the frame (height, width, 3)."""

    def __init__(
        self, part: np.ndarray, layout: Layout, title: str, groups: Sequence[Group], panel: Panel
    ):
        self._part, self._layout, self._panel = part, layout, panel
        self._title, self._groups, self._t = title, groups, -1.0
        part[: layout.bar] = self._above(layout)

    def draw(self, t: float) -> None:
        """Bring it to time t [s]."""
        if t == self._t:
            return
        bar = self._layout.bar
        self._panel.draw(t, self._part[bar:-bar])
        self._part[-bar:] = self._layout.below(self._groups, t)
        self._t = t

    def fine(self, finer: int) -> np.ndarray:
        """It as it was drawn last, `finer` times larger."""
        layout = Layout(finer * self._layout.width, finer * self._layout.height, finer)
        scene = self._panel.fine(finer)
        return np.vstack([self._above(layout), scene, layout.below(self._groups, self._t)])

    def _above(self, layout: Layout) -> np.ndarray:
        return layout.above(self._title, self._groups[0].tracks[0].arc)
