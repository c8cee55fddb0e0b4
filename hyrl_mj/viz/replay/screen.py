"""What a replay shows at a time: panels side by side or one for all, each with its captions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from PIL import Image

from hyrl_mj.errors import BadInput
from hyrl_mj.physics.rendering import LARGEST, Canvas
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import Task
from hyrl_mj.viz.options import ReplayOptions
from hyrl_mj.viz.replay.captions import Layout
from hyrl_mj.viz.replay.marks import Floors
from hyrl_mj.viz.replay.panel import Panel, Track

HOLD = 1.0  # [s] that the last frame stays
AROUND = 0.25  # [s] before and after a jump that are played slowly


@dataclass(frozen=True)
class Show:
    """Arcs that are played at the same time.

    Attributes:
        policy: arcs of the stage-1 policy.
        hybrid: arcs of the hybrid controller; none to show the policy alone.
        title: of the policy, as "RL policy (DQN)".
        modes: all modes of the run, which share out the colours.
    """

    policy: Sequence[HybridArc]
    hybrid: Sequence[HybridArc] = ()
    title: str = "RL policy"
    modes: Sequence[int] = (0, 1)

    @property
    def seconds(self) -> float:
        """How long its longest arc lasts [s]."""
        return float(max(arc.t[-1] for arc in (*self.policy, *self.hybrid)))


class Screen:
    """A show, laid out in panels with captions.

    Raises:
        BadArtifact: an arc is not of this task or its model.
        BadInput: the panels do not fit into a frame of this size.
    """

    def __init__(
        self, task: Task, show: Show, options: ReplayOptions, camera: str, floor: Floors | None
    ):
        self._task, self._camera, self._floor = task, camera, floor
        policy = {show.title: [Track(task, arc) for arc in show.policy]}
        hybrid = {"HyRL": [Track(task, arc, show.modes) for arc in show.hybrid]}
        self._tracks = [*policy[show.title], *hybrid["HyRL"]]
        self._panels = {show.title: policy}
        if show.hybrid and options.layout == "overlay":
            self._panels = {f"{show.title} and HyRL": policy | hybrid}
        elif show.hybrid:
            modes = {int(arc.q[0]) for arc in show.hybrid}
            where = "each mode" if len(modes) > 1 else f"q = {task.mode_name(*modes)}"
            self._panels[f"HyRL, started in {where}"] = hybrid
        # The captions of smaller panels cannot be read.
        size, least = options.size, (240 * len(self._panels), 160)
        if any(n % 2 or not small <= n <= LARGEST for n, small in zip(size, least, strict=True)):
            raise BadInput(
                f"a video of {size[0]} x {size[1]} pixels cannot be drawn: give even numbers from "
                f"{least[0]} x {least[1]} to {LARGEST} x {LARGEST}"
            )
        self._size = size[0] // len(self._panels), size[1]
        self._end = max(track.end for track in self._tracks)

    def times(self, fps: float, slow_motion: float) -> np.ndarray:
        """Returns the time of the arcs at each frame, as `frame_times`."""
        jumps = [track.arc.t[row] for track in self._tracks for row in track.jumps]
        return frame_times(self._end, fps, jumps, slow_motion)

    def frames(self, times: Iterable[float], finer: int = 1) -> Iterator[np.ndarray]:
        """Yields the frame (height, width, 3) at each time [s], valid until the next one.

        The times never go back; the frames are drawn `finer` times larger than the replay.
        """
        width, height = (finer * side for side in self._size)
        layout = Layout(width, height, finer)
        frame = np.empty((height, len(self._panels) * width, 3), dtype=np.uint8)
        parts = np.split(frame, len(self._panels), axis=1)
        with closing(Canvas(self._task.model, width, layout.scene_height)) as canvas:
            panels = []
            for part, (title, groups) in zip(parts, self._panels.items(), strict=True):
                tracks = [track for group in groups.values() for track in group]
                part[: layout.bar] = layout.above(title, tracks[0].arc)
                panels.append(
                    Panel(
                        self._task, tracks, canvas, width, layout.scene_height, self._camera,
                        self._floor, self._tracks,
                    )
                )  # fmt: skip
            drawn = -1.0
            for t in times:
                if t != drawn:
                    for part, panel, groups in zip(
                        parts, panels, self._panels.values(), strict=True
                    ):
                        panel.draw(t, part[layout.bar : -layout.bar])
                        part[-layout.bar :] = layout.below(groups, t)
                drawn = t
                yield frame

    def poster(self) -> Image.Image:
        """Returns the last frame, drawn twice as large if that can be, and reduced for smooth edges."""
        finer = min(2, LARGEST // max(self._size))
        (frame,) = self.frames([self._end], finer)
        return Image.fromarray(frame).reduce(finer)


def frame_times(
    end: float, fps: float, jumps: Iterable[float] = (), slow_motion: float = 1.0
) -> np.ndarray:
    """Returns the time of the arc at each frame (k,) [s], from 0 to its `end` and a moment longer.

    Around the times [s] of the jumps the arc is played `slow_motion` times slower.
    """
    edges = np.array([[t - AROUND, t + AROUND] for t in jumps]).reshape(-1, 2).clip(0, end)
    at = np.unique([0.0, end, *edges.ravel()])
    middles = (at[1:] + at[:-1]) / 2
    slow = ((edges[:, :1] < middles) & (middles < edges[:, 1:])).any(axis=0)
    played = np.append(0.0, np.cumsum(np.diff(at) * np.where(slow, slow_motion, 1.0)))
    moving = int(np.ceil(played[-1] * fps - 1e-6)) + 1
    return np.interp(np.arange(moving + round(HOLD * fps)) / fps, played, at)
