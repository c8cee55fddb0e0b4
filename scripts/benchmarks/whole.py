"""The command `hyrl-mj run` with all its stages, video and report included."""

import shutil
from collections.abc import Callable, Iterator
from itertools import count

from benchmarks import Figure
from benchmarks.runs import Runs


def figures(runs: Runs) -> Iterator[Figure]:
    """Both problems, each time with a seed of its own."""
    for task in ("vehicle", "unit_circle"):
        work, peaks = _run(runs, task)
        yield Figure(
            f"hyrl-mj run {task}",
            "s",
            "",
            "<= 60 s, <= 1500 MB",
            work,
            least=0.0,
            memory=lambda peaks=peaks: max(peaks),
            slow=True,
        )


def _run(runs: Runs, task: str) -> tuple[Callable[[], int], list[float]]:
    """The work, and the peak memory [MB] of each time it was done."""
    seeds, peaks = count(), []

    def work() -> int:
        seed = next(seeds)
        path = runs.folder / f"{task}_whole_{seed}"
        peaks.append(runs.make(task, seed, path))
        shutil.rmtree(path)
        return 1

    return work, peaks
