"""`hyrl-mj doctor`: which libraries this machine has, what it lacks, and how to mend that."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

import numpy as np

from hyrl_mj.errors import NoRenderer
from hyrl_mj.rendering import GL_CURE
from hyrl_mj.viz.encoding import video

# Distributions whose versions matter. Read from their metadata: importing torch takes seconds.
DISTRIBUTIONS = (
    "mujoco",
    "gymnasium",
    "stable-baselines3",
    "torch",
    "numpy",
    "scipy",
    "safetensors",
    "mediapy",
    "imageio-ffmpeg",
    "pillow",
    "matplotlib",
    "jinja2",
)
RENDER_TIMEOUT = 60.0  # [s]

# Draws for half a second; prints the name of the GL device and its frames per second.
_FRAMES = """
from time import perf_counter
from hyrl_mj.errors import HyrlError
from hyrl_mj.rendering import SceneRenderer
from hyrl_mj.tasks import get_task
try:
    model = get_task("vehicle").model
    renderer = SceneRenderer(model, 640, 480)
    renderer.place(model.qpos0, "overhead")
    if renderer.draw().std() == 0:
        raise SystemExit("the picture is blank")
    began, frames = perf_counter(), 0
    while perf_counter() < began + 0.5:
        renderer.draw()
        frames += 1
    print(f"{renderer.canvas.device}, {frames / (perf_counter() - began):.0f} full frames/s at 640 x 480")
    renderer.close()
except HyrlError as error:
    raise SystemExit(str(error))
"""


def report() -> tuple[list[str], bool]:
    """Examines this machine.

    Returns:
        Lines to print, with the cure for what is missing; whether all is well.
    """
    lines, missing = versions()
    if missing:
        lines.append(f"cure: pip install {' '.join(missing)}")
    (device, picture), film = _rendering(), _encoding_problem()
    lines.append(f"GL backend         MUJOCO_GL={os.environ.get('MUJOCO_GL', '(not set)')}")
    lines.append(f"rendering          {device if picture is None else f'FAILED: {picture}'}")
    lines.append(f"a second of video  {'encoded' if film is None else f'FAILED: {film}'}")
    well = not missing and picture is None and film is None
    if not well:
        lines.append("Training and analysis need neither pictures nor videos.")
    return lines, well


def versions() -> tuple[list[str], list[str]]:
    """Returns a line per distribution with its version, and the names of those that are missing."""
    installed = {name: _version(name) for name in DISTRIBUTIONS}
    lines = [f"{name:<18} {version or 'MISSING'}" for name, version in installed.items()]
    missing = [name for name, version in installed.items() if version is None]
    return [f"python             {platform.python_version()}", *lines], missing


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _rendering() -> tuple[str, str | None]:
    """Draws in a child process, because a broken GL driver may take its process down.

    Returns:
        The GL device and its speed; why nothing can be drawn and the cure, or None if it can.
    """
    package = str(Path(__file__).resolve().parents[1])
    paths = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
    try:
        child = subprocess.run(
            [sys.executable, "-c", _FRAMES],
            env={**os.environ, "PYTHONPATH": paths},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=RENDER_TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        return "", f"no picture within {RENDER_TIMEOUT:g} s; {GL_CURE}"
    if child.returncode == 0:
        return child.stdout.strip(), None
    if child.returncode < 0:
        return "", f"the GL driver crashed ({_signal(-child.returncode)}); {GL_CURE}"
    said = child.stderr.strip().splitlines() or ["it said nothing"]
    return "", said[-1] if GL_CURE in said[-1] else f"{said[-1]}; {GL_CURE}"


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _encoding_problem() -> str | None:
    """Returns why no video can be encoded, and the cure; None if one can."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            with video(Path(folder) / "trial.mp4", 64, 48, 10) as add:
                for level in range(0, 250, 25):
                    add(np.full((48, 64, 3), level, dtype=np.uint8))
        except NoRenderer as error:
            return str(error)
    return None
