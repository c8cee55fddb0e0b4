"""Replays: what is proved or won is played in MuJoCo before a word is said about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrl_mj.judging.game import NEARLY, NEVER, LostReplay, ReplayCount, Score
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.judging.proof.certificate import Certificate
from hyrl_mj.judging.proof.counterexamples import CellNoise, start_modes
from hyrl_mj.policies import Controller
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import (
    NOT_STARTED,
    SENSOR,
    AnyNoise,
    LoopSettings,
    Noise,
    Rollout,
    closed_loop,
    covers_sensor,
    judge,
)
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Outcome, Task

# Starts by kind of noise, 10,000 in all: a run of a minute takes about two seconds longer. The noise between
# the nodes asks the controller about seventeen measurements at each sample, and the worst on nodes is looked
# up, which takes twice as long as other noise: these get fewer starts.
STARTS = {
    "none": 3_000,
    "uniform": 3_000,
    "alternating": 2_900,
    "worst": 1_000,
    "cells": 100,
    "sensor": 1_000,
}
# Runs side by side.
BATCH = 1_000
# Runs of each kind of noise that are played to their end, though they are proved to have arrived before.
WHOLE = 100


@dataclass(frozen=True)
class Batch:
    """Starts that are played at once.

    Attributes:
        noise: the noise.
        z0: (n, d) chart points.
        q0: (n,) modes at the start, `NOT_STARTED` where the controller picks it.
        seed: seed of the noise.
        steps: samples (n,) after which each run is proved to have arrived for good; None to the end of
            episodes.
    """

    noise: AnyNoise
    z0: np.ndarray
    q0: np.ndarray
    seed: int
    steps: np.ndarray | None = None


def replay(certificate: Certificate, name: str, score: Score) -> ReplayCount | None:
    """Plays in MuJoCo what a score says before it is believed, and returns what was lost.

    Where something is proved these are starts anywhere in proved cells, for each start mode and for the mode
    that the controller picks. Where nothing is proved of nearly all winnable starts, but no signal is known
    that beats one of them, they lie in winnable cells, and the controller picks its mode. With the weakest
    first: a third lies at the border of what is proved, a third where it arrives latest, and the others are
    starts of the score, at random.

    Returns:
        The count, None if the score says nothing, or is an estimate.
    """
    game = certificate.game
    if game.lattice.estimate or not score.winnable:
        return None
    nearly = score.proved is not None and score.proved >= NEARLY
    whole = score.not_broken == 1
    if not (nearly or whole or score.proved):
        return None
    of = "won" if whole and not nearly else "proved"
    # A tenth of the starts is played where so little is proved that no word follows from it.
    few = 1 if nearly or whole else 10
    batches = batches_of(certificate, name, score.eps, of, few)
    starts, lost = ({batch.noise.kind: 0 for batch in batches} for _ in range(2))
    judged, first = 0, None
    # One after the other: the physics takes all cores, and the rest holds the interpreter's lock.
    for batch in progress_bar(batches, "replays", "games"):
        run, again = play(game.task, certificate.controllers[name], batch)
        losing = np.flatnonzero(run.outcome != Outcome.REACHED)
        starts[batch.noise.kind] += len(run.outcome)
        lost[batch.noise.kind] += len(losing)
        judged += again
        if first is None and len(losing):
            at = losing[0]
            mode = None if batch.q0[at] == NOT_STARTED else int(batch.q0[at])
            outcome = Outcome(run.outcome[at]).label
            first = LostReplay(tuple(map(float, batch.z0[at])), mode, batch.noise.kind, outcome)
    return ReplayCount(name, score.eps, game.everywhere, of, starts, lost, judged, first)


def batches_of(
    certificate: Certificate, name: str, eps: float, of: str, few: int = 1
) -> list[Batch]:
    """Returns one in `few` of the `STARTS` of which something is said, with their noise.

    Of each kind of noise the first `WHOLE` episodes are played to their end. The others are until they are
    proved to have arrived for good.
    """
    rng, pools = np.random.default_rng(0), _pools(certificate, name, eps, of)
    batches = []
    for noise in _noises(certificate, name, eps):
        z0, q0, samples = _drawn(pools, STARTS[noise.kind] // few, rng)
        for first in (0, *range(WHOLE, len(z0), BATCH)):
            part = slice(first, first + BATCH if first else WHOLE)
            number = int(rng.integers(2**31))
            steps = samples[part] if first else None
            batches.append(Batch(noise, z0[part], q0[part], number, steps))
    return batches


def play(task: Task, controller: Controller, batch: Batch) -> tuple[Rollout, int]:
    """Plays a batch on the plant, and every twentieth run and all lost ones once more in plain MuJoCo.

    A batch is played to its end only if one of its runs has not arrived when that is proved.

    Returns:
        The runs, and the number of those that plain MuJoCo played.

    Raises:
        BadInput: the plant did not do what plain MuJoCo does.
    """
    plant = task.plant(len(batch.z0))
    for steps in (batch.steps, None):
        settings = LoopSettings(steps, record=True, states=False, plant=plant, quiet=True)
        run = closed_loop(task, controller, batch.z0, batch.noise, batch.q0, batch.seed, settings)
        judged = run.outcome != Outcome.REACHED
        if steps is None or not judged.any():
            break
    judged[::20] = True
    judge(task, run, task.state(batch.z0), np.flatnonzero(judged))
    return run, int(judged.sum())


def _noises(certificate: Certificate, name: str, eps: float) -> list[AnyNoise]:
    """Returns the noise signals that are known, the strongest last."""
    game = certificate.game
    simple = (Noise(kind, eps, game.everywhere) for kind in ("uniform", "alternating"))
    noises: list[AnyNoise] = [Noise(), *simple, game.worst_noise(name, eps)]
    if covers_sensor(game.task, eps):
        noises.append(Noise(SENSOR))
    if name in certificate.answers:
        noises.append(CellNoise(certificate, name, eps))
    return noises


@dataclass(frozen=True)
class _Pool:
    """The places of one start mode from which starts are drawn: cells, or nodes where there are no cells.

    Attributes:
        grid: the nodes.
        cells: the cells; None of nodes.
        q0: the start mode, `NOT_STARTED` if the controller picks it.
        border: (b,) places with a neighbour of which the same is not said.
        late: (l,) places, the latest to arrive first.
        counted: (c,) places that the score counts.
        samples: samples (N,) after which a run from each place is proved to have arrived for good, else
            those of an episode.
    """

    grid: Grid
    cells: Cells | None
    q0: int
    border: np.ndarray
    late: np.ndarray
    counted: np.ndarray
    samples: np.ndarray

    def draw(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """Returns n starts (n, d), anywhere in their cells, their modes (n,), and their samples (n,)."""
        weak = [rng.permutation(self.border)[: n // 3], self.late[: n // 3]]
        rest = rng.choice(self.counted, n - sum(map(len, weak)))
        places, q0 = np.concatenate([*weak, rest]), np.full(n, self.q0)
        samples = self.samples[places]
        z0 = self.cells.draw(places, rng) if self.cells else self.grid.nodes[places]
        return z0, q0, samples


def _pools(certificate: Certificate, name: str, eps: float, of: str) -> list[_Pool]:
    """Returns where starts are drawn, for each start mode of which something is said."""
    game, cells, region = certificate.game, certificate.cells, certificate.region(eps)
    if not region.any():  # a start region thinner than a cell
        cells, region = None, game.starts & game.winnable(eps)
    grid, rng, pools = game.lattice.grid, np.random.default_rng(0), []
    modes = start_modes(certificate.controllers[name])
    proved = of == "proved" and cells is not None
    values = (certificate if proved else game).value(name, eps)[:, :-2]
    if cells is not None and not proved:
        values = values[:, grid.nearest(cells.middle(np.arange(cells.nodes)))]
    for q0, value in zip(modes, values[-len(modes) :], strict=True):
        if cells is not None and proved:
            said = (value < NEVER) & cells.running
        else:
            said = region & (q0 == NOT_STARTED)
        if not said.any():
            continue
        weak = said
        if cells is not None:
            weak = said & ~cells.all_corners(cells.all_around(said | cells.arrived))
        places = rng.permutation(np.flatnonzero(said))
        late = places[np.argsort(-value[places], kind="stable")]
        counted = np.flatnonzero(said & region)
        border, counted = np.flatnonzero(weak), counted if len(counted) else places
        samples = np.maximum(value, 1) if proved else np.full(len(value), game.task.max_steps)
        pools.append(_Pool(grid, cells, q0, border, late, counted, samples))
    return pools


def _drawn(pools: list[_Pool], n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Returns n starts (n, d) as `_Pool.draw` does, as many from each pool, in any order."""
    each, rest = divmod(n, len(pools))
    drawn = [pool.draw(each + (i < rest), rng) for i, pool in enumerate(pools)]
    order = rng.permutation(n)
    return tuple(np.concatenate(parts)[order] for parts in zip(*drawn, strict=True))
