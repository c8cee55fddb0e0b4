"""Tries to beat what a run's certificate calls proved: random starts, under five kinds of noise.

    python scripts/proof.py runs/vehicle --runs 1000000

Starts are drawn from all proved cells, for each start mode and for the controller's own choice. The noise is
uniform, alternating, random between both ends of the bound, the worst of the game on nodes, and the one that
looks for the least certain state. Exits with status 1 if a single run is lost.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from itertools import cycle, islice, product
from pathlib import Path

import numpy as np

import hyrl_mj
from hyrl_mj import Noise
from hyrl_mj.judging.game import NEVER, Game
from hyrl_mj.judging.proof import CellNoise, Certificate
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import LoopSettings, Sample, Signal, closed_loop
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Outcome

BATCH = 5_000


class BangBang(Signal):
    """Noise at one end of its bound or the other, drawn at every sample."""

    kind = "bang-bang"

    def sample(self, now: Sample) -> np.ndarray:
        return self.rng.choice([-self.bound, self.bound], now.measurement.shape) * self.shares


def main() -> None:
    """Counts the runs that are lost, by controller and kind of noise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="the run directory")
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    run = hyrl_mj.load_run(args.run)
    task, eps, loop = run.task, run.settings.eps, run.controllers["hyrl"]
    grid = Grid.with_cells(task.chart, run.settings.lattice)
    game = Game(task, run.split, {"hyrl": loop}, eps, grid=grid)
    certificate = Certificate.certify(game, {"hyrl": loop})
    assert certificate.cells is not None, certificate.why_not
    cells, outer = certificate.cells, certificate.value("hyrl", eps)
    shares = np.array(task.noisy, dtype=float)
    noises = {
        "uniform": Noise("uniform", eps),
        "alternating": Noise("alternating", eps),
        "bang-bang": BangBang(eps, shares),
        "worst on nodes": game.worst_noise("hyrl", eps),
        "least certain": CellNoise(certificate, "hyrl", eps),
    }
    rng, lost, tried = np.random.default_rng(args.seed), Counter[str](), Counter[str]()
    rows = [*enumerate(loop.modes), (len(loop.modes), None)]
    proved = [np.flatnonzero((outer[row, :-2] < NEVER) & cells.running) for row, _ in rows]
    batches = [*islice(cycle(product(noises, rows)), -(-args.runs // BATCH))]
    for kind, (row, mode) in progress_bar(batches, "runs", "batches"):
        at = rng.choice(proved[row], BATCH)
        off = rng.uniform(-0.5, 0.5, (BATCH, len(cells.counts)))
        starts = cells.middle(at) + off * grid.spacing
        modes = None if mode is None else np.full(BATCH, mode)
        result = closed_loop(
            task, loop, starts, noises[kind], modes, seed=int(rng.integers(2**31)),
            settings=LoopSettings(quiet=True),
        )  # fmt: skip
        lost[kind] += int((result.outcome != Outcome.REACHED).sum())
        tried[kind] += BATCH
    for kind in noises:
        print(f"{kind:15} {lost[kind]:,} lost of {tried[kind]:,} runs from proved starts")
    sys.exit(lost.total() > 0)


if __name__ == "__main__":
    main()
