"""The robustness of ten independent runs: trains what is missing and prints one table a problem.

    python scripts/ten_seeds.py                      # both problems, seeds 0 to 9, eps 0.1
    python scripts/ten_seeds.py --eps 0.2 --tasks vehicle --seeds 0 1 2

Runs are resumed; a run takes about a minute. Exit status 1 if some figure misses its target.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj import progress
from hyrl_mj.game import GameResult

PAPER = ("unit_circle", "vehicle")
# A figure of a run: its heading, how it is read from the game, and what it must be.
Figure = tuple[str, Callable[[GameResult], float], Callable[[float], bool], str]


def scores(game: GameResult, name: str) -> list[float]:
    """Returns one score of HyRL at every noise bound (none, half, all)."""
    return [getattr(score, name) for score in game.scores["hyrl"]]


def figures(task: str, noise: float) -> list[Figure]:
    """Returns what each run of a problem must show."""
    if task == "vehicle":
        own = 0.999 if noise <= 0.1 else 0.995
        wanted: list[Figure] = []
        for i, name in enumerate(("0", f"{noise / 2:g}", f"{noise:g}")):
            heading = f"won, own q0, noise {name}"
            wanted.append((heading, lambda g, i=i: scores(g, "won")[i], least(own), f">= {own}"))
        if noise <= 0.1:
            wanted.append(("any q0", lambda g: scores(g, "won_any")[-1], least(0.95), ">= 0.95"))
        heading = "|y| at x = 3, no noise [m]"
        wanted.append((heading, lambda g: g.miss_without_noise["hyrl"], most(0.05), "<= 0.05"))
        return wanted
    band = 0.12 if noise <= 0.1 else 0.22
    wanted = [
        ("trapped, any q0, all noises", lambda g: 1 - min(scores(g, "won_any")), most(0.0), "0"),
        ("excursion [rad]", lambda g: scores(g, "excursion")[-1], most(band), f"<= {band}"),
    ]
    if noise <= 0.1:
        heading = "worst time, any q0 [s]"
        wanted.append((heading, lambda g: scores(g, "time_any")[-1], most(3.4), "<= 3.4"))
        heading = "own q0 [s]"
        wanted.append((heading, lambda g: scores(g, "time")[-1], most(3.1), "<= 3.1"))
    return wanted


def least(target: float) -> Callable[[float], bool]:
    """Returns whether a figure is at least so much."""
    return lambda value: value >= target


def most(target: float) -> Callable[[float], bool]:
    """Returns whether a figure is at most so much; the plant itself is right to 1e-6."""
    return lambda value: value <= target + 1e-6


def main() -> int:
    """Runs and prints; returns 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(PAPER), choices=PAPER)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--eps", type=float, default=0.1, help="bound of the noise")
    parser.add_argument("--out", type=Path, default=Path("runs/seeds"))
    options = parser.parse_args()
    progress.enabled = sys.stderr.isatty()
    missed = 0
    for task in options.tasks:
        wanted = figures(task, options.eps)
        table = Table(title=f"{task}, noise {options.eps:g}, exact game")
        table.add_column("seed")
        for heading, _, _, target in wanted:
            table.add_column(f"{heading}\n{target}")
        table.add_column("run [s]")
        for seed in options.seeds:
            began = time.monotonic()
            out = options.out / f"{task}_{options.eps:g}_{seed}"
            made = hyrl_mj.RunOptions(eps=options.eps, seed=seed, out=out)
            game = hyrl_mj.run(task, made, say=lambda text: None).robustness.game
            cells = []
            for _, read, good, _ in wanted:
                value = read(game)
                missed += not good(value)
                cells.append(f"{value:.4f}" if good(value) else f"[red]{value:.4f} ![/red]")
            table.add_row(str(seed), *cells, f"{time.monotonic() - began:.0f}")
            print(f"{task} seed {seed}: done", file=sys.stderr, flush=True)
        Console(width=None if sys.stdout.isatty() else 140).print(table)
    print(f"{missed} figures miss their target" if missed else "every figure meets its target")
    return int(missed > 0)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except hyrl_mj.HyrlError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_status)
