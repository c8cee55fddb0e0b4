"""Off-screen pictures: what is seen where, and what is said when nothing can be drawn."""

from __future__ import annotations

import os
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from command_line import python
from gl import needs_gl

from hyrl_mj import BadInput
from hyrl_mj.physics.rendering import Canvas, SceneRenderer

CAMERAS = ("overhead", "chase", "three_quarter")
POSITIONS = {"vehicle": [0.4, 0.7], "unit_circle": [2.4]}


def surface(model, data):
    """Points (n, 3) all over the surfaces of the robot's visible geoms."""
    turn, found = np.linspace(0, 2 * np.pi, 60), []
    ball = np.random.default_rng(0).normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    shapes = {
        mujoco.mjtGeom.mjGEOM_BOX: np.array(np.meshgrid(*3 * [[-1, 1]])).reshape(3, -1).T,
        mujoco.mjtGeom.mjGEOM_SPHERE: ball,
        mujoco.mjtGeom.mjGEOM_CYLINDER: np.vstack([np.c_[circle, 0 * turn + s] for s in (-1, 1)]),
    }
    for i in np.flatnonzero(model.body_weldid[model.geom_bodyid] > 0):
        kind, size = mujoco.mjtGeom(model.geom_type[i]), model.geom_size[i]
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            size = np.repeat(size[:1], 3)
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            size = size[[0, 0, 1]]
        found.append(shapes[kind] * size @ data.geom_xmat[i].reshape(3, 3).T + data.geom_xpos[i])
    return np.vstack(found)


def seen_at(model, data, camera, points, width, height):
    """Column and row (n, 2) of points (n, 3) in a picture, by the camera's own numbers."""
    i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    x, y, z = ((points - data.cam_xpos[i]) @ data.cam_xmat[i].reshape(3, 3)).T
    if model.cam_projection[i] == mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC:
        scale = min(width, height) / model.cam_fovy[i]
    else:
        scale = min(width, height) / 2 / np.tan(np.radians(model.cam_fovy[i]) / 2) / -z
    return np.stack([width / 2 + scale * x, height / 2 - scale * y], axis=-1)


@needs_gl
@pytest.mark.parametrize("size", [(640, 480), (320, 440)])
@pytest.mark.parametrize("camera", CAMERAS)
def test_the_robot_is_seen_where_the_camera_projects_it(task, camera, size):
    qpos = np.array(POSITIONS[task.name])
    renderer = SceneRenderer(task.model, *size)
    renderer.place(qpos, camera)
    picture = renderer.draw().astype(int)
    renderer.clear()
    renderer.look(qpos, camera)
    changed = np.abs(picture - renderer.draw()).max(axis=-1) > 8
    points = surface(renderer.model, renderer.data)
    expected = seen_at(renderer.model, renderer.data, camera, points, *size)
    np.testing.assert_allclose(renderer.project(points)[0], expected, atol=0.05)
    renderer.close()
    rows, columns = np.nonzero(changed)
    found = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    np.testing.assert_allclose(found, [*expected.min(axis=0), *expected.max(axis=0)], atol=3)


@needs_gl
@pytest.mark.parametrize("camera", CAMERAS)
def test_a_part_that_is_drawn_anew_is_that_of_the_whole(task, camera):
    renderer = SceneRenderer(task.model, 320, 240)
    renderer.place(np.array(POSITIONS[task.name]), camera)
    whole, parts = renderer.draw(), np.zeros((240, 320, 3), dtype=np.uint8)
    hidden = []
    for left, right in pairwise((0, 43, 101, 160, 230, 320)):
        for top, bottom in pairwise((0, 50, 77, 160, 240)):
            renderer.redraw(parts, (left, top, right, bottom))
            hidden.append((~renderer._shown).sum())
    assert max(hidden) > 0
    again = renderer.draw()
    renderer.close()
    np.testing.assert_array_equal(whole, again)
    # Now and then a sample on an edge is rounded to the other side.
    differ = np.abs(parts.astype(int) - whole).max(axis=-1) > 1
    assert differ.sum() <= 5
    assert whole.std() > 10


@needs_gl
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_what_reaches_past_the_camera_is_not_left_out(projection):
    """Long walls whose middles lie beside or behind the camera, and a ball right before it."""
    model = mujoco.MjModel.from_xml_string(
        f"""
        <mujoco>
          <visual><global fovy="60"/></visual>
          <worldbody>
            <light pos="0 0 3"/>
            <camera name="eye" projection="{projection}" fovy="{60 if projection == "perspective" else 3}"
              pos="0 0 1" xyaxes="0 -1 0 0.3 0 1"/>
            <geom type="box" size="6 0.1 0.4" pos="-3 1 0.4" rgba="0.9 0.2 0.1 1"/>
            <geom type="box" size="4 0.1 0.4" pos="0.2 -1 0.4" rgba="0.1 0.8 0.2 1"/>
            <geom type="sphere" size="0.3" pos="0.7 0.25 0.8" rgba="0.1 0.2 0.9 1"/>
          </worldbody>
        </mujoco>
        """
    )
    renderer = SceneRenderer(model, 160, 120)
    renderer.place(np.zeros(0), "eye")
    parts, whole = np.zeros((2, 120, 160, 3), dtype=np.uint8)
    for left, right in pairwise((0, 30, 64, 101, 160)):
        for top, bottom in pairwise((0, 25, 70, 120)):
            renderer.redraw(parts, (left, top, right, bottom))
    renderer._hide_outside = lambda box: None
    renderer._shown[:] = True
    for geom, kind in zip(renderer.scene.geoms, renderer._kinds, strict=False):
        geom.type = kind
    renderer.redraw(whole, (0, 0, 160, 120))
    renderer.close()
    red, green, blue = whole.reshape(-1, 3).astype(int).T
    assert (red > green + blue).any()
    assert (green > red + blue).any()
    assert (blue > red + green).any()
    assert (whole[0, -1] == 255).all()  # where there is no skybox
    assert (np.abs(parts.astype(int) - whole).max(axis=-1) > 1).sum() <= 5


@needs_gl
def test_several_robots_are_in_one_scene(vehicle):
    renderer = SceneRenderer(vehicle.model, 320, 240)
    renderer.place(np.array([0.2, 1.0]), "overhead")
    one = renderer.draw().astype(int)
    numbers = renderer.add_robot(np.array([0.2, -1.0]))
    two = renderer.draw().astype(int)
    pixels, _ = renderer.project(np.array([[0.2, -1.0, 0.0]]))
    renderer.close()
    assert len(numbers) > 3
    rows, columns = np.nonzero(np.abs(two - one).max(axis=-1) > 8)
    assert np.abs(columns - pixels[0, 0]).max() < 30
    assert np.abs(rows - pixels[0, 1]).max() < 15


@needs_gl
def test_the_shared_model_stays_as_it_is(vehicle):
    before = int(vehicle.model.vis.global_.offwidth)
    SceneRenderer(vehicle.model, 1000, 30).close()
    assert int(vehicle.model.vis.global_.offwidth) == before


@pytest.mark.parametrize("size", [(0, 100), (100, -1), (5000, 100), (100, 100_000)])
def test_sizes_that_no_picture_can_have_are_refused(vehicle, size):
    with pytest.raises(
        BadInput, match=f"{size[0]} x {size[1]} pixels cannot be drawn: give 1 x 1 to"
    ):
        SceneRenderer(vehicle.model, *size)


@needs_gl
def test_an_unknown_camera_lists_the_cameras(vehicle):
    renderer = SceneRenderer(vehicle.model, 64, 48)
    with pytest.raises(BadInput, match=r"'top'.*overhead, three_quarter, chase"):
        renderer.place(np.zeros(2), "top")
    renderer.close()


@pytest.mark.parametrize("backend", ["disable", "osmesa-is-not-spelled-so"])
@pytest.mark.slow
def test_without_gl_one_message_says_what_to_install(backend):
    code = (
        "import hyrl_mj\n"
        "from hyrl_mj.physics.rendering import Canvas, SceneRenderer\n"
        "try: SceneRenderer(hyrl_mj.get_task('vehicle').model, 64, 48)\n"
        "except hyrl_mj.NoRenderer as error: print(error)\n"
    )
    child = python(code, env={**os.environ, "MUJOCO_GL": backend})
    assert f"MUJOCO_GL='{backend}'" in child.stdout
    assert "apt-get install libegl1 libopengl0 libgl1-mesa-dri" in child.stdout
    assert child.stdout.count("\n") == 1
    assert "Traceback" not in child.stderr


@pytest.mark.slow
@needs_gl
def test_who_imports_mujoco_first_gets_pictures_too():
    code = (
        "import mujoco, hyrl_mj\n"
        "from hyrl_mj.physics.rendering import Canvas, SceneRenderer\n"
        "renderer = SceneRenderer(hyrl_mj.get_task('vehicle').model, 64, 48)\n"
        "renderer.place([0, 0], 'overhead')\n"
        "print(renderer.draw().std() > 5)\n"
    )
    hidden = ("MUJOCO_GL", "PYOPENGL_PLATFORM")
    child = python(code, env={k: v for k, v in os.environ.items() if k not in hidden})
    assert child.stdout == "True\n", child.stderr


@pytest.mark.slow
@needs_gl
def test_shadows_are_no_finer_than_the_picture_and_fall_where_they_did():
    text = """
    <mujoco>
      <visual><headlight diffuse="0 0 0" ambient="0.2 0.2 0.2"/></visual>
      <worldbody>
        <light pos="1 0 3" dir="-0.3 0 -1"/>
        <geom type="plane" size="3 3 1"/>
        <geom type="box" size="0.3 0.3 0.3" pos="0 0 0.6"/>
        <camera name="above" pos="0 0 6" fovy="45"/>
      </worldbody>
    </mujoco>"""
    model, pictures = mujoco.MjModel.from_xml_string(text), []
    for size in ((320, 240), (2048, 2048)):
        canvas = Canvas(model, *size)
        assert canvas.model.vis.quality.shadowsize == size[0]
        renderer = SceneRenderer(model, 320, 240, canvas=canvas)
        renderer.place(np.zeros(0), "above")
        pictures.append(renderer.draw().astype(int))
        canvas.close()
    assert model.vis.quality.shadowsize == 4096  # the user's model stays as it is
    shaded = [picture.mean(axis=2) < 0.6 * picture.mean() for picture in pictures]
    assert shaded[1].mean() > 0.02
    assert (shaded[0] != shaded[1]).mean() < 0.005
