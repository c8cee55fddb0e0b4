"""Videos, written frame by frame by mediapy, with one clear message where that fails.

mediapy itself waits for ever for an ffmpeg that takes no frame, and does not see that a file is not whole.
To kill ffmpeg does not end the wait, because a child of it may hold the pipe: so a thread of its own waits.
"""

from __future__ import annotations

import errno
import os
import queue
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrl_mj.errors import NoRenderer, brief
from hyrl_mj.files import artifacts

if TYPE_CHECKING:
    import mediapy

# The time for which ffmpeg may neither take a frame nor write [s].
PATIENCE = 30.0
# How a video is encoded, by its suffix: H.264 as browsers play it, or a GIF. More threads slow the drawing.
ENCODERS: dict[str, dict[str, Any]] = {
    ".mp4": {
        "codec": "h264",
        "crf": 20,
        "ffmpeg_args": "-preset veryfast -threads 2 -sws_flags fast_bilinear -movflags +faststart",
    },
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
        BadInput: the path cannot be written.
        NoRenderer: ffmpeg is missing, failed, stopped, or left no whole video; the message says what to do.
    """
    try:
        import imageio_ffmpeg
        import mediapy

        mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise _failed(path, brief(error)) from error
    with artifacts.replacing(path) as temporary:
        options = ENCODERS[path.suffix]
        # ffmpeg takes what stands before a colon, as in a name of a folder, for a protocol.
        place = temporary.absolute()
        encoder = Encoder(mediapy.VideoWriter(place, (height, width), fps=fps, **options))
        try:
            yield encoder.add
            encoder.finish()
            check_whole(temporary)
        except EncodingFailed as error:
            # ffmpeg does not tell why. Where not even a frame has room, a run must not go on without a video.
            if shutil.disk_usage(temporary.parent).free < height * width * 3:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
            raise _failed(path, str(error)) from error
        finally:
            encoder.stop()


class EncodingFailed(Exception):
    """Why a video could not be encoded."""


class Encoder:
    """A writer that is fed by a thread of its own, and watched: ffmpeg may fail, or stop, at any moment.

    Args:
        writer: writes the video.
    """

    def __init__(self, writer: mediapy.VideoWriter):
        self._writer, self._problem = writer, ""
        # One frame goes to the encoder while the next is drawn.
        self._frames: queue.Queue[np.ndarray | None] = queue.Queue(1)
        # No one waits for this thread, which can be held up for as long as ffmpeg lives.
        self._feeding = Thread(target=self._feed, daemon=True)
        self._feeding.start()

    def add(self, frame: np.ndarray) -> None:
        """Appends a frame (height, width, 3) uint8.

        Raises:
            EncodingFailed: ffmpeg has ended, or takes no more frames.
        """
        self._put(frame.copy())

    def finish(self) -> None:
        """Waits until all frames are encoded.

        Raises:
            EncodingFailed: ffmpeg failed, or makes no progress.
        """
        self._put(None)
        size, since = -1, time.monotonic()
        while self._feeding.is_alive():
            if (now := self._size()) != size:
                size, since = now, time.monotonic()
            if time.monotonic() > since + PATIENCE:
                raise EncodingFailed(f"ffmpeg wrote nothing for {PATIENCE:g} s")
            self._feeding.join(0.1)
        if self._problem:
            raise EncodingFailed(self._problem)

    def stop(self) -> None:
        """Ends ffmpeg and the thread, if they have not ended."""
        # mediapy has no way to give up.
        process = getattr(self._writer, "_proc", None)
        if process is not None and process.poll() is None:
            process.kill()
        with suppress(queue.Full):
            self._frames.put_nowait(None)

    def _put(self, frame: np.ndarray | None) -> None:
        """Hands a frame to the thread."""
        patient_until = time.monotonic() + PATIENCE
        while time.monotonic() < patient_until:
            if not self._feeding.is_alive():
                raise EncodingFailed(self._problem or "ffmpeg has ended")
            with suppress(queue.Full):
                return self._frames.put(frame, timeout=0.1)
        raise EncodingFailed(f"ffmpeg took no frame for {PATIENCE:g} s")

    def _feed(self) -> None:
        """Writes frames until None comes, or ffmpeg has ended."""
        try:
            with self._writer as writer:
                while (frame := self._frames.get()) is not None:
                    writer.add_image(frame)
        except Exception as error:  # whatever the writer raises when ffmpeg fails or is ended
            self._problem = brief(error)

    def _size(self) -> int:
        """Returns the size of the file [bytes]."""
        with suppress(OSError):
            return int(self._writer.path.stat().st_size)
        return 0


def check_whole(path: Path) -> None:
    """Raises `EncodingFailed` unless a file is a whole mp4 or gif, from its first to its last byte."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise EncodingFailed(f"ffmpeg left no file ({error.strerror or error})") from error
    if path.suffix == ".gif":
        whole = content.startswith(b"GIF8") and content.endswith(b"\x3b")
    else:
        whole = {b"ftyp", b"moov", b"mdat"} <= set(_boxes(content))
    if not whole:
        kind = path.suffix.removeprefix(".")
        raise EncodingFailed(f"ffmpeg left {len(content):,} bytes that are no whole {kind}")


def _boxes(content: bytes) -> Iterator[bytes]:
    """Yields the kind of each box that an mp4 consists of; the last one must end with the file."""
    at = 0
    while at < len(content):
        size, kind = int.from_bytes(content[at : at + 4]), content[at + 4 : at + 8]
        if size == 1:  # the size follows, in eight bytes
            size = int.from_bytes(content[at + 8 : at + 16])
        if size < 8 or at + size > len(content):
            return
        yield kind
        at += size


def _failed(path: Path, cause: str) -> NoRenderer:
    return NoRenderer(
        f"{path} cannot be encoded ({cause}): check that the disk is writable and has room, and reinstall "
        "the encoder: pip install --force-reinstall imageio-ffmpeg"
    )
