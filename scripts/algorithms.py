"""The worst case by algorithm: sweeps over those of SB3 that each problem of the paper can have.

    python scripts/algorithms.py                     # every algorithm on both problems, seed 0, eps 0.1
    python scripts/algorithms.py --tasks vehicle --algorithms a2c --seeds 0 1 2

Exit status 1 if some run does not win all of the paper's replay starts.
"""

import argparse
import sys
from pathlib import Path

import hyrl_mj
from hyrl_mj.policies import ALGORITHMS
from hyrl_mj.viz import print_sweep
from hyrl_mj.viz.tables import arrivals

PAPER = ("unit_circle", "vehicle")


def able(task: str) -> list[str]:
    """The algorithms of SB3 that can have the inputs of a task."""
    discrete = hyrl_mj.get_task(task).learning.levels is not None
    return [name for name, algorithm in ALGORITHMS.items() if algorithm.takes(discrete)]


def main() -> int:
    """Runs and prints; returns 1 if a replay is lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(PAPER), choices=PAPER)
    parser.add_argument("--algorithms", nargs="+", help="by default all that can")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--eps", type=float, default=0.1, help="bound of the noise")
    parser.add_argument("--out", type=Path, default=Path("runs/algorithms"))
    options = parser.parse_args()
    lost = []
    for task in options.tasks:
        result = hyrl_mj.sweep(
            task, seeds=tuple(options.seeds), eps=(options.eps,), out=options.out / task,
            algorithm=tuple(options.algorithms or able(task)),
        )  # fmt: skip
        print_sweep(result)
        for row in result.rows:
            if not row.done:
                lost.append(f"{row.name}: {row.sentence}")
                continue
            run = hyrl_mj.load_run(options.out / task / row.name)
            won, total = arrivals(run, run.arcs(), policy=False)
            lost += [f"{row.name} wins {won} of {total} replays"] if won < total else []
    print("\n".join(lost) or "every run wins all replays")
    return int(bool(lost))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except hyrl_mj.HyrlError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_status)
