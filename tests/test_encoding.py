"""Videos: whole, or one sentence; whatever the program does that should encode them."""

from __future__ import annotations

import shlex
import stat
import threading
import time
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest
from sentences import assert_one_sentence_about

from hyrl_mj import BadInput, NoRenderer
from hyrl_mj.viz import encoding
from hyrl_mj.viz.encoding import EncodingFailed, check_whole, video

REAL = imageio_ffmpeg.get_ffmpeg_exe()
WIDTH, HEIGHT, FRAMES = 320, 240, 12  # more than a pipe holds


def write(path, frames=FRAMES, pause=0.0):
    with video(path, WIDTH, HEIGHT, 10) as add:
        for k in range(frames):
            add(np.full((HEIGHT, WIDTH, 3), 20 * k, dtype=np.uint8))
            time.sleep(pause)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_is_whole_and_has_every_frame(tmp_path, suffix):
    path = tmp_path / f"film{suffix}"
    write(path)
    check_whole(path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == FRAMES
    assert seconds == pytest.approx(FRAMES / 10, abs=0.2)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_that_is_cut_off_anywhere_is_not_whole(tmp_path, suffix):
    path = tmp_path / f"film{suffix}"
    write(path)
    content = path.read_bytes()
    for length in {0, 3, 8, 100, len(content) // 2, len(content) - 1}:
        path.write_bytes(content[:length])
        with pytest.raises(EncodingFailed, match=f"{length:,} bytes that are no whole"):
            check_whole(path)


LAST = "for last; do :; done; "  # the path of the video is the last argument
PROGRAMS = {
    "ends at once": ("exit 0", "Broken pipe|no whole"),
    "fails at once": ("echo no such encoder >&2; exit 3", "no such encoder"),
    "reads one frame": (f"head -c {WIDTH * HEIGHT * 3} >/dev/null", "Broken pipe|no whole"),
    "reads and writes nothing": ("cat >/dev/null", "left 0 bytes that are no whole mp4"),
    "writes other things": (LAST + 'cat >/dev/null; echo film >"$last"', "left 5 bytes"),
    "removes the file": (LAST + 'cat >/dev/null; rm "$last"', "left no file"),
    "fails at the end": ("cat >/dev/null; echo disk full >&2; exit 1", "disk full"),
    "is killed": ("cat >/dev/null; kill -9 $$", "Error writing"),
    "never reads": ("exec sleep 600", "took no frame for 1 s"),
    "never reads, in a child": ("sleep 600; true", "took no frame for 1 s"),
    "leaves a child that never reads": ("exec 3<&0; sleep 9 <&3 & exit 0", "took no frame for 1 s"),
    "never ends": ("cat >/dev/null; exec sleep 600", "wrote nothing for 1 s"),
    "closes its input": ("exec <&-; sleep 600", "took no frame|Broken pipe"),
    "talks for ever": ("cat >/dev/null & exec yes some words >&2", "took no frame|wrote nothing"),
}


@pytest.fixture
def program(tmp_path, monkeypatch):
    """A function that puts a shell script in the place of ffmpeg; what it does for 1 s is too long."""
    monkeypatch.setattr(encoding, "PATIENCE", 1.0)
    path = tmp_path / "bin" / "ffmpeg"
    path.parent.mkdir()
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(path))

    def put(script):
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(path.stat().st_mode | stat.S_IEXEC)
        return path

    return put


@pytest.mark.slow
@pytest.mark.parametrize(("script", "why"), PROGRAMS.values(), ids=PROGRAMS)
def test_a_program_that_does_something_else_ends_in_a_sentence(tmp_path, program, script, why):
    program(script)
    path = tmp_path / "films" / "film.mp4"
    path.parent.mkdir()
    path.write_bytes(b"of before")
    began = time.monotonic()
    with pytest.raises(NoRenderer, match=why) as refused:
        write(path)
    assert time.monotonic() - began < 10
    assert_one_sentence_about(refused, path)
    assert "pip install --force-reinstall imageio-ffmpeg" in str(refused.value)
    assert path.read_bytes() == b"of before"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.slow
def test_a_slow_program_is_waited_for_as_long_as_it_makes_progress(tmp_path, program):
    real = shlex.quote(REAL)
    program(f'sleep 0.6; {real} "$@"; status=$?; sleep 0.6; exit $status')
    write(tmp_path / "film.mp4", pause=0.1)
    check_whole(tmp_path / "film.mp4")


@pytest.mark.parametrize("kind", ["missing", "a folder", "not executable", "no program"])
def test_a_program_that_cannot_be_started_ends_in_a_sentence(tmp_path, program, kind):
    path = program("exit 0")
    if kind == "not executable":
        path.chmod(0o644)
    elif kind == "no program":
        path.write_bytes(b"\x7fELF and no more")
    else:
        path.unlink()
        if kind == "a folder":
            path.mkdir()
    with pytest.raises(NoRenderer, match="cannot be encoded") as refused:
        write(tmp_path / "film.mp4")
    assert_one_sentence_about(refused, tmp_path / "film.mp4")
    assert not (tmp_path / "film.mp4").exists()


def test_without_any_program_the_cure_is_said(tmp_path, monkeypatch):
    def none():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", none)
    with pytest.raises(NoRenderer, match=r"No ffmpeg exe.*pip install"):
        write(tmp_path / "film.mp4")


@pytest.mark.slow
def test_an_error_of_who_draws_ends_the_program_and_is_his(tmp_path, program):
    program("echo $$ >&2; exec sleep 600")
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError), video(tmp_path / "film.mp4", WIDTH, HEIGHT, 10):
        raise ZeroDivisionError
    assert not list(tmp_path.glob("film*"))
    time.sleep(0.5)
    assert threading.active_count() <= before + 1  # who feeds waits for frames that never come


def test_a_place_that_cannot_be_written_is_said_before_anything_is_drawn(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(BadInput, match="cannot be written"):
        write(tmp_path / "file" / "film.mp4")


def test_a_full_disk_is_no_missing_encoder(tmp_path, monkeypatch):
    # A run goes on without a video where nothing encodes one; where there is no room it must not.
    def fails(encoder):
        raise encoding.EncodingFailed("ffmpeg has ended")

    monkeypatch.setattr(encoding.Encoder, "finish", fails)
    frame = np.zeros((48, 64, 3), np.uint8)
    for free, error, words in (
        (0, BadInput, "No space left on device"),
        (2**40, NoRenderer, "cannot be encoded"),
    ):
        monkeypatch.setattr(
            encoding.shutil, "disk_usage", lambda _, free=free: SimpleNamespace(free=free)
        )
        with (
            pytest.raises(error, match=words),
            encoding.video(tmp_path / "a.mp4", 64, 48, 5) as add,
        ):
            add(frame)
        assert list(tmp_path.iterdir()) == []
