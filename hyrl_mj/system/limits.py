"""Limits of time and memory for programs that try what a stranger made, in processes of their own.

It imports nothing but Python's own modules: a program takes `limit` by `runpy.run_path`, without the package.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

# What a program may take beyond what it imports: seconds of the processor, seconds in all, and bytes.
SECONDS, LONGEST, MEMORY = 12, 17, 2**29


class Ended(Exception):
    """A program has ended without a result; the text says why, as "it takes longer than 12 s"."""


def limit(seconds: int = SECONDS, memory: int = MEMORY) -> None:
    """Limits the time and the memory of this process from now on, where the system can."""
    try:
        import resource
    except ImportError:  # Windows
        return

    def lower(kind: int, soft: int, hard: int) -> None:
        now = resource.getrlimit(kind)[1]
        if now != resource.RLIM_INFINITY:
            soft, hard = min(soft, now), min(hard, now)
        resource.setrlimit(kind, (soft, hard))

    busy = math.ceil(time.process_time()) + seconds
    lower(resource.RLIMIT_CPU, busy, busy + 1)
    lower(resource.RLIMIT_CORE, 0, 0)
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            (used,) = (line.split()[1] for line in status if line.startswith("VmData"))
    except OSError:  # macOS
        return
    most = int(used) * 1024 + memory
    lower(resource.RLIMIT_DATA, most, most)


def tried(
    program: Path,
    content: bytes,
    *arguments: str,
    seconds: int = SECONDS,
    longest: float = LONGEST,
    memory: int = MEMORY,
) -> Any:
    """Returns what a program writes that limits itself: `python program seconds memory arguments < content`.

    It writes one JSON object. The folders of the program and of the user are not on its path.

    Raises:
        Ended: it ended without a result, or took longer than `longest` [s].
    """
    command = [sys.executable, "-P", str(program), str(seconds), str(memory), *arguments]
    try:
        run = subprocess.run(
            command, input=content, capture_output=True, timeout=longest, env=_environment()
        )
    except subprocess.TimeoutExpired:
        raise Ended(f"it takes longer than {longest:g} s") from None
    try:
        # What a library prints comes before.
        return json.loads(run.stdout.decode(errors="replace").strip().rpartition("\n")[2])
    except ValueError:
        raise Ended(_why(run, seconds, memory)) from None


def _environment() -> dict[str, str]:
    """Returns the environment of a program on one thread, which finds what this process does.

    But for the current folder, whose modules it searches for none but what the user names.
    """
    folders = [f for f in sys.path if os.path.isabs(f) and f != os.getcwd()]
    # Nor does it draw: MuJoCo then imports no library for it.
    few = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MUJOCO_GL": "disable"}
    return os.environ | few | {"PYTHONPATH": os.pathsep.join(folders)}


def _why(run: subprocess.CompletedProcess[bytes], seconds: int, memory: int) -> str:
    """Returns why a program ended without a result."""
    import signal

    if run.returncode == -getattr(signal, "SIGXCPU", 0):
        return f"it takes longer than {seconds} s"
    if run.returncode < 0:
        return f"it makes its process crash, or needs more than {memory >> 20} MB of memory"
    last = run.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    return f"its process ended ({last[:160] or f'status {run.returncode}'})"
