"""Off-screen pictures of a model, with one clear message if rendering fails."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress
from copy import copy
from numbers import Integral
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput, NoRenderer, brief
from hyrl_mj.physics import mjcf
from hyrl_mj.system import forked
from hyrl_mj.system.gl import GL_PROBLEM

GL_CURE = (
    "on Debian or Ubuntu: apt-get install libegl1 libopengl0 libgl1-mesa-dri, and set MUJOCO_GL=egl"
)

# Largest width and height of a picture [pixels].
LARGEST = 4096
GEOMS = 2_000  # default capacity of a scene
# A geom that is a label without a text is not drawn.
HIDDEN = mujoco.mjtGeom.mjGEOM_LABEL
FRUSTUM = ("frustum_center", "frustum_width", "frustum_bottom", "frustum_top")

# The processes that have opened GL contexts: this one, or one that it was forked from.
_GL_PROCESSES: set[int] = set()

# Left, top, right and bottom of a part of a picture [pixels], the last two excluded.
Box = tuple[int, int, int, int]


class Canvas:
    """An off-screen GL context for pictures of one model. Only the thread that created it can use it.

    Args:
        model: the compiled model.
        width, height: size of the largest picture [pixels].

    Raises:
        BadInput: a size that no picture can have.
        NoRenderer: there is no GL library; the message says which to install. Or this process was forked from
            one that has drawn pictures.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        sizes = width, height
        if not all(isinstance(n, Integral) and 0 < n <= LARGEST for n in sizes):
            raise BadInput(
                f"a picture of {width} x {height} pixels cannot be drawn: give 1 x 1 to "
                f"{LARGEST} x {LARGEST}"
            )
        # Compiled models are shared, and the size of the buffer is one of their settings.
        self.model = copy(model)
        shape = self.model.vis.global_
        shape.offwidth, shape.offheight = width, height
        # Shadows that are finer than the picture are not seen, and take most of the time without a GPU.
        quality = self.model.vis.quality
        quality.shadowsize = min(quality.shadowsize, max(width, height))
        self._gl: Any = None
        self._thread = threading.get_ident()
        if _GL_PROCESSES - {os.getpid()}:
            raise _in_fork()
        _GL_PROCESSES.add(os.getpid())
        try:
            self._gl = _gl_context(width, height)
            forked.own(self._gl)
            self._gl.make_current()
            self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        # Each GL backend fails in its own way: ImportError, AttributeError, RuntimeError, ...
        except Exception as error:
            if self._gl is not None:
                self._gl.free()
            raise _no_gl(error) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    @property
    def device(self) -> str:
        """The driver's name of the GL device."""
        from OpenGL import GL  # chooses its platform when it is imported

        self._enter()
        return str(GL.glGetString(GL.GL_RENDERER).decode())

    def draw(self, scene: mujoco.MjvScene, width: int, height: int) -> np.ndarray:
        """Returns the picture of the scene's camera: (height, width, 3) uint8.

        Raises:
            BadInput: another thread than the one that created the canvas draws.
            NoRenderer: drawing fails, or a forked process draws.
        """
        self._enter()
        part = mujoco.MjrRect(0, 0, width, height)
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        try:
            mujoco.mjr_render(part, scene, self._context)
            mujoco.mjr_readPixels(pixels, None, part, self._context)
        except mujoco.FatalError as error:
            raise _no_gl(error) from error
        return pixels[::-1]  # GL counts rows from below

    def close(self) -> None:
        """Frees the GL context; in a forked process does nothing."""
        if not forked.is_left(self._gl):
            self._enter()
            self._context.free()
            self._gl.free()

    def _enter(self) -> None:
        """Makes the GL context current."""
        if forked.is_left(self._gl):
            raise _in_fork()
        if threading.get_ident() != self._thread:
            raise BadInput(
                "pictures can only be drawn by the thread that drew the first one: draw all of them there, "
                "or make an environment in each thread"
            )
        self._gl.make_current()


class SceneRenderer:
    """Draws states of one model from its named cameras.

    A camera's field of view is that of the picture's shorter side, so that a picture of any shape shows all
    that a square one shows.

    Args:
        model: the compiled model.
        width, height: size of the picture [pixels].
        geoms: number of geoms that the scene has room for.
        canvas: canvas of this model, at least as large; by default a new one, which takes 0.1 s.
        mocap: where the mocap bodies are, see `mjcf.mocap_poses`; by default they stay.

    Attributes:
        widening: by how much more the camera sees than that.

    Raises:
        BadInput, NoRenderer: as `Canvas`.
    """

    widening = 1.0

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int,
        height: int,
        geoms: int = GEOMS,
        canvas: Canvas | None = None,
        mocap: mjcf.Mocap | None = None,
    ):
        self._mocap = mocap
        self._own, self.canvas = canvas is None, canvas or Canvas(model, width, height)
        self.model, self.width, self.height = model, width, height
        self.data = mujoco.MjData(self.model)
        self.scene = mujoco.MjvScene(self.model, maxgeom=geoms)
        self._options, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._sky: mujoco.MjvGeom | None = None
        # The geoms that stay: their types, bounding spheres, and whether they are shown.
        self._kinds: list[int] = []
        self._balls, self._shown = np.empty((0, 4)), np.empty(0, dtype=bool)

    def place(self, qpos: np.ndarray, camera: str) -> None:
        """Puts the robot into a position (nq,), seen from a camera."""
        self.clear()
        self.look(qpos, camera)
        self.add_robot(qpos)

    def clear(self) -> None:
        """Removes all geoms from the scene but static ones."""
        model, data, static = self.model, self.data, mujoco.mjtCatBit.mjCAT_STATIC.value
        mujoco.mj_forward(model, data)
        mujoco.mjv_updateScene(model, data, self._options, None, self._camera, static, self.scene)
        self._sky = (
            None if mujoco.mjtTexture.mjTEXTURE_SKYBOX in model.tex_type else self._add_sky()
        )
        self._kinds, self._balls, self._shown = [], self._balls[:0], self._shown[:0]
        self.keep()

    def _add_sky(self) -> mujoco.MjvGeom:
        """Adds a white sphere about the camera: without a skybox dark marks are drawn on black."""
        sky = self.scene.geoms[self.scene.ngeom]
        size = np.full(3, 0.9 * self.model.vis.map.zfar * self.model.stat.extent)
        white = np.ones(4, dtype=np.float32)
        mujoco.mjv_initGeom(
            sky, mujoco.mjtGeom.mjGEOM_SPHERE, size, np.zeros(3), np.eye(3).ravel(), white
        )
        # MuJoCo leaves the number of the model's geom that was drawn in this place before.
        sky.objtype, sky.objid = mujoco.mjtObj.mjOBJ_UNKNOWN, -1
        sky.emission, sky.specular, sky.category = 1, 0, mujoco.mjtCatBit.mjCAT_DECOR
        self.scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = False  # it is seen from inside
        self.scene.ngeom += 1
        return sky

    def keep(self) -> None:
        """Makes the geoms that are in the scene now permanent."""
        more = self.scene.geoms[len(self._kinds) : self.scene.ngeom]
        if more:
            self._kinds += [geom.type for geom in more]
            balls = [[*geom.pos, self.reach(geom)] for geom in more]
            self._balls = np.vstack([self._balls, balls])
            self._shown = np.append(self._shown, np.ones(len(more), dtype=bool))

    def drop(self) -> None:
        """Removes the geoms that were added after the last `keep`."""
        self.scene.ngeom = len(self._kinds)

    def reach(self, geom: mujoco.MjvGeom) -> float:
        """Returns the radius [m] of a geom's bounding sphere; infinite for a plane."""
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            return np.inf
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
            return float(self.model.geom_rbound[geom.objid])
        return float(np.linalg.norm(geom.size))

    def look(self, qpos: np.ndarray, camera: str) -> None:
        """Selects a camera, which may follow the robot in its position (nq,)."""
        self._camera = mjcf.camera_of(self.model, camera)
        self._move(qpos)
        mujoco.mjv_updateCamera(self.model, self.data, self._camera, self.scene)
        mujoco.mjv_makeLights(self.model, self.data, self.scene)
        if self._sky is not None:
            self._sky.pos = self.scene.camera[0].pos
        wider = self.widening * max(self.height / self.width, 1.0)
        shape = self.width / self.height
        for view in self.scene.camera:
            view.frustum_bottom *= wider
            view.frustum_top *= wider
            view.frustum_width = (view.frustum_top - view.frustum_bottom) / 2 * shape

    def add_robot(self, qpos: np.ndarray) -> range:
        """Adds the moving geoms in a position (nq,); returns their indices in the scene."""
        self._move(qpos)
        first, moving = self.scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
        mujoco.mjv_addGeoms(
            self.model, self.data, self._options, mujoco.MjvPerturb(), moving, self.scene
        )
        return range(first, self.scene.ngeom)

    def draw(self) -> np.ndarray:
        """Returns the picture (height, width, 3) uint8."""
        picture = np.empty((self.height, self.width, 3), dtype=np.uint8)
        self.redraw(picture, (0, 0, self.width, self.height))
        return picture

    def redraw(self, picture: np.ndarray, box: Box) -> None:
        """Redraws a part of the picture (height, width, 3), with the camera's frustum cut to the box."""
        self._hide_outside(box)
        left, top, right, bottom = box
        whole = [[getattr(view, name) for name in FRUSTUM] for view in self.scene.camera]
        for view, (centre, half, low, high) in zip(self.scene.camera, whole, strict=True):
            x, y = 2 * half / self.width, (high - low) / self.height  # of one pixel
            view.frustum_center = centre - half + x * (left + right) / 2
            view.frustum_width = x * (right - left) / 2
            view.frustum_bottom, view.frustum_top = high - y * bottom, high - y * top
        picture[top:bottom, left:right] = self.canvas.draw(self.scene, right - left, bottom - top)
        for view, values in zip(self.scene.camera, whole, strict=True):
            for name, value in zip(FRUSTUM, values, strict=True):
                setattr(view, name, value)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns column and row (n, 2) [pixels] of points (n, 3) [m], and their scale (n,) [pixels/m]."""
        eyes, view = self.scene.camera, self.scene.camera[0]
        offset = points - (eyes[0].pos + eyes[1].pos) / 2  # the middle of a stereo pair
        depth = offset @ view.forward
        shrink = np.ones(len(points)) if view.orthographic else view.frustum_near / depth
        scale = self.height / (view.frustum_top - view.frustum_bottom)
        across = shrink * (offset @ np.cross(view.forward, view.up)) - view.frustum_center
        along = view.frustum_top - shrink * (offset @ view.up)
        pixels = np.stack([self.width / 2 + scale * across, scale * along], axis=-1)
        return pixels, scale * shrink

    def extent(self, points: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns bounds of the pictures of spheres around points (n, 3) with radii (n,) [m].

        These are the least and the greatest column and row, (n, 2) each [pixels], with a margin of one
        pixel; infinite for a sphere that reaches the camera.
        """
        eyes, view = self.scene.camera, self.scene.camera[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels, scale = self.project(points)
            reach = (radii * scale)[:, None]
            if not view.orthographic:
                # The near side of a sphere appears larger and farther off the axis than its centre.
                depth = (points - (eyes[0].pos + eyes[1].pos) / 2) @ view.forward
                off = np.abs(pixels - [self.width / 2, self.height / 2])
                reach = (radii / (depth - radii))[:, None] * ((scale * depth)[:, None] + off)
                reach[depth <= radii], pixels[depth <= radii] = np.inf, 0.0
        return pixels - reach - 1, pixels + reach + 1

    def close(self) -> None:
        """Frees the GL context, unless the canvas was passed by the caller."""
        if self._own:
            self.canvas.close()

    def _hide_outside(self, box: Box) -> None:
        """Hides permanent geoms outside a box, because drawing them takes longer than a small box."""
        left, top, right, bottom = box
        low, high = self.extent(self._balls[:, :3], self._balls[:, 3])
        seen = np.asarray(((low < [right, bottom]) & (high > [left, top])).all(axis=1))
        for k in np.flatnonzero(seen != self._shown):
            self.scene.geoms[k].type = self._kinds[k] if seen[k] else HIDDEN
        self._shown = seen

    def _move(self, qpos: np.ndarray) -> None:
        mjcf.place(self.model, self.data, qpos, self._mocap)
        mujoco.mj_camlight(self.model, self.data)


def _gl_context(width: int, height: int) -> Any:
    """Returns an off-screen GL context of the chosen backend, else of EGL if it is available."""
    if not os.environ.get("MUJOCO_GL") and sys.platform.startswith("linux"):
        # With a display, or if MuJoCo was imported first, MuJoCo's own choice opens windows, which only the
        # main thread may do.
        with suppress(Exception):  # if EGL is not usable
            from mujoco.egl import GLContext

            return GLContext(width, height)
    return mujoco.GLContext(width, height)


def _in_fork() -> NoRenderer:
    return NoRenderer(
        "this process was forked from one that has drawn pictures, and cannot draw any: start it with "
        'multiprocessing\'s context "spawn", or draw the first picture after the fork'
    )


def _no_gl(error: Exception) -> NoRenderer:
    """Returns the error to raise when rendering fails."""
    backend = os.environ.get("MUJOCO_GL", "")
    cause = GL_PROBLEM or brief(error)
    return NoRenderer(
        f"off-screen rendering failed with MUJOCO_GL={backend!r} ({cause}): {GL_CURE}"
    )
