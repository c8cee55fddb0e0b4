"""Videos, written frame by frame by ffmpeg, with one clear message where that fails.

ffmpeg may fail, or stop, at any moment, and a child of it may hold the pipe: who waits too long for it ends
all of them.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Timer

import numpy as np

from hyrl_mj.errors import NoRenderer, brief
from hyrl_mj.files import artifacts

# The time for which ffmpeg may neither take a frame nor write [s].
PATIENCE = 30.0
# How a video is encoded, by its suffix: H.264 as browsers play it, or a GIF. More threads slow the drawing.
ENCODERS = {
    ".mp4": "-vcodec h264 -pix_fmt yuv420p -vb 0 -crf 20 -preset veryfast -threads 2 "
    "-sws_flags fast_bilinear -movflags +faststart",
    ".gif": "-vcodec gif -pix_fmt pal8 -vf split[s0][s1];[s0]palettegen[p];[s1][p]paletteuse -f gif",
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
    with artifacts.replacing(path) as temporary:
        try:
            # ffmpeg takes what stands before a colon, as in a name of a folder, for a protocol.
            encoder = Encoder(temporary.absolute(), width, height, fps)
        except (ImportError, RuntimeError, OSError) as error:
            raise _failed(path, brief(error)) from error
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
    """An ffmpeg that writes a video, and is watched.

    Args:
        path, width, height, fps: of the video.

    Raises:
        ImportError, RuntimeError, OSError: there is no ffmpeg, or it cannot be started.
    """

    def __init__(self, path: Path, width: int, height: int, fps: float):
        import imageio_ffmpeg

        frames = f"-f rawvideo -vcodec rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -"
        options = f"-v error {frames} -an {ENCODERS[path.suffix]} -y".split()
        self._path = path
        # In a session of its own, its children can be ended with it.
        self._process = subprocess.Popen(
            [imageio_ffmpeg.get_ffmpeg_exe(), *options, str(path)],
            stdin=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0, start_new_session=True,
        )  # fmt: skip

    def add(self, frame: np.ndarray) -> None:
        """Appends a frame (height, width, 3) uint8.

        Raises:
            EncodingFailed: ffmpeg has ended, or takes no more frames.
        """
        assert self._process.stdin is not None
        left, since = memoryview(frame.tobytes()), time.monotonic()
        watch = Timer(PATIENCE, self._kill)
        watch.start()
        try:
            while left:
                left = left[self._process.stdin.write(left) :]
        except OSError as error:
            if time.monotonic() >= since + PATIENCE:
                raise EncodingFailed(f"ffmpeg took no frame for {PATIENCE:g} s") from error
            raise EncodingFailed(self._said() or brief(error)) from error
        finally:
            watch.cancel()

    def finish(self) -> None:
        """Waits until all frames are encoded.

        Raises:
            EncodingFailed: ffmpeg failed, or makes no progress.
        """
        assert self._process.stdin is not None
        self._process.stdin.close()
        size, since = -1, time.monotonic()
        while self._process.poll() is None:
            now = self._path.stat().st_size if self._path.exists() else 0
            if now != size:
                size, since = now, time.monotonic()
            if time.monotonic() > since + PATIENCE:
                raise EncodingFailed(f"ffmpeg wrote nothing for {PATIENCE:g} s")
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(0.1)
        if status := self._process.returncode:
            raise EncodingFailed(self._said() or f"ffmpeg ended with status {status}")

    def stop(self) -> None:
        """Ends ffmpeg and its children, if it has not ended."""
        if self._process.poll() is None:
            self._kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stderr):
            assert pipe is not None
            pipe.close()

    def _said(self) -> str:
        """Returns the errors that ffmpeg has written, and ends it."""
        self._kill()
        assert self._process.stderr is not None
        return self._process.stderr.read().decode(errors="replace").strip()

    def _kill(self) -> None:
        if not hasattr(os, "killpg"):  # on Windows
            self._process.kill()
        else:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)


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
