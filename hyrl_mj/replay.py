"""The replay: stage-1 policy and hybrid controller side by side, in one video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hyrl_mj import artifacts, mjcf
from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.progress import Progress
from hyrl_mj.rendering import SceneRenderer, video
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks.base import Task

# The site of the MJCF whose path is drawn.
TRACKED = "tracked"
HOLD = 1.0  # [s] that the last frame of a pair stays
FASTEST = 240  # [frames/s]
SMALLEST = (160, 120)  # [pixels] of a panel, for captions that can be read

RGB = tuple[int, int, int]
# Blue, vermilion, purple and sky blue of Okabe and Ito: told apart by colour-blind people too.
MODE_COLOURS: tuple[RGB, ...] = ((0, 114, 178), (213, 94, 0), (170, 68, 153), (86, 180, 233))
POLICY_COLOUR: RGB = (45, 50, 60)
INK, PAPER, WHITE = (35, 40, 48), (246, 247, 249), (255, 255, 255)
GOOD, BAD, OPEN = (0, 125, 85), (190, 40, 35), (110, 116, 126)
OUTCOMES: dict[str, tuple[str, RGB]] = {
    "reached": ("reached the set-point", GOOD),
    "crashed": ("crashed", BAD),
    "out_of_bounds": ("left the arena", BAD),
    "stalled": ("stalled", BAD),
    "running": ("not there yet", OPEN),
}

PATH_WIDTH, PATH_HEIGHT = 0.032, 0.006  # [m]
START_RADIUS, JUMP_RADIUS = 0.035, 0.055  # [m]
UP = np.array([0.0, 0.0, 1.0])


def render_replay(
    task: Task,
    pairs: Sequence[tuple[HybridArc, HybridArc]],
    path: Path,
    *,
    size: tuple[int, int] = (640, 480),
    fps: int = 40,
    camera: str = "overhead",
) -> None:
    """Write an mp4 that plays pairs of arcs side by side in real time, one pair after the other.

    The last frame of the first pair is written too, as a PNG of the same name.

    Args:
        task: what the arcs are of; its MJCF has a site "tracked", whose path is drawn.
        pairs: of the stage-1 policy (left) and the hybrid controller (right).
        path: of the video.
        size: width and height of one panel [pixels], even.
        fps: frames a second.
        camera: a camera of the MJCF.

    Raises:
        BadArtifact: an arc is not of this task's model.
        BadInput: no pairs, an impossible size, or an unknown camera.
        NoRenderer: there is no GL library or no video encoder.
    """
    if path.suffix != ".mp4":
        raise BadInput(f"a replay is an mp4, {path} is not: give a name that ends in .mp4")
    if not pairs:
        raise BadInput("there is nothing to replay: give at least one pair of arcs")
    if (
        any(n % 2 or n < least for n, least in zip(size, SMALLEST, strict=True))
        or not 1 <= fps <= FASTEST
    ):
        raise BadInput(
            f"no video of {size[0]} x {size[1]} pixels at {fps} frames a second: "
            f"give even sizes from {SMALLEST[0]} x {SMALLEST[1]}, and 1 to {FASTEST} frames"
        )
    layout = Layout(*size)
    shows = [
        (
            Track(task, policy, f"RL policy ({task.algorithm.upper()})", modes=False),
            Track(task, hybrid, f"HyRL, started in {_mode(task, hybrid.q[0])}", modes=True),
        )
        for policy, hybrid in pairs
    ]
    total = sum(_frames(show, fps) for show in shows)
    done = 0
    with (
        closing(Progress("rendering", total, "frames")) as progress,
        closing(SceneRenderer(task.model, size[0], layout.scene_height)) as renderer,
        video(path, 2 * size[0], size[1], fps) as add,
    ):
        for show in shows:
            for frame in _play(renderer, layout, show, fps, camera):
                add(frame)
                done += 1
                progress.update(done)
            if show is shows[0]:
                poster = frame
    with artifacts.replacing(path.with_suffix(".png")) as temporary:
        Image.fromarray(poster).save(temporary)


def _frames(show: Sequence[Track], fps: int) -> int:
    """Frames that a pair takes, the hold at its end included."""
    longest = max(track.end for track in show)
    return int(np.ceil(longest * fps - 1e-6)) + 1 + round(HOLD * fps)


def _play(
    renderer: SceneRenderer, layout: Layout, show: Sequence[Track], fps: int, camera: str
) -> Iterator[np.ndarray]:
    """The frames (height, 2 width, 3) of one pair."""
    still: dict[int, np.ndarray] = {}  # panels of arcs that are over
    for k in range(_frames(show, fps)):
        panels = []
        for side, track in enumerate(show):
            panel = still.get(side)
            if panel is None:
                t = min(k / fps, track.end)
                panel = layout.panel(track.picture(renderer, t, camera), track, t)
                if t >= track.end:
                    still[side] = panel
            panels.append(panel)
        yield np.hstack(panels)


class Track:
    """An arc, ready to be drawn.

    Args:
        task: what it is of.
        arc: the arc.
        title: of its panel.
        modes: whether its mode tells anything.

    Raises:
        BadArtifact: its states are not of the task's model.
    """

    def __init__(self, task: Task, arc: HybridArc, title: str, *, modes: bool):
        self.task, self.arc, self.title, self.modes = task, arc, title, modes
        self.end = float(arc.t[-1])
        model, data = task.model, mujoco.MjData(task.model)
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        width = mujoco.mj_stateSize(model, kind)
        if arc.state.ndim != 2 or arc.state.shape != (len(arc.t), width):
            raise BadArtifact(
                f"the states of an arc of {arc.task} have shape {arc.state.shape}, model "
                f"{mjcf.model_name(model)} needs {(len(arc.t), width)}: simulate it again"
            )
        site = mjcf.object_id(model, mujoco.mjtObj.mjOBJ_SITE, TRACKED)
        # Positions (N, nq), and (N, 3) of the tracked site [m], at each row of the arc.
        self._qpos, self._points = np.empty((len(arc.t), model.nq)), np.empty((len(arc.t), 3))
        for i, state in enumerate(arc.state):
            mujoco.mj_setState(model, data, state, kind)
            mujoco.mj_forward(model, data)
            self._qpos[i], self._points[i] = data.qpos, data.site_xpos[site]

    @cached_property
    def jumps(self) -> np.ndarray:
        """Rows right after a jump."""
        return np.flatnonzero(np.diff(self.arc.j) > 0) + 1

    def colour(self, row: int) -> RGB:
        """The colour of the path from a row on."""
        return MODE_COLOURS[self.arc.q[row] % len(MODE_COLOURS)] if self.modes else POLICY_COLOUR

    def picture(self, renderer: SceneRenderer, t: float, camera: str) -> np.ndarray:
        """The scene at time t [s], between samples interpolated: (height, width, 3)."""
        renderer.place(self._at(t, self._qpos), camera)
        last = self.arc.at(t)
        points = [*self._points[: last + 1], self._at(t, self._points)]
        for row in range(last + 1):
            # Where a path comes back in another mode the later one is drawn over the earlier.
            lift = 2e-4 * (self.arc.j[row] % 20)
            _segment(renderer.scene, points[row], points[row + 1], self.colour(row), lift)
        _disc(renderer.scene, points[0], START_RADIUS, 0.005, INK)
        for row in self.jumps[self.jumps <= last]:
            _disc(renderer.scene, points[row], JUMP_RADIUS, 0.006, INK)
            _disc(renderer.scene, points[row], 0.6 * JUMP_RADIUS, 0.007, WHITE)
        return renderer.draw()

    def _at(self, t: float, values: np.ndarray) -> np.ndarray:
        """Values at the rows (N, c), interpolated at time t: (c,)."""
        row = self.arc.at(t)
        if row + 1 == len(values):
            return values[row]
        share = (t - self.arc.t[row]) / (self.arc.t[row + 1] - self.arc.t[row])
        return (1 - share) * values[row] + share * values[row + 1]


def _segment(
    scene: mujoco.MjvScene, start: np.ndarray, end: np.ndarray, colour: RGB, lift: float
) -> None:
    """Add a piece of path: a flat bar, which is drawn several times faster than a capsule."""
    length = float(np.linalg.norm(end - start))
    if length < 1e-9:
        return
    along = (end - start) / length
    across = np.cross(UP if abs(along @ UP) < 0.99 else (1.0, 0.0, 0.0), along)
    across /= np.linalg.norm(across)
    axes = np.column_stack([along, across, np.cross(along, across)])
    # Square ends as long as the bar is wide close the gaps at bends.
    size = (length / 2 + PATH_WIDTH / 2, PATH_WIDTH / 2, PATH_HEIGHT / 2)
    _add(scene, mujoco.mjtGeom.mjGEOM_BOX, size, (start + end) / 2 + lift * UP, axes, colour)


def _disc(
    scene: mujoco.MjvScene, centre: np.ndarray, radius: float, height: float, colour: RGB
) -> None:
    """Add a flat disc; of discs in one place the highest is seen."""
    size = (radius, PATH_HEIGHT / 2 + height, 0.0)
    _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, size, centre, np.eye(3), colour)


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: tuple[float, float, float],
    pos: np.ndarray,
    axes: np.ndarray,
    colour: RGB,
) -> None:
    """Add a geom to the scene, unless a very long path has used up all there are."""
    if scene.ngeom < scene.maxgeom:
        geom = scene.geoms[scene.ngeom]
        rgba = np.array([*colour, 255], dtype=np.float32) / 255
        mujoco.mjv_initGeom(geom, kind, np.array(size), pos, axes.ravel(), rgba)
        geom.specular = 0  # the path keeps the colours of the captions
        scene.ngeom += 1


@dataclass(frozen=True)
class Layout:
    """Where a panel has its captions: a bar above the scene and one below.

    Attributes:
        width, height: of the panel [pixels].
    """

    width: int
    height: int

    @cached_property
    def text(self) -> int:
        """Height of the letters [pixels]."""
        return max(8, min(self.width // 32, self.height // 22))

    @property
    def bar(self) -> int:
        """Height of a bar [pixels]."""
        return 2 * self.text

    @property
    def scene_height(self) -> int:
        """Height that is left to the scene [pixels]."""
        return self.height - 2 * self.bar

    @cached_property
    def fonts(self) -> tuple[ImageFont.FreeTypeFont, ImageFont.FreeTypeFont]:
        """A font for titles, and a smaller one."""
        large = ImageFont.load_default(size=self.text)
        small = ImageFont.load_default(size=round(0.85 * self.text))
        assert isinstance(large, ImageFont.FreeTypeFont)
        assert isinstance(small, ImageFont.FreeTypeFont)
        return large, small

    def panel(self, scene: np.ndarray, track: Track, t: float) -> np.ndarray:
        """The scene with its captions at time t [s]: (height, width, 3)."""
        arc, row = track.arc, track.arc.at(t)
        image = Image.new("RGB", (self.width, self.height), PAPER)
        image.paste(Image.fromarray(scene), (0, self.bar))
        draw = ImageDraw.Draw(image)
        above, below = self.bar // 2, self.height - self.bar // 2
        left, right = self.text // 2, self.width - self.text // 2
        large, small = self.fonts
        draw.text((left, above), track.title, INK, large, anchor="lm")
        draw.text((right, above), _noise(arc), OPEN, small, anchor="rm")
        now = f"t = {t:.2f} s"
        if track.modes:
            now += f"    j = {arc.j[row]}"
        draw.text((left, below), now, INK, small, anchor="lm")
        left += round(draw.textlength("t = 00.00 s    j = 00   ", small))
        if track.modes:
            badge = _mode(track.task, arc.q[row])
            self._badge(draw, (left, below), badge, track.colour(row), "lm")
        if t >= track.end:
            words, colour = OUTCOMES.get(arc.outcome, (arc.outcome, OPEN))
            self._badge(draw, (right, below), words, colour, "rm")
        draw.line([(self.width - 1, 0), (self.width - 1, self.height)], (205, 208, 213))
        return np.asarray(image)

    def _badge(
        self, draw: ImageDraw.ImageDraw, at: tuple[int, int], words: str, colour: RGB, anchor: str
    ) -> None:
        """White words on a coloured plate."""
        pad = self.text // 3
        at = (at[0] + (pad if anchor[0] == "l" else -pad), at[1])
        x0, _, x1, _ = draw.textbbox(at, words, self.fonts[1], anchor=anchor)
        half = 0.75 * self.text
        draw.rectangle((x0 - pad, at[1] - half, x1 + pad, at[1] + half), colour)
        draw.text(at, words, WHITE, self.fonts[1], anchor=anchor)


def _mode(task: Task, q: int) -> str:
    """A mode for people: "q = 0 (left)"."""
    return f"q = {task.mode_name(int(q))}"


def _noise(arc: HybridArc) -> str:
    if arc.noise == "none" or arc.bound == 0:
        return "no noise"
    return f"{arc.noise} noise, eps = {arc.bound:g}"
