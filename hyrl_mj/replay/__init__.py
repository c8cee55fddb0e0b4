"""The replay: stage-1 policy and hybrid controller under the same noise, as a video or a picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from hyrl_mj import artifacts, mjcf
from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.progress import Progress
from hyrl_mj.rendering import ENCODERS, LARGEST, video
from hyrl_mj.replay.captions import Group, Layout
from hyrl_mj.replay.marks import Floor
from hyrl_mj.replay.panel import Panel, Track
from hyrl_mj.replay.timeline import frame_times
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks.base import Task

FASTEST, SLOWEST_MOTION = 240, 100  # frames/s, and times slower than real time
SMALLEST = (240, 160)  # [pixels] of a panel, for captions that can be read
LAYOUTS = ("side-by-side", "overlay")
FORMATS = (*ENCODERS, ".png")
# A poster is drawn so many times larger and then reduced, for smooth edges.
FINER = 2


@dataclass(frozen=True)
class Show:
    """What is played together.

    Attributes:
        policy: arcs of the stage-1 policy.
        hybrid: arcs of the hybrid controller.
    """

    policy: Sequence[HybridArc]
    hybrid: Sequence[HybridArc]


def render_replay(
    task: Task,
    shows: Sequence[Show],
    path: Path,
    *,
    floor: Floor | None = None,
    size: tuple[int, int] = (1280, 720),
    fps: int = 30,
    camera: str = "overhead",
    layout: str = "side-by-side",
    slow_motion: float = 1.0,
) -> None:
    """Write a video that plays shows one after the other; its poster beside it, or that alone.

    Args:
        task: what the arcs are of; its MJCF has a site "tracked", whose path is drawn.
        shows: what to play.
        path: of the video, an mp4 or a gif, with the poster as a PNG of the same name; a png for the
            poster alone, the end of the first show.
        floor: what to draw on the floor.
        size: width and height of the video [pixels], even.
        fps: frames a second.
        camera: a camera of the MJCF.
        layout: "side-by-side", or "overlay" for one panel with both controllers.
        slow_motion: how many times slower it is around jumps.

    Raises:
        BadArtifact: an arc is not of this task or its model.
        BadInput: nothing to play, or a value that cannot be used.
        NoRenderer: there is no GL library or no video encoder.
    """
    if path.suffix not in FORMATS:
        raise BadInput(f"{path} is no replay: give a name that ends in one of {', '.join(FORMATS)}")
    if not shows:
        raise BadInput("there is nothing to replay: give at least one show")
    if layout not in LAYOUTS:
        raise unknown("layout", layout, LAYOUTS)
    if not 1 <= fps <= FASTEST:
        raise BadInput(f"no video has {fps} frames a second: give 1 to {FASTEST}")
    if not 1 <= slow_motion <= SLOWEST_MOTION:
        raise BadInput(
            f"slow motion {slow_motion:g} cannot be played: give 1 (real time) to {SLOWEST_MOTION}"
        )
    mjcf.object_id(task.model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    screens = [_Screen(task, show, layout, camera, floor) for show in shows]
    for screen in screens:
        screen.check(size)
    poster = path.with_suffix(".png")
    if path.suffix in ENCODERS:
        times = [screen.times(fps, slow_motion) for screen in screens]
        done, total = 0, sum(map(len, times))
        with (
            closing(Progress("rendering", total, "frames")) as progress,
            video(path, *size, fps) as add,
        ):
            for screen, when in zip(screens, times, strict=True):
                for frame in screen.frames(size, when):
                    add(frame)
                    done += 1
                    progress.update(done)
    last = screens[0].times(fps, slow_motion)[-1:]
    (large,) = screens[0].frames(size, last, FINER)
    with artifacts.replacing(poster) as temporary:
        Image.fromarray(large).resize(size, Image.Resampling.LANCZOS).save(temporary)


class _Screen:
    """A show, laid out in panels: a title and groups of tracks for each."""

    def __init__(self, task: Task, show: Show, layout: str, camera: str, floor: Floor | None):
        self._task, self._camera, self._floor = task, camera, floor
        policy = Group(f"RL policy ({task.algorithm.upper()})", _tracks(task, show.policy))
        hybrid = Group("HyRL", _tracks(task, show.hybrid))
        both = f"{policy.name} and {hybrid.name}"
        started = {int(arc.q[0]) for arc in show.hybrid}
        where = "each mode" if len(started) > 1 else f"q = {task.mode_name(*started)}"
        self._panels: list[tuple[str, list[Group]]] = [(both, [policy, hybrid])]
        if layout == "side-by-side":
            self._panels = [(policy.name, [policy]), (f"HyRL, started in {where}", [hybrid])]

    @property
    def _all(self) -> list[Track]:
        return [t for _, groups in self._panels for group in groups for t in group.tracks]

    def check(self, size: tuple[int, int]) -> None:
        """Raise `BadInput` unless it has room in so many pixels."""
        least = len(self._panels) * SMALLEST[0], SMALLEST[1]
        most = LARGEST // FINER
        if any(n % 2 or not small <= n <= most for n, small in zip(size, least, strict=True)):
            raise BadInput(
                f"a video of {size[0]} x {size[1]} pixels cannot be drawn: give even numbers from "
                f"{least[0]} x {least[1]} to {most} x {most}"
            )

    def times(self, fps: float, slow_motion: float) -> np.ndarray:
        """The time [s] of each frame."""
        end = max(track.end for track in self._all)
        jumps = [track.arc.t[row] for track in self._all for row in track.jumps]
        return frame_times(end, fps, jumps, slow_motion)

    def frames(
        self, size: tuple[int, int], times: np.ndarray, finer: int = 1
    ) -> Iterator[np.ndarray]:
        """The frames (height, width, 3) at times [s], `finer` times the size; each valid until the next."""
        frame = np.empty((finer * size[1], finer * size[0], 3), dtype=np.uint8)
        edges = finer * np.linspace(0, size[0], len(self._panels) + 1).astype(int)
        with ExitStack() as stack:
            views = []
            for left, right, panel in zip(edges, edges[1:], self._panels, strict=False):
                layout = Layout(right - left, len(frame), finer)
                part = frame[:, left:right]
                view = _View(self._task, layout, part, *panel, self._camera, self._floor)
                views.append(stack.enter_context(closing(view)))
            for t in times:
                for ready in [view.draw(t) for view in views]:
                    ready.result()
                yield frame


class _View:
    """A panel with its captions, drawn into its part of the frame (height, width, 3).

    In a thread of its own: a GL context belongs to one, and panels are drawn at the same time.
    """

    def __init__(
        self,
        task: Task,
        layout: Layout,
        part: np.ndarray,
        title: str,
        groups: Sequence[Group],
        camera: str,
        floor: Floor | None,
    ):
        tracks = [track for group in groups for track in group.tracks]
        self._layout, self._groups = layout, groups
        self._scene, self._below = part[layout.bar : -layout.bar], part[-layout.bar :]
        part[: layout.bar] = layout.above(title, tracks[0].arc)
        self._thread = ThreadPoolExecutor(1)
        size = layout.width, layout.scene_height
        try:
            self._panel = self._thread.submit(Panel, task, tracks, *size, camera, floor).result()
        except BaseException:
            self._thread.shutdown()
            raise

    def draw(self, t: float) -> Future[None]:
        """Start to draw the panel at time t [s]."""
        return self._thread.submit(self._draw, t)

    def close(self) -> None:
        """Give the GL context back, in the thread that has it."""
        self._thread.submit(self._panel.close).result()
        self._thread.shutdown()

    def _draw(self, t: float) -> None:
        self._panel.draw(t, self._scene)
        self._below[:] = self._layout.below(self._groups, t)


def _tracks(task: Task, arcs: Sequence[HybridArc]) -> list[Track]:
    return [Track(task, arc) for arc in arcs]
