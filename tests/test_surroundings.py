"""A run in odd surroundings: it goes on, leaves every file, and says in a sentence what it lacks."""

import fcntl
import os
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from command_line import call
from gl import needs_gl
from planted import FEW_CELLS

import hyrl_mj

pytestmark = pytest.mark.slow  # a process for each run

PACKAGE = Path(hyrl_mj.__file__).parents[1]
COMMAND = shlex.join([sys.executable, "-m", "hyrl_mj.cli"])


def shell(script, cwd=None, **environment):
    """Run a line of bash, with $HYRL for the command line."""
    kept = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {script.replace('$HYRL', COMMAND)}"],
        env={**kept, "PYTHONPATH": str(PACKAGE), **environment},
        cwd=cwd, capture_output=True, text=True, timeout=120, errors="replace",
    )  # fmt: skip


@pytest.fixture
def folder(planted_circle, tmp_path):
    """A copy of the planted run, whose video and page are still to be made."""
    path = shutil.copytree(planted_circle[0].path, tmp_path / "run")
    for page in path.glob("report.html"):
        page.unlink()
    return path


def resume(path):
    settings = " ".join(f"{name}={value}" for name, value in FEW_CELLS.items())
    return f"$HYRL run unit_circle --preset smoke --set {settings} --out {path}"


def assert_whole(path, done):
    """The run has ended with its verdict, FAILED, and its page, which carries it."""
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert hyrl_mj.load_run(path).verdict.word == "FAILED"
    assert "FAILED" in (path / "report.html").read_text()
    assert not list(path.rglob("*.partial*"))


def sentences(text):
    return [line for line in text.splitlines() if line.startswith("hyrl-mj: ")]


# ---- streams


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("streams", "said"),
    [
        pytest.param(">&-", "standard output is closed", marks=pytest.mark.long),  # below, too
        (">/dev/full", "No space left on device"),
        ("| head -1", "the reader of standard output has gone"),
    ],
)
def test_a_run_goes_on_where_its_output_cannot_be_read(folder, streams, said):
    done = shell(f"{resume(folder)} {streams}", MUJOCO_GL="disable")
    assert_whole(folder, done)
    (sentence,) = sentences(done.stderr)
    assert said in sentence


NO_VIDEO = "replay: no video: "


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("streams", "backend", "said"),
    [
        ("2>/dev/full", "osmesa", "FAILED: "),
        ("2>&1 >&- | cat", "disable", "standard output is closed"),
    ],
)
def test_a_run_goes_on_where_its_errors_cannot_be_read_also_without_gl(
    folder, streams, backend, said
):
    done = shell(f"{resume(folder)} {streams}", MUJOCO_GL=backend)
    assert_whole(folder, done)
    assert said in done.stdout
    if backend == "osmesa":
        assert NO_VIDEO in done.stdout or (folder / "replay.mp4").stat().st_size > 10_000


def test_with_all_streams_closed_the_status_remains(folder):
    assert_whole(folder, shell(f"{resume(folder)} <&- >&- 2>&-", MUJOCO_GL="disable"))
    assert shell("$HYRL run unicycle >&- 2>&-").returncode == 2


@pytest.mark.parametrize("streams", ["2>&-", "2>/dev/full"])
def test_a_mistake_is_said_on_the_stream_that_is_left(streams):
    done = shell(f"$HYRL run unicycle {streams}")
    assert done.returncode == 2
    (sentence,) = sentences(done.stdout)
    assert "unknown task 'unicycle'" in sentence


@pytest.mark.parametrize(
    "command", ["list", pytest.param("--help", marks=pytest.mark.long), "run --help"]
)
def test_a_pipe_that_is_closed_early_gets_no_traceback(command):
    done = shell(f"$HYRL {command} | true")
    assert done.returncode == 0
    assert len(done.stderr.splitlines()) <= 1
    assert done.stderr.splitlines() == sentences(done.stderr)


def test_a_terminal_that_knows_few_characters_gets_others_also_without_gl(folder, tmp_path):
    ascii_only = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    path = folder.rename(tmp_path / "Läufe-走る")
    done = shell(resume(shlex.quote(str(path))), **ascii_only, MUJOCO_GL="nonsense")
    assert_whole(path, done)
    assert "run directory" in done.stdout
    assert "proved, own" in done.stdout
    assert NO_VIDEO in done.stdout or (path / "replay.mp4").stat().st_size > 10_000


@pytest.mark.parametrize("columns", ["1", "many", "100000"])
def test_every_width_can_be_read(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    done = call("run", "--help")
    assert done.returncode == 0, done.stderr
    assert "--preset" in done.stdout
    assert max(map(len, done.stdout.splitlines())) >= 50


@pytest.mark.parametrize(("columns", "shown"), [(20, False), (0, True), (80, True)])
def test_a_narrow_terminal_gets_no_bars(columns, shown):
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    code = "from hyrl_mj.system.streams import Streams; print(Streams().has_room_for_bars)"
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=theirs, text=True,
        env={**os.environ, "PYTHONPATH": str(PACKAGE)}, timeout=60,
    )  # fmt: skip
    os.close(ours)
    os.close(theirs)
    assert done.stdout.strip() == str(shown)


# ---- pictures and videos


@needs_gl
@pytest.mark.parametrize(
    "script",
    [pytest.param("exit 1", marks=pytest.mark.long), "for last; do :; done; echo x >$last"],
)
def test_with_a_broken_encoder_there_is_no_video_and_all_else(folder, tmp_path, script):
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    done = shell(resume(folder), IMAGEIO_FFMPEG_EXE=str(program))
    assert_whole(folder, done)
    assert NO_VIDEO in done.stdout
    assert "video at" not in done.stdout
    assert not list(folder.glob("replay*"))


# ---- folders


def test_a_working_directory_that_is_gone_is_named(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    done = shell(f"rmdir {gone}; $HYRL run unit_circle --preset smoke", cwd=gone)
    assert done.returncode == 2
    (sentence,) = sentences(done.stderr)
    assert "the working directory cannot be found" in sentence
    assert done.stderr.strip() == sentence


# An interrupt leaves a lock locked, which the end of the block then waits for.
STUCK = """
import threading, time
from hyrl_mj.system.streams import Streams

def command():
    lock = threading.Lock()
    try:
        print("ready", flush=True)
        time.sleep(60)
    finally:
        lock.acquire()
        lock.acquire()

raise SystemExit(Streams().run(command))
"""


# An interrupt strikes where Python ignores errors, and the work goes on.
DEAF = """
import time
from hyrl_mj.system.streams import Streams

class Slow:
    def __del__(self):
        print("ready", flush=True)
        time.sleep(60)

def command():
    Slow()
    time.sleep(60)

raise SystemExit(Streams().run(command))
"""


def test_an_interrupt_ends_a_process_whatever_it_strikes():
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", program],
            env=os.environ | {"PYTHONPATH": str(PACKAGE)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        for program in (STUCK, DEAF)
    ]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
    for process in processes:
        _, complaints = process.communicate(timeout=30)
        assert process.returncode == 130
        assert complaints == "hyrl-mj: interrupted; finished work is kept, run again to resume\n"
