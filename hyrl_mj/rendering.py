"""Off-screen pictures of a model and videos of them, with one clear message where that fails."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np

from hyrl_mj import artifacts, mjcf
from hyrl_mj.errors import BadInput, NoRenderer

GL_CURE = "on Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri, and set MUJOCO_GL=egl"
FFMPEG_CURE = (
    "check that the disk is writable and has room, and reinstall the encoder: "
    "pip install --force-reinstall imageio-ffmpeg"
)


class _Renderer(mujoco.Renderer):
    # Where its constructor fails early its destructor still asks for these.
    _gl_context = None
    _mjr_context = None


class SceneRenderer:
    """Draws states of one model from its named cameras.

    Args:
        model: the compiled model.
        width, height: of the picture [pixels].

    Raises:
        BadInput: the picture is larger than the MJCF allows.
        NoRenderer: there is no GL library; the message says which to install.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        largest = (int(model.vis.global_.offwidth), int(model.vis.global_.offheight))
        if not (0 < width <= largest[0] and 0 < height <= largest[1]):
            raise BadInput(
                f"a picture of {width} x {height} pixels cannot be drawn: model "
                f"{mjcf.model_name(model)} allows 1 x 1 to {largest[0]} x {largest[1]}"
            )
        self._data = mujoco.MjData(model)
        self._model = model
        try:
            self._renderer = _Renderer(model, height, width)
        # Each GL backend fails in its own way: ImportError, AttributeError, RuntimeError, ...
        except Exception as error:
            raise _no_gl(error) from error

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
        try:
            return self._renderer.render()
        except mujoco.FatalError as error:
            raise _no_gl(error) from error

    def close(self) -> None:
        """Give the GL context back."""
        self._renderer.close()


@contextmanager
def video(
    path: Path, width: int, height: int, fps: float
) -> Iterator[Callable[[np.ndarray], None]]:
    """Write an H.264 video, whole or not at all.

    Args:
        path: where to, an mp4.
        width, height: of the frames [pixels], even.
        fps: frames a second.

    Yields:
        A function that appends one frame (height, width, 3) uint8.

    Raises:
        NoRenderer: ffmpeg is missing or failed; the message says how to mend it.
    """
    try:
        import imageio_ffmpeg
        import mediapy

        mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
        with (
            artifacts.replacing(path) as temporary,
            mediapy.VideoWriter(
                temporary, (height, width), fps=fps, crf=20, ffmpeg_args="-movflags +faststart"
            ) as writer,
        ):
            yield writer.add_image
    except (ImportError, OSError, RuntimeError) as error:
        raise NoRenderer(f"no video at {path} ({_short(error)}): {FFMPEG_CURE}") from error


def _no_gl(error: Exception) -> NoRenderer:
    backend = os.environ.get("MUJOCO_GL", "")
    cause = mjcf.GL_PROBLEM or _short(error)
    return NoRenderer(
        f"off-screen rendering failed with MUJOCO_GL={backend!r} ({cause}): {GL_CURE}"
    )


def _short(error: Exception) -> str:
    """The kind of an error and the beginning of what it says, in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text if len(text) <= 160 else text[:157] + '...'}"
