"""Videos, written frame by frame by ffmpeg, with one clear message where that fails."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import NoRenderer, brief

FFMPEG_CURE = (
    "check that the disk is writable and has room, and reinstall the encoder: "
    "pip install --force-reinstall imageio-ffmpeg"
)
# The time for which ffmpeg may neither take a frame nor write [s], and how often that is looked at.
PATIENCE, GLANCE = 30.0, 0.1
LAST_WORDS = 2_000  # bytes of ffmpeg's messages that are kept
# How a video is encoded, by its suffix: H.264 as browsers play it, or a GIF. More threads slow the drawing.
ENCODERS = {
    ".mp4": "-vcodec h264 -pix_fmt yuv420p -vb 0 -crf 20 -preset veryfast -threads 2 "
    "-sws_flags fast_bilinear -movflags +faststart",
    ".gif": "-vcodec gif -pix_fmt pal8 "
    "-vf split[s0][s1];[s0]palettegen[p];[s1][p]paletteuse -f gif",
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

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise _failed(path, brief(error)) from error
    source = f"-f rawvideo -vcodec rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i - -an"
    options = f"-v error {source} {ENCODERS[path.suffix]} -y".split()
    with artifacts.replacing(path) as temporary:
        try:
            encoder = Encoder([program, *options, str(temporary)], temporary)
            try:
                yield encoder.add
                encoder.finish()
            finally:
                encoder.stop()
            check_whole(temporary)
        except EncodingFailed as error:
            raise _failed(path, str(error)) from error


class EncodingFailed(Exception):
    """Why a video could not be encoded."""


class Encoder:
    """A process of ffmpeg that is fed with frames, and watched: it may fail, or stop, at any moment.

    Args:
        command: the program and its arguments.
        path: of the file that it writes.

    Raises:
        EncodingFailed: it cannot be started.
    """

    def __init__(self, command: Sequence[str], path: Path):
        pipe = subprocess.PIPE
        try:
            # In a session of its own, so that it can be ended with all of its children.
            self._process = subprocess.Popen(
                command, bufsize=0, stdin=pipe, stdout=subprocess.DEVNULL, stderr=pipe,
                start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise EncodingFailed(brief(error)) from error
        self._path, self._words = path, b""
        # One frame goes to the encoder while the next is drawn.
        self._frames: queue.Queue[bytes | None] = queue.Queue(1)
        # No one waits for these threads, which can be held up for as long as the process lives.
        self._feeding = Thread(target=self._feed, daemon=True)
        self._listening = Thread(target=self._listen, daemon=True)
        self._feeding.start()
        self._listening.start()

    def add(self, frame: np.ndarray) -> None:
        """Appends a frame (height, width, 3) uint8.

        Raises:
            EncodingFailed: the process has ended, or takes no more frames.
        """
        self._put(frame.tobytes())

    def finish(self) -> None:
        """Waits until all frames are encoded.

        Raises:
            EncodingFailed: the process failed, or makes no progress.
        """
        self._put(None)
        size, since = -1, time.monotonic()
        while self._process.poll() is None:
            if (now := self._size()) != size:
                size, since = now, time.monotonic()
            if time.monotonic() > since + PATIENCE:
                raise EncodingFailed(f"ffmpeg wrote nothing for {PATIENCE:g} s")
            time.sleep(GLANCE)
        if self._process.returncode:
            raise self._ended()

    def stop(self) -> None:
        """Ends the process, if it has not ended."""
        if self._process.poll() is not None:
            return
        with suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(PATIENCE)

    def _put(self, frame: bytes | None) -> None:
        """Hands a frame to the thread that feeds the process."""
        patient_until = time.monotonic() + PATIENCE
        while time.monotonic() < patient_until:
            if not self._feeding.is_alive():
                raise self._ended()
            with suppress(queue.Full):
                return self._frames.put(frame, timeout=GLANCE)
        raise EncodingFailed(f"ffmpeg took no frame for {PATIENCE:g} s")

    def _feed(self) -> None:
        """Writes frames to the process until None comes, or it has ended."""
        stdin = self._process.stdin
        assert stdin
        with suppress(OSError):
            while (frame := self._frames.get()) is not None:
                left = memoryview(frame)
                while left:
                    left = left[stdin.write(left) :]
        with suppress(OSError):
            stdin.close()

    def _listen(self) -> None:
        """Keeps the last words of the process."""
        stderr = self._process.stderr
        assert stderr
        while words := stderr.read(LAST_WORDS):
            self._words = (self._words + words)[-LAST_WORDS:]

    def _size(self) -> int:
        """Returns the size of the file [bytes]."""
        with suppress(OSError):
            return self._path.stat().st_size
        return 0

    def _ended(self) -> EncodingFailed:
        """Returns how the process has ended, with its last words."""
        self._listening.join(1.0)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        words = " ".join(self._words.decode(errors="replace").split())
        status = self._process.returncode
        how = "closed its input" if status is None else f"ended with status {status}"
        return EncodingFailed(f"ffmpeg {how}: {words[-300:]}" if words else f"ffmpeg {how}")


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
    return NoRenderer(f"{path} cannot be encoded ({cause}): {FFMPEG_CURE}")
