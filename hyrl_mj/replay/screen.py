"""What is seen at a time: panels side by side or one for all, each drawn in a thread of its own."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.rendering import LARGEST
from hyrl_mj.replay.captions import Group, Layout
from hyrl_mj.replay.marks import Floor
from hyrl_mj.replay.panel import Panel, Track
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks.base import Task

LAYOUTS = ("side-by-side", "overlay")
SMALLEST = (240, 160)  # [pixels] of a panel, for captions that can be read


class Screen:
    """Arcs that are played together, laid out in panels: a title and groups of tracks for each.

    Args:
        task: what the arcs are of.
        policy, hybrid: arcs of the stage-1 policy, and of the hybrid controller.
        layout: one of `LAYOUTS`.
        camera: a camera of the MJCF.
        floor: what lies on the floor.
    """

    def __init__(
        self,
        task: Task,
        policy: Sequence[HybridArc],
        hybrid: Sequence[HybridArc],
        layout: str,
        camera: str,
        floor: Floor | None,
    ):
        self._task, self._camera, self._floor = task, camera, floor
        learned = Group(f"RL policy ({task.algorithm.upper()})", [Track(task, a) for a in policy])
        joined = Group("HyRL", [Track(task, arc) for arc in hybrid])
        started = {int(arc.q[0]) for arc in hybrid}
        where = "each mode" if len(started) > 1 else f"q = {task.mode_name(*started)}"
        self._panels: list[tuple[str, list[Group]]] = [
            (f"{learned.name} and {joined.name}", [learned, joined])
        ]
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

    def open(self, size: tuple[int, int]) -> Stage:
        """Get ready to draw it, in so many pixels."""
        return Stage(self._task, self._panels, self._camera, self._floor, size)


class Stage:
    """A screen that is being drawn, at times that never go back. Close it in the end.

    Args:
        task, panels, camera, floor: as in `Screen`.
        size: width and height [pixels].
    """

    def __init__(
        self,
        task: Task,
        panels: Sequence[tuple[str, Sequence[Group]]],
        camera: str,
        floor: Floor | None,
        size: tuple[int, int],
    ):
        self._frame = np.empty((size[1], size[0], 3), dtype=np.uint8)
        parts = np.array_split(self._frame, len(panels), axis=1)
        self._views: list[_View] = []
        with ExitStack() as stack:
            for part, (title, groups) in zip(parts, panels, strict=True):
                view = _View(task, part, title, groups, camera, floor)
                self._views.append(stack.enter_context(closing(view)))
            self._open = stack.pop_all()

    def draw(self, t: float) -> np.ndarray:
        """The frame (height, width, 3) at time t [s], valid until the next."""
        for ready in [view.draw(t) for view in self._views]:
            ready.result()
        return self._frame

    def fine(self, finer: int) -> np.ndarray:
        """The frame that was drawn last, `finer` times larger."""
        return np.hstack([ready.result() for ready in [v.fine(finer) for v in self._views]])

    def close(self) -> None:
        """Give the GL contexts back."""
        self._open.close()


class _View:
    """A panel with its captions, drawn into its part of the frame (height, width, 3).

    In a thread of its own: a GL context belongs to one, and panels are drawn at the same time.
    """

    def __init__(
        self,
        task: Task,
        part: np.ndarray,
        title: str,
        groups: Sequence[Group],
        camera: str,
        floor: Floor | None,
    ):
        tracks = [track for group in groups for track in group.tracks]
        self._layout = layout = Layout(part.shape[1], part.shape[0])
        self._title, self._groups, self._part, self._t = title, groups, part, 0.0
        part[: layout.bar] = layout.above(title, tracks[0].arc)
        self._thread = ThreadPoolExecutor(1)
        size = layout.width, layout.scene_height
        self._panel = self._thread.submit(Panel, task, tracks, *size, camera, floor)

    def draw(self, t: float) -> Future[None]:
        """Start to draw the panel at time t [s]."""
        return self._thread.submit(self._draw, t)

    def fine(self, finer: int) -> Future[np.ndarray]:
        """Start to draw it again, `finer` times larger."""
        return self._thread.submit(self._fine, finer)

    def close(self) -> None:
        """Give the GL context back, in the thread that has it."""
        with self._thread:
            if self._panel.exception() is None:
                self._thread.submit(self._panel.result().close).result()

    def _draw(self, t: float) -> None:
        bar = self._layout.bar
        self._panel.result().draw(t, self._part[bar:-bar])
        self._part[-bar:] = self._layout.below(self._groups, t)
        self._t = t

    def _fine(self, finer: int) -> np.ndarray:
        layout = Layout(finer * self._layout.width, finer * self._layout.height, finer)
        above = layout.above(self._title, self._groups[0].tracks[0].arc)
        scene = self._panel.result().fine(finer)
        return np.vstack([above, scene, layout.below(self._groups, self._t)])
