"""The robots with several ways, put to the test: prints one table of runs that `hyrl-mj run` has made.

    hyrl-mj run gaps --seed 0 --out runs/gaps-0
    python scripts/many_ways.py runs/gaps-0 --episodes 10000

Episodes start near the critical set. A point of the critical set counts as confirmed if the runs from one
cell to either side of it, along some coordinate, go different ways. Among posts it is also compared with
where two ways are worth the same to an optimal controller, by dynamic programming.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

import hyrl_mj
from hyrl_mj.judging import Budget, Regions, attack, noisy_episodes
from hyrl_mj.judging.game import Lattice
from hyrl_mj.simulation import KINDS, WayRuns, way_runs
from hyrl_mj.system import progress
from hyrl_mj.system.streams import Streams
from hyrl_mj.tasks import ANY, LEFT, RIGHT, pattern_of
from hyrl_mj.tasks.pillar import PostsTask


def confirmed(run: hyrl_mj.Run) -> float:
    """Returns the share of the points of M* between runs that go different ways."""
    task, critical = run.task, run.critical_set
    parted = np.zeros(len(critical.points), dtype=bool)
    for aside in np.diag(np.multiply(critical.spacing, task.chart.scale)):
        ends = (task.chart.wrap(critical.points + way) for way in (aside, -aside))
        first, second = (
            WayRuns.from_rollout(task, way_runs(task, run.steady, end)) for end in ends
        )
        parted |= first.shows & second.shows & first.differ(second)
    return float(parted.mean())


def equal_returns(run: hyrl_mj.Run) -> np.ndarray:
    """Returns points (N, 2) between which the best way changes, by the discounted returns of the best inputs.

    The vehicle among posts gets on with every sample. It passes a post on the side of a mode's pattern if it
    crosses the line through the post, across the road, on that side.
    """
    task, gamma = run.task, run.settings.stage1.gamma
    lattice = Lattice.tabulate(task, run.lattice_grid)
    nodes, after = lattice.grid.nodes, lattice.after[:, 0]
    centres, _ = task.posts
    # What has arrived or failed is worth nothing any more.
    end = np.minimum(after, lattice.nodes - 1)
    runs_on = (after < lattice.nodes) & lattice.running[end]
    each = zip(end, lattice.levels, strict=True)
    reward = np.stack([task.reward(nodes[e], np.tile(u, (len(e), 1))) for e, u in each])
    values = []
    for mode in run.controller.modes:
        barred = np.zeros(len(nodes), dtype=bool)
        for (x, y), side in zip(centres, pattern_of(mode, len(centres)), strict=True):
            beside = np.abs(nodes[:, 0] - x) < lattice.grid.cell
            barred |= beside & {LEFT: nodes[:, 1] < y, RIGHT: nodes[:, 1] > y, ANY: False}[side]
        value = np.zeros(len(nodes))
        for _ in range(task.max_steps):
            later = np.where(runs_on & ~barred[end], reward + gamma * value[end], 0.0)
            value = later.max(axis=0)
        values.append(value)
    best = np.argmax(values, axis=0)
    decided = lattice.running & (np.ptp(values, axis=0) > 0)
    first, second = lattice.grid.neighbours()
    across = decided[first] & decided[second] & (best[first] != best[second])
    return (nodes[first] + nodes[second])[across] / 2


def measure(run: hyrl_mj.Run, count: int) -> dict[str, str]:
    """Returns the figures of a run by heading."""
    task, eps, points = run.task, run.settings.eps, run.critical_set.points
    modes = ", ".join(task.mode_name(q) for q in run.controller.modes)
    row = {
        "run": run.path.name,
        "starts won": f"{run.arrivals.arrived / run.arrivals.episodes:.1%}",
        "modes": modes,
        "M*": f"{run.critical_set.pieces} pieces, {len(points)} points",
        "confirmed": f"{confirmed(run):.1%}",
    }
    if isinstance(task, PostsTask):
        off = cKDTree(equal_returns(run)).query(points)[0]
        row["off the best returns: median, most"] = f"{np.median(off):.3f}, {off.max():.3f} m"
    near = Regions(points, near=True)
    noises = tuple(hyrl_mj.Noise(kind, eps) for kind in KINDS)
    starts = near.draw(task, eps, count, np.random.default_rng(0))
    # From the same starts, with the same signals in the same order.
    attacks = attack(task, run.controllers, starts, eps, Budget(rounds=1))
    for name, loop in run.controllers.items():
        ends = noisy_episodes(task, near, {name: loop}, noises, count).counts
        lost = " / ".join(str(end.lost) for end in ends)
        row[f"{name} lost: {' / '.join(KINDS)} / attack"] = f"{lost} / {attacks[name].count.lost}"
    if (game := run.robustness.game) is not None:
        for name in run.controllers:
            score = game.scores[name][-1]
            share = score.proved * score.winnable / score.open
            row[f"{name}: proved, own q0, of what is open"] = f"{share:.2%}"
    return row


def main() -> None:
    """Measures the runs and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--episodes", type=int, default=10_000)
    options = parser.parse_args()
    progress.enabled = sys.stderr.isatty()
    rows = [measure(hyrl_mj.load_run(path), options.episodes) for path in options.runs]
    headings = list(dict.fromkeys(name for row in rows for name in row))
    title = f"{options.episodes} episodes of each noise, and starts of the attack, near M*"
    table = Table(*headings, title=title)
    for row in rows:
        table.add_row(*(row.get(name, "-") for name in headings))
    Console(width=None if sys.stdout.isatty() else 220).print(table)


if __name__ == "__main__":
    sys.exit(Streams().run(main))
