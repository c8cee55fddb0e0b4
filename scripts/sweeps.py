"""Sweeps over the paper's problems, and whether each run meets its targets.

    python scripts/sweeps.py                             # both problems, seeds 0 to 9, eps 0.1
    python scripts/sweeps.py --eps 0.2 --tasks vehicle --seeds 0 1 2
    python scripts/sweeps.py --algorithms all --seeds 0 --out runs/algorithms

The runs are those of `hyrl-mj sweep`. Each has to win all replays of its scene; with the task's own algorithm
its figures have targets, too. Exit status 1 if something is missed.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import hyrl_mj
from hyrl_mj.policies import ALGORITHMS
from hyrl_mj.runs.sweeps import Row
from hyrl_mj.system.streams import Streams
from hyrl_mj.viz import print_sweep
from hyrl_mj.viz.tables import arrivals

PAPER = ("unit_circle", "vehicle")
TINY = 1e-6  # to which the plants are right


def targets(task: str, eps: float) -> dict[str, tuple[float, float]]:
    """Returns the least and the greatest value of each figure that a run must show."""
    if task == "vehicle":
        own = 0.995 if eps <= 0.1 else 0.99
        wanted = {"hyrl_proved": (own, 1.0), "hyrl_not_broken": (own, 1.0)}
        wanted["hyrl_not_broken_without_noise"] = (0.999, 1.0)
        wanted["hyrl_miss_without_noise"] = (0.0, 0.05)
        return wanted | ({"hyrl_proved_any": (0.945, 1.0)} if eps <= 0.1 else {})
    wanted = {"hyrl_proved_any": (1.0, 1.0), "hyrl_proved_any_without_noise": (1.0, 1.0)}
    wanted["hyrl_excursion"] = (0.0, 0.12 if eps <= 0.1 else 0.22)
    times = {"hyrl_proved_time": (0.0, 3.1), "hyrl_proved_time_any": (0.0, 3.4)}
    return wanted | (times if eps <= 0.1 else {})


def missed(row: Row, folder: Path) -> Iterator[str]:
    """Yields what a run does not show."""
    if not row.done:
        yield f"{row.name}: {row.sentence}"
        return
    run = hyrl_mj.load_run(folder / row.name)
    won, total = arrivals(run, run.arcs(), policy=False)
    if won < total:
        yield f"{row.name} wins {won} of {total} replays"
    wanted = {} if row.setting.algorithm else targets(row.setting.task, row.setting.eps)
    for name, (least, most) in wanted.items():
        value = row.figures.get(name)
        if value is None or not least <= value <= most + TINY:
            yield f"{row.name}: {name} is {value}, not from {least:g} to {most:g}"


def main() -> None:
    """Runs and prints; ends with status 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(PAPER), choices=PAPER)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--eps", type=float, default=0.1, help="bound of the noise")
    parser.add_argument("--algorithms", nargs="+", default=[], help="or all that can be used")
    parser.add_argument("--out", type=Path, default=Path("runs/seeds"))
    options = parser.parse_args()
    lines = []
    for task in options.tasks:
        algorithms, folder = tuple(options.algorithms), options.out / task
        if algorithms == ("all",):
            discrete = hyrl_mj.get_task(task).learning.levels is not None
            algorithms = tuple(n for n, kind in ALGORITHMS.items() if kind.takes(discrete))
        seeds, eps = tuple(options.seeds), (options.eps,)
        result = hyrl_mj.sweep(task, seeds=seeds, eps=eps, out=folder, algorithm=algorithms)
        print_sweep(result)
        lines += [line for row in result.rows for line in missed(row, folder)]
    print("\n".join(lines) or "every run meets its targets")
    sys.exit(bool(lines))


if __name__ == "__main__":
    sys.exit(Streams().run(main))
