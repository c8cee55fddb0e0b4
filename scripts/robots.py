"""The robots with dynamics, put to the test: trains what is missing, and prints one table.

    python scripts/robots.py                                # rover and quadrotor, seeds 0 to 2
    python scripts/robots.py --tasks rover --seeds 0 --episodes 1000

Episodes start near the critical set. An expert rule, which knows which side to take, says from which starts a
controller has to survive without noise. Exit status 1 if some figure misses its target.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj.judging import Regions, noisy_episodes
from hyrl_mj.policies import Controller, PolicyController
from hyrl_mj.runs.sweeps import Row
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.system import progress

KINDS = ("alternating", "adversarial")
# Starts for the comparison with the expert.
STARTS = 2_000
# Episodes that tell how large a share is lost; none lost takes more of them.
SHARE = 1_000


@dataclass(frozen=True)
class Expert:
    """Passes the pillar on one side with room to spare, then goes for the set-point.

    Attributes:
        task: the rover or the quadrotor.
        side: 1 for the left, -1 for the right.
    """

    task: hyrl_mj.Task
    side: int

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Inputs (n, m) for measurements (n, p)."""
        x, y = measured[:, 0], measured[:, 1]
        centre = self.task.obstacle
        gap = self.task.clearance(np.array([[centre[0], centre[1], *measured[0, 2:]]]))[0]
        before = x < centre[0] - 0.2 * gap
        goal_y = np.where(before, self.side * (0.25 - gap), self.task.set_point[1])
        if self.task.name == "quadrotor":
            wanted = 3 * (goal_y - y)
        else:
            bearing = np.clip(1.5 * np.arctan2(goal_y - y, 0.5), -1.2, 1.2)
            wanted = 4 * (bearing - measured[:, 2])
        return np.clip(wanted[:, None], *self.task.input_limits)


def crashes_without_noise(run: hyrl_mj.Run) -> dict[str, int]:
    """Returns how often each controller fails from starts that the expert survives on one side."""
    task = run.task
    z = task.starts(STARTS, np.random.default_rng(0))
    survived = np.zeros(STARTS, dtype=bool)
    for side in (1, -1):
        survived |= reached(task, PolicyController(Expert(task, side)), z)
    if not survived.any():
        raise SystemExit(f"{task.name}: the expert survives from nowhere")
    return {
        name: int((~reached(task, loop, z) & survived).sum())
        for name, loop in run.controllers.items()
    }


def reached(task: hyrl_mj.Task, loop: Controller, z: np.ndarray) -> np.ndarray:
    """Returns whether runs from starts (n, d) reach the end: (n,) bool."""
    rollout = closed_loop(task, loop, z, settings=LoopSettings(quiet=True))
    return rollout.outcome == hyrl_mj.Outcome.REACHED


def measure(made: Row, count: int, folder: Path) -> list[str]:
    """Returns one row of the table; figures that miss their target end in "!"."""
    run = hyrl_mj.load_run(folder / made.name)
    noises = tuple(hyrl_mj.Noise(kind, run.settings.eps) for kind in KINDS)
    row = [made.setting.task, str(made.seed)]
    for loop, controller in run.controllers.items():
        n = min(count, SHARE) if loop == "policy" else count
        regions = Regions(run.critical_set.points, near=True)
        for ends in noisy_episodes(run.task, regions, {loop: controller}, noises, n).counts:
            share = ends.lost / ends.episodes
            good = share >= 0.2 if loop == "policy" else ends.lost == 0
            shown = f"{share:.1%}" if loop == "policy" else f"{ends.lost} of {ends.episodes}"
            row.append(shown if good else f"{shown} !")
    quiet = crashes_without_noise(run)
    row += [f"{n}" if n == 0 else f"{n} !" for n in quiet.values()]
    return [*row, f"{made.seconds:.0f} s{'' if made.seconds <= 480 else ' !'}"]


def main() -> int:
    """Runs and prints; returns 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    robots = ("rover", "quadrotor")
    parser.add_argument("--tasks", nargs="+", default=list(robots), choices=robots)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--out", type=Path, default=Path("runs/robots"))
    options = parser.parse_args()
    progress.enabled = sys.stderr.isatty()
    table = Table(title="failures in episodes that start near M*, by noise")
    headings = ["robot", "seed"]
    for loop, target in (("RL policy", ">= 20%"), ("HyRL", "0")):
        headings += [f"{loop}, {kind}\n{target}" for kind in KINDS]
    headings += [f"{loop}, no noise\n0" for loop in ("RL policy", "HyRL")]
    for heading in (*headings, "run\n<= 480 s"):
        table.add_column(heading)
    missed = 0
    for made in hyrl_mj.sweep(options.tasks, seeds=tuple(options.seeds), out=options.out).rows:
        if not made.done:
            raise SystemExit(f"{made.name}: {made.sentence}")
        row = measure(made, options.episodes, options.out)
        missed += sum(cell.endswith("!") for cell in row)
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    print(f"{missed} figures miss their target" if missed else "every figure meets its target")
    return int(missed > 0)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except hyrl_mj.HyrlError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_status)
