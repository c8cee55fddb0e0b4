"""Videos, written frame by frame, with one clear message where encoding fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import NoRenderer, brief

FFMPEG_CURE = (
    "check that the disk is writable and has room, and reinstall the encoder: "
    "pip install --force-reinstall imageio-ffmpeg"
)
# How a video is encoded, by its suffix: H.264 as browsers play it, or a GIF. More threads slow the drawing.
H264 = "-preset veryfast -threads 2 -sws_flags fast_bilinear -movflags +faststart"
ENCODERS: dict[str, dict[str, Any]] = {
    ".mp4": {"codec": "h264", "crf": 20, "ffmpeg_args": H264},
    ".gif": {"codec": "gif"},
}


@contextmanager
def video(
    path: Path, width: int, height: int, fps: float
) -> Iterator[Callable[[np.ndarray], None]]:
    """Writes a video, whole or not at all.

    Args:
        path: of the video; its suffix says whether it is an mp4 or a gif.
        width, height: of the frames [pixels], even.
        fps: frames per second.

    Yields:
        A function that appends one frame (height, width, 3) uint8.

    Raises:
        NoRenderer: ffmpeg is missing or failed; the message says what to do.
    """
    try:
        import imageio_ffmpeg
        import mediapy

        mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
        with (
            artifacts.replacing(path) as temporary,
            mediapy.VideoWriter(
                temporary, (height, width), fps=fps, **ENCODERS[path.suffix]
            ) as writer,
            ThreadPoolExecutor(1) as thread,
        ):
            # One frame goes to the encoder while the next is drawn.
            sent: Future[None] = thread.submit(lambda: None)

            def add(frame: np.ndarray) -> None:
                nonlocal sent
                sent.result()
                sent = thread.submit(writer.add_image, frame.copy())

            yield add
            sent.result()
    except (ImportError, OSError, RuntimeError) as error:
        raise NoRenderer(f"{path} cannot be encoded ({brief(error)}): {FFMPEG_CURE}") from error
