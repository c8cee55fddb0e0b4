"""Bad surroundings, each pair of them: training must not suffer, and a sentence says what is missing."""

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from itertools import combinations, cycle
from pathlib import Path
from random import Random

from attacks import Answer, Trial, child, command, differences, files, small
from attacks.material import RUN, TASK, Material

# The largest file that a full disk takes [bytes]: policies fit, videos and pages do not.
ROOM = 60_000
# Encoders that do not encode: one of them in each trial.
BROKEN = {"fails": "exit 1", "writes nothing": "cat > /dev/null", "never reads": "exec sleep 600"}
# With fewer trials than this no surroundings are tried that only a new process has.
FEW = 4
# Files that no surroundings but those of the disk may change.
TRAINED = ("policy.safetensors", "mode_0.safetensors", "mode_1.safetensors", "robustness.json")


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each pair, or some of them."""
    material.finished()
    pairs = [pair for pair in combinations(CONDITIONS, 2) if set(pair) not in EITHER]
    if count < FEW:  # without those that take a new process, which imports everything again
        pairs = [pair for pair in pairs if not FRESH & set(pair)]
    pairs = pairs if count >= len(pairs) else draw.sample(pairs, count)
    return [
        Trial(
            f"{' and '.join(pair)} ({ffmpeg})" if "broken ffmpeg" in pair else " and ".join(pair),
            partial(_attempt, material, pair, BROKEN[ffmpeg]),
        )
        for pair, ffmpeg in zip(pairs, cycle(BROKEN), strict=False)
    ]


# ---- the surroundings; each is set in the process that then runs


def no_gl() -> None:
    """EGL finds no driver, so that MuJoCo cannot even be imported with it."""
    os.environ |= {"MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"}
    os.environ.pop("PYOPENGL_PLATFORM", None)  # MuJoCo has set it


def broken_gl() -> None:
    """MuJoCo is imported, but there is no display to draw on."""
    os.environ["MUJOCO_GL"] = "glfw"
    for name in ("PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY"):
        os.environ.pop(name, None)


def no_ffmpeg() -> None:
    os.environ["IMAGEIO_FFMPEG_EXE"] = "/nonexistent/ffmpeg"


def broken_ffmpeg() -> None:
    """The trial has written it."""
    os.environ["IMAGEIO_FFMPEG_EXE"] = str(Path("ffmpeg").resolve())


def full_disk() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM, ROOM))


def read_only() -> None:
    """Nothing but temporary files can be written; root may write everywhere, and so becomes nobody."""
    Path().chmod(0o555)
    small.become_nobody()


def closed(fd: int) -> None:
    """As after `>&-`: Python starts without the stream."""
    os.close(fd)
    if fd == 1:
        sys.stdout = None  # type: ignore[assignment]
    else:
        sys.stderr = None  # type: ignore[assignment]


def ascii_only() -> None:
    os.environ |= {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}


def latin_1() -> None:
    """A locale with an encoding that is not UTF-8, made here, because few machines have one."""
    subprocess.run(["localedef", "-i", "en_US", "-f", "ISO-8859-1", "./latin_1"], check=False)
    os.environ |= {"LOCPATH": os.getcwd(), "LC_ALL": "latin_1", "PYTHONUTF8": "0"}


def narrow() -> None:
    os.environ["COLUMNS"] = "1"


CONDITIONS: dict[str, Callable[[], None]] = {
    "no GL": no_gl,
    "broken GL": broken_gl,
    "no ffmpeg": no_ffmpeg,
    "broken ffmpeg": broken_ffmpeg,
    "a full disk": full_disk,
    "a read-only folder": read_only,
    "closed stdout": partial(closed, 1),
    "closed stderr": partial(closed, 2),
    "an ASCII locale": ascii_only,
    "a Latin-1 locale": latin_1,
    "COLUMNS=1": narrow,
}
# What a process only learns when it starts.
FRESH = {"no GL", "broken GL", "an ASCII locale", "a Latin-1 locale"}
# Of these a process has one at most.
EITHER = ({"no GL", "broken GL"}, {"an ASCII locale", "a Latin-1 locale"})
DISK = {"a full disk", "a read-only folder"}
NO_VIDEO = {name for name in CONDITIONS if "GL" in name or "ffmpeg" in name}


def _attempt(material: Material, pair: tuple[str, ...], ffmpeg: str, folder: Path) -> str:
    """Runs in the pair of surroundings, then resumes in good ones."""
    folder.chmod(0o777)
    (folder / "ffmpeg").write_text(f"#!/bin/sh\n{ffmpeg}\n")
    (folder / "ffmpeg").chmod(0o755)
    answer = child(partial(_run, pair), folder, seconds=30)
    Path(folder).chmod(0o777)
    broke = _judged(pair, answer) or _harmed(material, pair, folder)
    if broke:
        return broke
    resumed = child(command(*RUN), folder)
    if broke := resumed.broke(ended=(0, 1)):
        return f"resumed: {broke}"
    wrong = differences(folder / TASK, material.finished())
    return f"resumed, and not as before: {wrong}" if wrong else ""


def _run(pair: tuple[str, ...]) -> None:
    """Sets the surroundings of this process, and runs."""
    # A read-only folder comes last: other surroundings write into it.
    fresh = bool(FRESH & set(pair))
    for name in sorted(pair, key=lambda name: name in DISK):
        if fresh and name == "a read-only folder":
            os.environ[small.NOBODY] = "yes"  # nobody may not read Python itself
        else:
            CONDITIONS[name]()
    if not fresh:
        command(*RUN)()
        return
    words = [sys.executable, str(Path(small.__file__)), *RUN]
    sys.exit(subprocess.run(words, stdin=subprocess.DEVNULL, check=False).returncode)


def _judged(pair: tuple[str, ...], answer: Answer) -> str:
    """Returns what is wrong with the answer: it must say once what is missing, where it can be said."""
    failed = set(pair) & DISK
    out, err = "closed stdout" not in pair, "closed stderr" not in pair
    # Nothing can be said to nobody; that nothing could be shown is said, too.
    sentences = (2 - out) * err
    if broke := answer.broke((1, 2) if failed else (0, 1), sentences):
        return broke
    if failed and answer.err.count("hyrl-mj: ") != sentences:
        return f"not {sentences} sentence(s) about the disk, but {answer.err!r}"
    if not failed and out and set(pair) & NO_VIDEO and answer.out.count("replay: no video") != 1:
        return f"not one sentence about the video, but {answer.out!r}"
    if "video at" in answer.out and set(pair) & NO_VIDEO:
        return "it says that there is a video"
    return ""


def _harmed(material: Material, pair: tuple[str, ...], folder: Path) -> str:
    """Returns which results of training the surroundings have changed."""
    if not (folder / TASK).is_dir():
        return ""
    found, sound = files(folder / TASK), files(material.finished())
    for name in TRAINED:
        if name not in found and not set(pair) & DISK:
            return f"{name} is missing"
        if name in found and found[name].read_bytes() != sound[name].read_bytes():
            return f"{name} has other bytes"
    return ""
