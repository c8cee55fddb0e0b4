"""Off-screen pictures of a model, with one clear message where this machine cannot draw."""

from __future__ import annotations

import os

import mujoco
import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.errors import NoRenderer


class SceneRenderer:
    """Draws states of one model from its named cameras.

    Args:
        model: the compiled model.
        width, height: of the picture [pixels].

    Raises:
        NoRenderer: there is no GL library; the message says which to install.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        self._data = mujoco.MjData(model)
        self._model = model
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        # Each GL backend fails in its own way: ImportError, AttributeError, RuntimeError, ...
        except Exception as error:
            raise NoRenderer(
                f"off-screen rendering failed with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r} "
                f"({type(error).__name__}: {error}). On Debian or Ubuntu: apt-get install libegl1 "
                "libgl1-mesa-dri, and MUJOCO_GL=egl"
            ) from error

    @property
    def scene(self) -> mujoco.MjvScene:
        """The scene of the next picture, to add marks to between `place` and `draw`."""
        return self._renderer.scene

    def place(self, qpos: np.ndarray, camera: str) -> None:
        """Put the robot into a position (nq,) and choose a camera."""
        mjcf.object_id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, camera)

    def draw(self) -> np.ndarray:
        """The picture: (height, width, 3) uint8."""
        return self._renderer.render()

    def close(self) -> None:
        """Give the GL context back."""
        self._renderer.close()
