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
        layout = self._layout(size)
        shape = (layout.width, layout.scene_height)
        views = []
        for title, groups in self._panels:
            tracks = [track for group in groups for track in group.tracks]
            panel = Panel(self._task, tracks, canvas, *shape, self._camera, self._floor)
            views.append(View(title, groups, panel))
        return Stage(size, layout, views)

    def _layout(self, size: tuple[int, int]) -> Layout:
        return Layout(size[0] // len(self._panels), size[1])


@dataclass(frozen=True)
class View:
    """A panel with the title and the groups of tracks for its captions."""

    title: str
    groups: Sequence[Group]
    panel: Panel

    def above(self, layout: Layout) -> np.ndarray:
        """Returns the bar above the panel."""
        return layout.above(self.title, self.groups[0].tracks[0].arc)


class Stage:
    """Draws views side by side in a frame, at times that never go back."""

    def __init__(self, size: tuple[int, int], layout: Layout, views: Sequence[View]):
        self._frame = np.empty((size[1], size[0], 3), dtype=np.uint8)
        self._layout, self._views, self._t = layout, views, -1.0
        self._parts = np.split(self._frame, len(views), axis=1)
        for part, view in zip(self._parts, views, strict=True):
            part[: layout.bar] = view.above(layout)

    def draw(self, t: float) -> np.ndarray:
        """Returns the frame (height, width, 3) at time t [s], valid until the next call."""
        bar = self._layout.bar
        if t != self._t:
            for part, view in zip(self._parts, self._views, strict=True):
                view.panel.draw(t, part[bar:-bar])
                part[-bar:] = self._layout.below(view.groups, t)
        self._t = t
        return self._frame

    def fine(self, finer: int) -> np.ndarray:
        """Returns the last frame, `finer` times larger."""
        layout = Layout(finer * self._layout.width, finer * self._layout.height, finer)
        columns = [
            (view.above(layout), view.panel.fine(finer), layout.below(view.groups, self._t))
            for view in self._views
        ]
        return np.hstack([np.vstack(column) for column in columns])
