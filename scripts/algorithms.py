"""The worst case by algorithm: trains what is missing and prints one table a problem.

    python scripts/algorithms.py                     # every algorithm on both problems, seed 0, eps 0.1
    python scripts/algorithms.py --tasks vehicle --algorithms a2c --seeds 0 1 2

Runs are resumed; the times are those of what was missing. Exit status 1 if some run does not win all
of the paper's replay starts.
"""

import argparse
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj import progress
from hyrl_mj.policies import ALGORITHMS, algorithms
from hyrl_mj.viz.tables import arrivals, percent

PAPER = ("unit_circle", "vehicle")
HEADINGS = (
    "algorithm", "seed", "policy won", "HyRL won, own q0", "HyRL won, any q0", "replays, policy",
    "replays, HyRL", "run [s]", "CPU [s]",
)  # fmt: skip


def able(task: str) -> list[str]:
    """The algorithms of SB3 that can have the inputs of a task."""
    discrete = hyrl_mj.get_task(task).learning.levels is not None
    return [name for name, algorithm in ALGORITHMS.items() if algorithm.takes(discrete)]


def row(task: str, algorithm: str, seed: int, eps: float, out: Path) -> tuple[list[str], bool]:
    """The cells of one run, and whether the hybrid controller wins all replays."""
    began, worked = time.monotonic(), time.process_time()
    path = out / f"{task}_{algorithm.replace(':', '_')}_{eps:g}_{seed}"
    options = hyrl_mj.RunOptions(eps=eps, seed=seed, algorithm=algorithm, out=path)
    run = hyrl_mj.run(task, options, say=lambda text: None)
    scores = {who: score[-1] for who, score in run.robustness.game.scores.items()}
    arcs = run.arcs()
    replays = {policy: arrivals(run, arcs, policy) for policy in (True, False)}
    cells = [algorithms.title(algorithm), str(seed)]
    cells += [percent(scores["policy"].won)]
    cells += [percent(scores["hyrl"].won), percent(scores["hyrl"].won_any)]
    cells += [f"{won} of {total}" for won, total in replays.values()]
    cells += [f"{time.monotonic() - began:.0f}", f"{time.process_time() - worked:.0f}"]
    won, total = replays[False]
    return cells, won == total


def main() -> int:
    """Run and print; 1 if a replay is lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(PAPER), choices=PAPER)
    parser.add_argument("--algorithms", nargs="+", help="by default all that can")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--eps", type=float, default=0.1, help="bound of the noise")
    parser.add_argument("--out", type=Path, default=Path("runs/algorithms"))
    options = parser.parse_args()
    progress.enabled = sys.stderr.isatty()
    lost = 0
    for task in options.tasks:
        table = Table(*HEADINGS, title=f"{task}, noise {options.eps:g}, exact game")
        for algorithm in options.algorithms or able(task):
            for seed in options.seeds:
                cells, good = row(task, algorithm, seed, options.eps, options.out)
                lost += not good
                table.add_row(*cells)
                print(task, *cells, file=sys.stderr, flush=True)
        Console(width=None if sys.stdout.isatty() else 140).print(table)
    print(f"{lost} runs lose a replay" if lost else "every run wins all replays")
    return int(lost > 0)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except hyrl_mj.HyrlError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_status)
