"""`hyrl-mj doctor`: which libraries this machine has, which it lacks, and how to install them."""

from __future__ import annotations

import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np

from hyrl_mj.errors import NoRenderer
from hyrl_mj.physics import memory
from hyrl_mj.physics.rendering import GL_CURE
from hyrl_mj.viz.encoding import video

RENDER_TIMEOUT = 60.0  # [s]

# Draws for half a second; prints the name of the GL device and its frames per second.
_FRAMES = """
from time import perf_counter
from hyrl_mj.errors import HyrlError
from hyrl_mj.physics.rendering import SceneRenderer
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
    """Returns lines about this machine, with the cure for what is missing, and whether nothing is."""
    lines, missing = versions()
    healthy = not missing
    if missing:
        lines.append(f"cure: pip install {' '.join(missing)}")
    if mujoco.__version__ == memory.WRONG_VERSION:
        lines.append(
            "note: MuJoCo 4.0.0 computes wrong forces with a sparse constraint Jacobian; such models are "
            "refused, and those of this package are dense"
        )
    lines.append(f"GL backend         MUJOCO_GL={os.environ.get('MUJOCO_GL', '(not set)')}")
    for title, attempt in (("rendering", _rendering), ("a second of video", _encoding)):
        try:
            result = attempt()
        except NoRenderer as error:
            result, healthy = f"FAILED: {error}", False
        lines.append(f"{title:<18} {result}")
    if not healthy:
        lines.append("Training and analysis need neither pictures nor videos.")
    return lines, healthy


def versions() -> tuple[list[str], list[str]]:
    """Returns a line per distribution with its version, and the names of those that are missing.

    These are this one and those that it needs, by their metadata: importing torch takes seconds.
    """
    lines, missing = [f"python             {platform.python_version()}"], []
    needed = [n for n in metadata.requires("hyrl-mj") or () if "extra ==" not in n]
    for name in ("hyrl-mj", *(re.split(r"[^\w-]", n)[0] for n in needed)):
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            version = "MISSING"
            missing.append(name)
        lines.append(f"{name:<18} {version}")
    return lines, missing


def _rendering() -> str:
    """Returns the GL device and its speed, or raises `NoRenderer`."""
    # In a child process, because a broken GL driver may take its process down.
    try:
        child = subprocess.run(
            [sys.executable, "-P", "-c", _FRAMES],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(os.path.isabs, sys.path))},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=RENDER_TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        raise NoRenderer(f"no picture within {RENDER_TIMEOUT:g} s; {GL_CURE}") from None
    if child.returncode < 0:
        name = signal.Signals(-child.returncode).name
        raise NoRenderer(f"the GL driver crashed ({name}); {GL_CURE}")
    if child.returncode > 0:
        *_, last = child.stderr.strip().splitlines() or ["no picture"]
        raise NoRenderer(last if GL_CURE in last else f"{last}; {GL_CURE}")
    return child.stdout.strip()


def _encoding() -> str:
    """Encodes a video, or raises `NoRenderer`."""
    with (
        tempfile.TemporaryDirectory() as folder,
        video(Path(folder) / "trial.mp4", 64, 48, 10) as add,
    ):
        for level in range(0, 250, 25):
            add(np.full((48, 64, 3), level, dtype=np.uint8))
    return "encoded"
