"""The replay: what is in the video, and what is left when it cannot be made."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gl import needs_gl
from PIL import Image

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, HybridArc, HybridController, Noise, NoRenderer
from hyrl_mj.rendering import SceneRenderer
from hyrl_mj.replay import HOLD, MODE_COLOURS, POLICY_COLOUR, Layout, Track, render_replay
from hyrl_mj.sets import Grid, GridSet

SIZE, FPS = (160, 120), 20
TASK = hyrl_mj.get_task("vehicle")


class Steer:
    """Left of the line `until`, steer at one rate [m/s]; then straight on."""

    def __init__(self, rate: float, until: float = 1.0):
        self.rate, self.until = rate, until

    def act(self, measured: np.ndarray) -> np.ndarray:
        return np.where(measured[:, :1] < self.until, self.rate, 0.0)


def jumping_arc(z0: tuple[float, float], q0: int) -> HybridArc:
    """The pillar is passed on the left after a jump to mode 0 at y = 0.1."""
    grid = Grid.with_cells(TASK.chart, 60)
    y = grid.nodes[:, 1]
    sets = {0: GridSet(grid, -0.3 - y), 1: GridSet(grid, y - 0.1)}
    controller = HybridController(TASK, {0: Steer(1.0, 1.2), 1: Steer(0.5)}, sets)
    arc = hyrl_mj.simulate(TASK, controller, np.array(z0), q0=q0)
    assert isinstance(arc, HybridArc)
    return arc


@pytest.fixture(scope="module")
def pair() -> tuple[HybridArc, HybridArc]:
    crash = hyrl_mj.simulate(TASK, Steer(0.0), np.zeros(2), noise=Noise("alternating", 0.1))
    assert isinstance(crash, HybridArc)
    arc = jumping_arc((0.0, 0.0), q0=1)
    assert crash.outcome == "crashed"
    assert arc.outcome == "reached"
    assert arc.j[-1] == 1
    return crash, arc


def frames_of(path: Path) -> np.ndarray:
    """All frames of a video (k, height, width, 3), by ffmpeg itself."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path)]
    raw = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    return np.frombuffer(raw.stdout, np.uint8).reshape(-1, SIZE[1], 2 * SIZE[0], 3)


def count(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Pixels of nearly that colour."""
    return int((np.abs(picture.astype(int) - colour).max(axis=-1) < 24).sum())


@needs_gl
def test_the_video_plays_both_arcs_in_real_time(tmp_path, pair):
    path = tmp_path / "replay.mp4"
    render_replay(TASK, [pair, pair], path, size=SIZE, fps=FPS)
    frames = frames_of(path)
    longest = max(arc.t[-1] for arc in pair)
    assert len(frames) == 2 * (round(longest * FPS) + 1 + round(HOLD * FPS))
    left, right = frames[:, :, : SIZE[0]], frames[:, :, SIZE[0] :]
    crash, middle = round(pair[0].t[-1] * FPS), round(longest * FPS / 2)
    moved = np.abs(np.diff(right[: round(longest * FPS)].astype(int), axis=0)).max(axis=(1, 2, 3))
    assert (moved > 40).all(), "the robot moves in every frame"
    # After its crash the left panel stays as it is, but for what the codec does to it.
    assert np.abs(left[crash + 1].astype(int) - left[middle]).mean() < 1
    poster = np.asarray(Image.open(path.with_suffix(".png")))
    assert np.abs(poster.astype(int) - frames[len(frames) // 2 - 1]).mean() < 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["replay.mp4", "replay.png"]


@needs_gl
def test_the_path_has_the_colours_of_its_modes(pair):
    renderer = SceneRenderer(TASK.model, 320, 240)
    alone, joined = Track(TASK, pair[0], "", modes=False), Track(TASK, pair[1], "", modes=True)
    without_jump = Track(TASK, replace(pair[1], j=0 * pair[1].j), "", modes=True)
    start = joined.picture(renderer, 0.0, "overhead")
    policy, hybrid, unmarked = (
        track.picture(renderer, track.end, "overhead") for track in (alone, joined, without_jump)
    )
    renderer.close()
    for colour in MODE_COLOURS[:2]:
        assert count(start, colour) == 0
        assert count(policy, colour) == 0
        assert count(hybrid, colour) > 20
    assert count(policy, POLICY_COLOUR) > count(start, POLICY_COLOUR) + 20
    marked = np.argwhere(np.abs(hybrid.astype(int) - unmarked).max(axis=-1) > 24)
    assert len(marked) > 20
    assert np.ptp(marked, axis=0).max() < 16, "the jump is marked, in one place"


@needs_gl
def test_between_samples_the_robot_is_between_its_places(pair):
    track, z = Track(TASK, pair[1], "", modes=True), pair[1].z
    row = pair[1].at(0.1)
    np.testing.assert_allclose(track._at(0.125, track._qpos), (z[row] + z[row + 1]) / 2, atol=1e-9)
    # The tracked site is the vehicle itself.
    np.testing.assert_allclose(track._points[:, :2], z, atol=1e-9)


def test_captions_lie_outside_the_scene(pair):
    layout = Layout(640, 480)
    scene = np.full((layout.scene_height, 640, 3), 7, dtype=np.uint8)
    track = Track(TASK, pair[1], "HyRL", modes=True)
    early, late = (layout.panel(scene, track, t) for t in (0.0, track.end))
    inside = slice(layout.bar, -layout.bar)
    assert (late[inside, :-1] == 7).all()
    # Mode 1 at first, mode 0 after the jump; the outcome appears only at the end.
    assert count(early, MODE_COLOURS[1]) > 200
    assert count(late, MODE_COLOURS[0]) > 200
    assert count(late, (0, 125, 85)) > 200 > count(early, (0, 125, 85))


def test_states_of_another_model_are_refused(tmp_path, pair):
    wrong = replace(pair[1], state=pair[1].state[:, :-1])
    with pytest.raises(BadArtifact, match="simulate it again"):
        render_replay(TASK, [(pair[0], wrong)], tmp_path / "replay.mp4", size=SIZE)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [(161, 120), (0, 0), (160, 4000)])
def test_impossible_sizes_are_refused(tmp_path, pair, size):
    with pytest.raises(BadInput, match="pixels"):
        render_replay(TASK, [pair], tmp_path / "replay.mp4", size=size)


def test_nothing_to_replay(tmp_path):
    with pytest.raises(BadInput, match="at least one pair"):
        render_replay(TASK, [], tmp_path / "replay.mp4")


@needs_gl
@pytest.mark.parametrize("ffmpeg", ["missing", "fails"])
def test_nothing_is_left_behind_when_ffmpeg_fails(tmp_path, pair, monkeypatch, ffmpeg):
    out = tmp_path / "out"
    if ffmpeg == "fails":
        fake = tmp_path / "ffmpeg"
        fake.write_text("#!/bin/sh\necho no such encoder >&2\nexit 1\n")
        fake.chmod(0o755)
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(fake))
    else:
        import imageio_ffmpeg

        def nowhere() -> str:
            raise RuntimeError("No ffmpeg exe could be found")

        monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", nowhere)
    with pytest.raises(NoRenderer, match="reinstall imageio-ffmpeg"):
        render_replay(TASK, [pair], out / "replay.mp4", size=SIZE, fps=FPS)
    assert not out.exists() or not list(out.iterdir())


def test_without_gl_one_message_says_what_to_install():
    code = (
        "import hyrl_mj\n"
        "from hyrl_mj.rendering import SceneRenderer\n"
        "try: SceneRenderer(hyrl_mj.get_task('vehicle').model, 64, 48)\n"
        "except hyrl_mj.NoRenderer as error: print(error)\n"
    )
    child = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert "MUJOCO_GL='disable'" in child.stdout
    assert "apt-get install libegl1 libgl1-mesa-dri" in child.stdout
    assert child.stdout.count("\n") == 1
    assert "Traceback" not in child.stderr
