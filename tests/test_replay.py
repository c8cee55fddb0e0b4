"""The replay: what is in its pictures, frame by frame, and what is left when it cannot be made."""

from __future__ import annotations

import subprocess
from contextlib import closing
from copy import copy
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from gl import needs_gl
from PIL import Image, ImageColor
from planted import circle_controller, circle_policy, decisions, extended, flow_sets, halves

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, HybridArc, HybridController, Noise, NoRenderer
from hyrl_mj.physics.mjcf import models_dir
from hyrl_mj.physics.rendering import Canvas
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.viz import ReplayOptions
from hyrl_mj.viz.colours import BAD, CRITICAL, GOOD, MODES, OPEN, OVERLAP, POLICY, WHITE
from hyrl_mj.viz.replay import Show, render_replay
from hyrl_mj.viz.replay.captions import Layout
from hyrl_mj.viz.replay.marks import CRITICAL_RADIUS, Floor, Floors, bar, disc, tracked_points
from hyrl_mj.viz.replay.panel import Panel, Track
from hyrl_mj.viz.replay.screen import AROUND, HOLD, frame_times
from hyrl_mj.viz.section import Section

SIZE, FPS = (480, 240), 10
TASK = hyrl_mj.get_task("vehicle")
NOISE = Noise("alternating", 0.1)


class Steer:
    """Left of the line `until`, steer at one rate [m/s]; then straight on, and at last `home`."""

    def __init__(self, rate: float, until: float = 1.0, home: float = 0.0):
        self.rate, self.until, self.home = rate, until, home

    def act(self, measured: np.ndarray) -> np.ndarray:
        x = measured[:, :1]
        return np.where(x < self.until, self.rate, np.where(x < 1.85, 0.0, self.home))


def jumping_arc(q0: int = 1, noise: Noise | None = None, home: float = -1.0) -> HybridArc:
    """The pillar is passed on the left after a jump to mode 0 at y = 0.1."""
    grid = Grid.with_cells(TASK.chart, 60)
    y = grid.nodes[:, 1]
    sets = {0: GridSet(grid, -0.3 - y), 1: GridSet(grid, y - 0.1)}
    controller = HybridController(TASK, {0: Steer(1.0, 1.2, home), 1: Steer(0.5)}, sets)
    arc = hyrl_mj.simulate(TASK, controller, np.zeros(2), noise=noise, q0=q0)
    assert isinstance(arc, HybridArc)
    return arc


@pytest.fixture(scope="module")
def crash() -> HybridArc:
    arc = hyrl_mj.simulate(TASK, Steer(0.0), np.zeros(2), noise=NOISE)
    assert isinstance(arc, HybridArc)
    assert arc.outcome == "crashed"
    return arc


@pytest.fixture(scope="module")
def jump() -> HybridArc:
    arc = jumping_arc()
    assert (arc.outcome, arc.j[-1]) == ("reached", 1)
    return arc


@pytest.fixture(scope="module")
def show(crash, jump) -> Show:
    return Show([crash], [jump])


def frames_of(path: Path) -> np.ndarray:
    """All frames of a video (k, height, width, 3), by ffmpeg itself."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path)]
    raw = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    return np.frombuffer(raw.stdout, np.uint8).reshape(-1, SIZE[1], SIZE[0], 3)


def near(picture: np.ndarray, colour: str, within: int = 24) -> np.ndarray:
    """Which pixels have nearly that colour."""
    return np.abs(picture.astype(int) - ImageColor.getrgb(colour)).max(axis=-1) < within


def coarse(picture: np.ndarray) -> np.ndarray:
    """Means of blocks of 16 x 16 pixels of the scene: a poster's edges and letters are smoother."""
    scene = picture[16:-16]
    rows, columns = scene.shape[0] // 16, scene.shape[1] // 16
    return scene.reshape(rows, 16, columns, 16, 3).mean(axis=(1, 3))


def drawn(tracks, t, size=(320, 320), camera="overhead", floor=None, before=()):
    """A panel's picture at time t [s], drawn at earlier times before; and where points are in it."""
    picture = np.zeros((*size[::-1], 3), np.uint8)
    with closing(Canvas(TASK.model, *size)) as canvas:
        panel = Panel(TASK, tracks, canvas, *size, camera, floor)
        for moment in (*before, t):
            panel.draw(moment, picture)
    renderer = panel._renderer
    return picture, lambda points: renderer.project(np.atleast_2d(points))[0].round().astype(int)


# ---- the video


@needs_gl
@pytest.mark.slow
def test_the_video_plays_both_arcs_in_real_time(tmp_path, show):
    path = tmp_path / "replay.mp4"
    render_replay(TASK, [show, show], path, ReplayOptions(size=SIZE, fps=FPS))
    frames = frames_of(path)
    (policy,), (hybrid,) = show.policy, show.hybrid
    longest = round(max(policy.t[-1], hybrid.t[-1]) * FPS)
    assert len(frames) == 2 * (longest + 1 + round(HOLD * FPS))
    assert (frames.reshape(len(frames), -1).std(axis=1) > 10).all(), "no frame is blank"
    left, right = frames[:, :, : SIZE[0] // 2], frames[:, :, SIZE[0] // 2 :]
    crash = round(policy.t[-1] * FPS)
    moved = np.abs(np.diff(right[:longest].astype(int), axis=0)).max(axis=(1, 2, 3))
    assert (moved > 40).all(), "the robot moves in every frame"
    # After its crash the left panel stays as it is, but for what the codec does to it.
    assert np.abs(left[crash + 1].astype(int) - left[longest // 2]).mean() < 1
    scenes = slice(30, -30)
    for k in range(crash + 1, longest):
        assert np.abs(left[k, scenes].astype(int) - right[k, scenes]).max() > 60
    poster = coarse(np.asarray(Image.open(path.with_suffix(".png"))))
    assert np.abs(poster - coarse(frames[len(frames) // 2 - 1])).max() < 12
    assert sorted(p.name for p in tmp_path.iterdir()) == ["replay.mp4", "replay.png"]


@pytest.mark.slow
@needs_gl
def test_around_a_jump_it_is_slower(tmp_path, show):
    path = tmp_path / "replay.mp4"
    render_replay(TASK, [show], path, ReplayOptions(size=SIZE, fps=FPS, slow_motion=3))
    (arc,) = show.hybrid
    at = arc.t[np.flatnonzero(np.diff(arc.j))[0]]
    slow = min(at, AROUND) + AROUND
    assert len(frames_of(path)) == int(np.ceil((arc.t[-1] + 2 * slow) * FPS)) + 1 + HOLD * FPS


@needs_gl
@pytest.mark.parametrize(("seconds", "fps"), [(0.0, 30), (8.0, 30), (40.0, 15), (1_000.0, 10)])
def test_long_runs_have_fewer_frames_a_second(seconds, fps):
    assert ReplayOptions(size=SIZE).lasting(seconds) == ReplayOptions(size=SIZE, fps=fps)


@pytest.mark.slow
def test_a_gif_has_as_many_frames_and_a_picture_is_the_last(tmp_path, show):
    render_replay(TASK, [show], tmp_path / "replay.gif", ReplayOptions(size=SIZE, fps=FPS))
    with Image.open(tmp_path / "replay.gif") as film:
        assert (film.n_frames, film.size) == (round(3.0 * FPS) + 1 + round(HOLD * FPS), SIZE)
        film.seek(film.n_frames - 1)
        last = coarse(np.asarray(film.convert("RGB")))
    render_replay(TASK, [show], tmp_path / "alone.png", ReplayOptions(size=SIZE, fps=FPS))
    alone = coarse(np.asarray(Image.open(tmp_path / "alone.png")))
    assert np.abs(alone - last).max() < 12
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["alone.png", "replay.gif", "replay.png"]


@needs_gl
def test_an_overlay_has_both_paths_in_one_scene(tmp_path, show):
    render_replay(
        TASK, [show], tmp_path / "one.png", ReplayOptions(size=(640, 480), layout="overlay")
    )
    picture = np.asarray(Image.open(tmp_path / "one.png"))
    for colour in (POLICY, *MODES[:2], GOOD, BAD):
        assert near(picture, colour).sum() > 8
    # One arena, in the middle: the pillar's centre is seen once.
    pillar = near(picture[262], "#a8afbc", within=16)
    assert pillar.sum() > 150
    assert np.ptp(np.flatnonzero(pillar)) < 210


# ---- the scene


@pytest.mark.slow
@needs_gl
def test_the_path_has_the_colours_of_its_modes(crash, jump):
    picture, pixel = drawn([Track(TASK, jump)], 3.0)
    track = Track(TASK, jump)
    (row,) = track.jumps
    middles = (track.points[1:] + track.points[:-1]) / 2
    for points, colour in ((middles[2 : row - 2], 1), (middles[row + 3 : row + 20], 0)):
        column, line = pixel(points).T
        assert near(picture[line, column], MODES[colour]).all()
    column, line = pixel(track.points[row])[0]
    assert near(picture[line, column], WHITE), "the jump is marked"
    start, _ = drawn([track], 0.0)
    policy, _ = drawn([Track(TASK, crash)], 3.0)
    for colour in MODES[:2]:
        assert not near(start, colour).any()
        assert not near(policy, colour).any()
    assert near(policy, POLICY).sum() > near(start, POLICY).sum() + 20
    column, line = pixel(Track(TASK, crash).points[-1])[0]
    assert near(policy[line - 3 : line + 4, column - 3 : column + 4], BAD).sum() > 5, "its end, too"


@pytest.mark.slow
@needs_gl
@pytest.mark.parametrize("camera", ["overhead", "chase", "three_quarter"])
def test_frames_do_not_depend_on_those_before(crash, jump, camera):
    tracks = [Track(TASK, arc) for arc in (jump, crash)]
    at_once, _ = drawn(tracks, 1.53, camera=camera)
    by_and_by, _ = drawn(tracks, 1.53, camera=camera, before=np.arange(0.0, 1.5, 0.07))
    # Now and then a sample on an edge is rounded to the other side.
    differ = np.abs(at_once.astype(int) - by_and_by).max(axis=-1) > 2
    assert differ.sum() <= 20


@pytest.mark.slow
@needs_gl
def test_a_path_beyond_what_the_camera_shows_is_in_the_picture(jump):
    far = Track(TASK, jump)
    far.points = 4 * far.points
    _, usual = drawn([Track(TASK, jump)], 0.0)
    _, pixel = drawn([far], 0.0)
    assert usual(far.points).max() > 320
    assert 0 <= pixel(far.points).min() <= pixel(far.points).max() <= 320


@pytest.mark.slow
@needs_gl
def test_nothing_is_left_where_a_capsule_was(jump):
    """It is longer than its numbers tell."""
    spec = mujoco.MjSpec.from_file(str(models_dir() / "vehicle.xml"))
    spec.body("vehicle").add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[0.05, 0.4, 0],
        rgba=[0.8, 0.1, 0.1, 1],
        quat=[1, 0, 1, 0],
        pos=[0, 0, 0.3],
        mass=0,
    )
    task = copy(TASK)
    task.model = spec.compile()
    track = Track(task, jump)
    pictures = []
    for before in ((), np.arange(0.0, 1.5, 0.3)):
        picture = np.zeros((640, 640, 3), np.uint8)
        with closing(Canvas(task.model, 640, 640)) as canvas:
            panel = Panel(task, [track], canvas, 640, 640, "overhead")
            for moment in (*before, 1.53):
                panel.draw(moment, picture)
        pictures.append(picture.astype(int))
    assert near(pictures[0], "#cc1a1a", 90).sum() > 500
    assert (np.abs(pictures[0] - pictures[1]).max(axis=-1) > 2).sum() <= 20


@pytest.mark.slow
@needs_gl
def test_the_measured_robot_is_a_ghost_within_the_bound():
    arc = jumping_arc(q0=0, noise=NOISE)
    track, quiet = Track(TASK, arc), Track(TASK, replace(arc, bound=0.0))
    t = 0.52
    noisy, pixel = drawn([track], t, size=(640, 640))
    plain, _ = drawn([quiet], t, size=(640, 640))
    rows, columns = np.nonzero(np.abs(noisy.astype(int) - plain).max(axis=-1) > 12)
    here = track.point(t)
    assert arc.measured[arc.at(t), 1] > arc.z[arc.at(t), 1]
    reach = pixel(here + np.array([[-0.28, 0.2, 0], [0.05, -0.15, 0]]))
    assert reach[0, 0] <= columns.min() <= columns.max() <= reach[1, 0]
    assert reach[0, 1] <= rows.min() <= rows.max() <= reach[1, 1]
    (line,) = track.bounds(t)
    np.testing.assert_allclose(line[[0, -1], 1], here[1] + np.array([-0.1, 0.1]), atol=1e-9)
    for end in line[[0, -1]]:
        column, row = pixel(0.9 * end + 0.1 * here)[0]
        assert np.abs(noisy[row, column].astype(int) - plain[row, column]).max() > 12
    np.testing.assert_array_equal(drawn([track], 3.0)[0], drawn([quiet], 3.0)[0])


def test_the_bound_of_an_angle_is_an_arc(circle):
    arc = hyrl_mj.simulate(circle, circle_policy(circle), np.array([2.0]), noise=NOISE, horizon=1.0)
    (line,) = Track(circle, arc).bounds(0.0)
    np.testing.assert_allclose(np.linalg.norm(line[:, :2], axis=1), 1.0, atol=1e-9)
    angle = np.arctan2(line[:, 1], line[:, 0])
    np.testing.assert_allclose(angle[[0, 2, 4]], [1.9, 2.0, 2.1], atol=1e-9)


def test_a_mark_is_no_geom_of_the_model_that_was_drawn_in_its_place():
    scene = mujoco.MjvScene(TASK.model, 3)
    scene.geoms[0].objtype, scene.geoms[0].objid = mujoco.mjtObj.mjOBJ_GEOM, 99
    disc(scene, np.zeros(3), 0.1, 0.0, "#010203")
    assert scene.ngeom == 1
    assert scene.geoms[0].objtype == mujoco.mjtObj.mjOBJ_UNKNOWN


@pytest.mark.slow
@needs_gl
def test_critical_set_and_overlap_lie_on_the_floor(jump):
    grid = Grid.with_cells(TASK.chart, 120)
    sets = [GridSet(grid, side * grid.nodes[:, 1] - 0.2) for side in (-1, 1)]
    floor = Floor.from_sets(Section(TASK), decisions(TASK), halves(TASK, 120), extended(sets))
    floors = Floors(TASK.chart, None, (floor,))
    picture, pixel = drawn([Track(TASK, jump)], 0.0, size=(640, 640), floor=floors)
    plain, _ = drawn([Track(TASK, jump)], 0.0, size=(640, 640))
    for point, colour in (
        ([0.2, -0.15, 0], OVERLAP),
        ([0.62, 0.15, 0], OVERLAP),
        ([0.4, 0.0, 0], CRITICAL),
    ):
        column, row = pixel(point)[0]
        assert near(picture[row, column], colour, within=12)
    # Beside the pillar and behind it the ways have joined: nothing to see.
    for point in ([0.2, 0.25, 0], [2.5, 0.0, 0]):
        column, row = pixel(point)[0]
        np.testing.assert_array_equal(picture[row, column], plain[row, column])


def test_the_overlap_of_the_circle_is_around_its_critical_point(circle):
    sets = extended(flow_sets(circle_controller(circle, overlap=0.4), 600))
    floor = Floor.from_sets(Section(circle), decisions(circle), halves(circle, 600), sets)
    angles = np.arctan2(floor.strips[..., 1], -floor.strips[..., 0])
    assert np.abs(angles).max() == pytest.approx(0.4, abs=0.011)
    lengths = np.linalg.norm(floor.strips[:, 0] - floor.strips[:, 1], axis=1)
    assert lengths.sum() == pytest.approx(0.8, abs=0.02)
    np.testing.assert_allclose(floor.critical[:, :2], [[-1, 0]], atol=1e-9)


def test_of_discs_that_lie_on_each_other_one_is_drawn():
    angles = np.linspace(0, 2 * np.pi, 2_000)
    points = np.stack([0.5 * np.cos(angles), 0.5 * np.sin(angles), 0 * angles], axis=-1)
    scene = mujoco.MjvScene(TASK.model, maxgeom=3_000)
    Floor(points, np.empty((0, 2, 3)), np.empty(0)).draw(scene, 1.0)
    drawn = np.array([geom.pos for geom in scene.geoms[: scene.ngeom]])
    assert len(drawn) < 300
    off = np.linalg.norm(points[:, None, :2] - drawn[None, :, :2], axis=2).min(axis=1)
    assert off.max() < 2 * CRITICAL_RADIUS, "there is no gap"


def test_the_set_of_one_mode_overlaps_with_nothing():
    grid = Grid.with_cells(TASK.chart, 120)
    sets = extended([GridSet(grid, np.full(len(grid.nodes), -1.0))])
    floor = Floor.from_sets(Section(TASK), decisions(TASK), halves(TASK, 120), sets)
    assert len(floor.strips) == 0
    assert len(floor.critical) > 0


def test_between_samples_the_robot_is_between_its_places(jump):
    track, z = Track(TASK, jump), jump.z
    row = jump.at(0.1)
    np.testing.assert_allclose(track.qpos(0.125), (z[row] + z[row + 1]) / 2, atol=1e-9)
    # The tracked site is the vehicle itself.
    np.testing.assert_allclose(track.points[:, :2], z, atol=1e-9)
    np.testing.assert_allclose(tracked_points(TASK, z), track.points, atol=1e-6)


@pytest.mark.parametrize("end", [(1, 0, 0), (-0.3, 0.4, 0), (0.2, 0.1, -0.5), (0, 0, 0.7)])
def test_a_bar_lies_between_its_ends_with_its_flat_side_up(end):
    scene = mujoco.MjvScene(TASK.model, maxgeom=5)
    start, end = np.array([0.3, -0.2, 0.1]), np.array([0.3, -0.2, 0.1]) + end
    bar(scene, start, end, "#010203", width=0.05)
    geom = scene.geoms[0]
    axes = np.array(geom.mat).reshape(3, 3)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(axes[:, 0] * geom.size[0] * 2, end - start, atol=1e-6)
    np.testing.assert_allclose(geom.pos, (start + end) / 2, atol=1e-6)
    assert axes[2, 1] == 0
    assert axes[2, 2] >= 0


# ---- time and captions


def test_frames_show_equal_steps_of_time_to_the_end_and_hold_it():
    times = frame_times(2.0, 10)
    assert len(times) == 21 + 10
    np.testing.assert_allclose(times[:21], np.arange(21) / 10, atol=1e-12)
    assert set(times[20:]) == {2.0}


def test_time_goes_slowly_around_jumps_and_only_there():
    times = frame_times(3.0, 20, jumps=[1.0, 1.2, 2.9], slow_motion=4)
    steps = np.diff(times[: -round(HOLD * 20)])
    assert len(times) == np.ceil((3.0 + 3 * (0.7 + 0.35)) * 20) + 1 + HOLD * 20
    for step, t in zip(steps, times, strict=False):
        inside = (t >= 0.75 and t + step <= 1.45) or t >= 2.65
        outside = t + step <= 0.75 or (t >= 1.45 and t + step <= 2.65)
        if inside and t + step < 3.0:
            assert step == pytest.approx(0.05 / 4)
        if outside:
            assert step == pytest.approx(0.05)
    np.testing.assert_array_equal(frame_times(3.0, 20, [1.0]), frame_times(3.0, 20))


def test_captions_tell_mode_and_outcome(jump):
    layout = Layout(640, 480)
    group = {"HyRL": [Track(TASK, jump)]}
    early, late = (layout.below(group, t) for t in (0.0, 3.0))
    # Mode 1 at first, mode 0 after the jump; the outcome appears only at the end.
    for picture, mode in ((early, 1), (late, 0)):
        assert near(picture, MODES[mode]).sum() > 200
        assert near(picture, MODES[1 - mode]).sum() == 0
    assert near(late, GOOD).sum() > 200 > near(early, GOOD).sum()
    assert early.shape == late.shape == (layout.bar, 640, 3)


def test_who_crosses_the_line_elsewhere_has_not_arrived():
    arc = jumping_arc(home=0.0)
    assert arc.outcome == "reached"
    caption = Layout(640, 480).below({"HyRL": [Track(TASK, arc)]}, 3.0)
    assert near(caption, GOOD).sum() == 0
    assert near(caption, OPEN).sum() > 200


def test_captions_of_several_arcs_count_outcomes(crash, jump):
    layout = Layout(640, 480)
    group = {"both": [Track(TASK, arc) for arc in (crash, jump)]}
    colours = [
        [bool(near(layout.below(group, t), c).sum() > 200) for c in (BAD, GOOD)]
        for t in (0.0, 1.5, 3.0)
    ]
    assert colours == [[False, False], [True, False], [True, True]]


# ---- what cannot be played


def test_arcs_of_other_tasks_and_models_are_refused(tmp_path, show, circle):
    (policy,), (hybrid,) = show.policy, show.hybrid
    wrong = replace(hybrid, state=hybrid.state[:, :-1])
    with pytest.raises(BadArtifact, match="simulate it again"):
        render_replay(
            TASK, [Show([policy], [wrong])], tmp_path / "replay.mp4", ReplayOptions(size=SIZE)
        )
    with pytest.raises(BadArtifact, match="an arc of vehicle cannot be replayed"):
        render_replay(circle, [show], tmp_path / "replay.mp4", ReplayOptions(size=SIZE))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.mp4", {"size": (481, 160)}, "481 x 160 pixels cannot be drawn: give even numbers"),
        ("a.mp4", {"size": (0, 0)}, "0 x 0 pixels"),
        ("a.mp4", {"size": (100_000, 100_000)}, "to 4096 x 4096"),
        ("a.mp4", {"fps": 0}, "fps 0 cannot be used: give an integer from 1 to 240"),
        (
            "a.mp4",
            {"slow_motion": 0.5},
            "slow_motion 0.5 cannot be used: give a number from 1 to 100",
        ),
        ("a.mp4", {"slow_motion": float("nan")}, "slow_motion nan"),
        ("a.mp4", {"layout": "tiled"}, "unknown layout 'tiled'.*side-by-side, overlay"),
        ("a.mp4", {"camera": "top"}, "'top'.*overhead, three_quarter, chase"),
        ("a.avi", {}, "a.avi is no replay: give a name that ends in one of .mp4, .gif, .png"),
    ],
)
def test_impossible_wishes_are_refused(tmp_path, show, name, options, message):
    with pytest.raises(BadInput, match=message):
        render_replay(TASK, [show], tmp_path / name, ReplayOptions(**{"size": SIZE, **options}))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@needs_gl
def test_without_a_video_there_is_no_poster(tmp_path, show, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "ffmpeg"))
    with pytest.raises(NoRenderer, match="reinstall the encoder"):
        render_replay(TASK, [show], tmp_path / "replay.mp4", ReplayOptions(size=SIZE, fps=FPS))
    assert not list(tmp_path.iterdir())


def test_nothing_to_replay(tmp_path, crash):
    for shows in ([], [Show([], [crash])]):
        with pytest.raises(BadInput, match="give shows with arcs of the policy"):
            render_replay(TASK, shows, tmp_path / "replay.mp4")
