"""How time and memory grow with the number of simulations, rods and episodes.

Each size runs in a process of its own, so that its peak memory is its own:

    python scripts/benchmarks/growth.py simulations 4096
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.runs import peak_memory

SIZES = {
    "simulations": (1, 16, 256, 4_096, 65_536),
    "rods": (10, 20, 40, 80, 160),
    "episodes": (1_000, 10_000, 100_000, 1_000_000),
}
LABELS = {
    "simulations": "simulations side by side, 60 samples",
    "rods": "rods of the first level",
    "episodes": "robustness episodes",
}


def measure(kind: str, size: int, run: Path) -> tuple[float, float]:
    """Seconds and peak memory [MB] of one size, in this process."""
    import hyrl_mj

    task = hyrl_mj.get_task("vehicle")
    if kind == "simulations":
        from benchmarks.engine import episodes

        work = episodes(task, size)
        began = time.perf_counter()
        work()
    elif kind == "rods":
        policy = hyrl_mj.load_run(run).policy
        began = time.perf_counter()
        hyrl_mj.find_critical_set(task, policy, size, 1 / 32)
    else:
        from hyrl_mj.judging import Regions, noisy_episodes
        from hyrl_mj.simulation import Noise

        finished = hyrl_mj.load_run(run)
        began = time.perf_counter()
        loops = {"HyRL": finished.controller}
        regions = Regions(finished.critical_set.points)
        noisy_episodes(task, regions, loops, (Noise("uniform", 0.1),), size)
    took = time.perf_counter() - began
    return took, peak_memory()


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
    print(*measure(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])))
