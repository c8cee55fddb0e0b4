"""The finished runs that the figures are about, made when they are first asked for, and what that takes."""

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import hyrl_mj
from benchmarks import Figure
from hyrl_mj import Run


@dataclass(frozen=True)
class Runs:
    """Where they lie, and the preset that they are made with."""

    folder: Path
    preset: str

    def load(self, task: str) -> Run:
        """A finished run."""
        path = self.folder / f"{task}_0"
        if not path.exists():
            self.make(task, 0, path)
        return hyrl_mj.load_run(path)

    def make(self, task: str, seed: int, path: Path) -> float:
        """Run the command; its peak memory [MB]."""
        command = ["-m", "hyrl_mj.cli", "run", task, "--preset", self.preset, "--seed", str(seed)]
        return child([*command, "--out", str(path)])


def child(arguments: list[str]) -> float:
    """Run Python in a process of its own, without its output; its peak memory [MB]."""
    process = subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    peak = 0.0
    while process.poll() is None:
        peak = max(peak, peak_memory(process.pid))
        time.sleep(0.02)
    if process.returncode:
        raise SystemExit(f"python {' '.join(arguments)} failed")
    return peak


def peak_memory(pid: int) -> float:
    """The most that a process has had in memory so far [MB], on Linux.

    `ru_maxrss` would say that of the process that started it, if that is more.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):  # it has just ended, or there is no such file here
        return 0.0


def figures(runs: Runs) -> Iterator[Figure]:
    """The command `hyrl-mj run` with all its stages, video included, each time with a seed of its own."""
    for task in ("vehicle", "unit_circle"):
        seeds, peaks = count(), []

        def work(task=task, seeds=seeds, peaks=peaks) -> int:
            path = runs.folder / f"{task}_whole"
            peaks.append(runs.make(task, next(seeds), path))
            shutil.rmtree(path)
            return 1

        def memory(peaks=peaks) -> float:
            return max(peaks)

        target = "<= 60 s, <= 1500 MB"
        yield Figure(
            f"hyrl-mj run {task}", "s", "", target, work, memory=memory, least=0.0, slow=True
        )
