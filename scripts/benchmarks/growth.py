"""How time and memory grow with the number of simulations, rods and episodes.

Each size runs in a process of its own, so that its peak memory is its own:

    python scripts/benchmarks/growth.py simulations 4096
"""

import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import hyrl_mj
from benchmarks.engine import SAMPLES, episodes
from benchmarks.runs import peak_memory
from hyrl_mj.judging import Regions, noisy_episodes

SIZES = {
    "simulations": (1, 16, 256, 4_096, 65_536),
    "rods": (10, 20, 40, 80, 160),
    "episodes": (1_000, 10_000, 100_000, 1_000_000),
}
LABELS = {
    "simulations": f"simulations side by side, {SAMPLES} samples",
    "rods": "rods of the first level",
    "episodes": "robustness episodes",
}


def work_of(kind: str, size: int, path: Path) -> Callable[[], object]:
    """Returns the work of one size, on a run of the vehicle."""
    run = hyrl_mj.load_run(path)
    if kind == "simulations":
        return episodes(run.task, size)
    if kind == "rods":
        return partial(hyrl_mj.find_critical_set, run.task, run.policy, size, 1 / 32)
    loops, regions = {"HyRL": run.controller}, Regions(run.critical_set.points)
    noise = hyrl_mj.Noise("uniform", 0.1)
    return partial(noisy_episodes, run.task, regions, loops, (noise,), size)


def plot(run: Path, path: Path) -> None:
    """Measure all sizes, and draw them."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, len(SIZES), figsize=(11, 6), sharex="col", layout="constrained")
    for (above, below), (kind, sizes) in zip(axes.T, SIZES.items(), strict=True):
        time_, memory = np.array([_child(kind, size, run) for size in sizes]).T
        work = 2 * np.square(sizes) if kind == "rods" else np.array(sizes)
        above.loglog(work, time_, "o-", label="measured")
        above.loglog(work, time_[-1] * work / work[-1], "--", color="0.6", label="linear")
        above.set_ylabel("time [s]")
        above.legend()
        below.plot(work, memory, "o-")
        below.set(xlabel=LABELS[kind], ylabel="peak memory [MB]")
        below.set_ylim(0, 1.2 * max(memory))
        for axis in (above, below):
            axis.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def _child(kind: str, size: int, run: Path) -> tuple[float, ...]:
    print(f"growth: {size} {kind} ...", file=sys.stderr, flush=True)
    command = [sys.executable, __file__, kind, str(size), str(run)]
    answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return tuple(map(float, answer.split()))


if __name__ == "__main__":
    work = work_of(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
    began = time.perf_counter()
    work()
    print(time.perf_counter() - began, peak_memory())
