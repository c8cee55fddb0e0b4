"""The attack on what is not proved: noise signals that really beat a controller, each tried on the plant."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from hyrl_mj.judging.game import FIRST, NEVER, Game
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.judging.proof.certificate import Certificate
from hyrl_mj.policies import Controller
from hyrl_mj.simulation import (
    NOT_STARTED,
    AnyNoise,
    LoopSettings,
    Noise,
    Sample,
    Signal,
    closed_loop,
)
from hyrl_mj.tasks import Outcome

# Cells without a verdict in which a start is attacked, for each start mode.
MOST_CELLS = 128


@dataclass(frozen=True)
class Broken:
    """The starts from which a controller was really beaten.

    Attributes:
        own: (N,) bool, cells with such a start if the controller picks its start mode; nodes without cells.
        some: (N,) bool, as `own`, from some start mode.
        tried: (N,) bool, cells or nodes that were examined.
    """

    own: np.ndarray
    some: np.ndarray
    tried: np.ndarray


def find_counterexamples(certificate: Certificate, name: str, eps: float) -> Broken:
    """Attacks a controller where it may lose, and returns where it lost.

    From the nodes that are lost in the game its adversary gives the noise. Where the game is an estimate, as
    many nodes as the task's effort says are attacked, won or lost, and adversarial noise is tried, too. Cells
    that are neither proved nor lost at a corner, up to `MOST_CELLS` of them for each start mode, are attacked
    from a start inside: at each sample the noise tries measurements in its range, and takes the answer that
    leads to the worst state.

    Args:
        certificate: what is proved.
        name: the name of the controller.
        eps: the noise bound.
    """
    game, cells, controller = certificate.game, certificate.cells, certificate.controllers[name]
    modes = np.array(start_modes(controller))
    value, rng = game.value(name, eps), np.random.default_rng(0)
    region = game.starts & game.winnable(eps)
    attacked, tried = value[-len(modes) :, :-2] >= NEVER, region
    estimate = game.lattice.estimate or cells is None
    if estimate:
        tried, every = np.zeros_like(region), np.flatnonzero(region)
        count = min(len(every), game.task.effort.nodes)
        tried[rng.choice(every, count, replace=False)] = True
        attacked = np.ones_like(attacked)
    attacked &= tried
    noises: list[AnyNoise] = [game.worst_noise(name, eps)] if attacked.any() else []
    if noises and estimate and game.task.effort.looks_ahead:
        noises.append(Noise("adversarial", eps, game.everywhere))
    nodes = np.zeros_like(attacked)
    for noise in noises:
        row, at = np.nonzero(attacked & ~nodes)
        starts = game.lattice.grid.nodes[at]
        nodes[row, at] = beaten(game, controller, starts, modes[row], noise)
    if cells is None:
        return Broken(nodes[-1], np.asarray(nodes.any(axis=0)), tried)
    broken = np.stack([cells.some_corner(row) for row in nodes])
    if name in certificate.answers:
        outer, inside = certificate.value(name, eps), CellNoise(certificate, name, eps)
        unclear = (outer[-len(modes) :, :-2] >= NEVER) & certificate.region(eps) & ~broken
        chosen = [_inside(cells, np.flatnonzero(of_mode), rng) for of_mode in unclear]
        at, starts = (np.concatenate(parts) for parts in zip(*chosen, strict=True))
        row = np.repeat(np.arange(len(chosen)), [len(some) for some, _ in chosen])
        broken[row, at] = beaten(game, controller, starts, modes[row], inside)
    all_cells = np.ones(cells.nodes, dtype=bool)
    return Broken(broken[-1], np.asarray(broken.any(axis=0)), all_cells)


def start_modes(controller: Controller) -> tuple[int, ...]:
    """Returns the modes in which a run may start; `NOT_STARTED` if the controller picks it, the last."""
    # With one mode the controller cannot pick another one.
    return (*(controller.modes if len(controller.modes) > 1 else ()), NOT_STARTED)


def _inside(
    cells: Cells, of_mode: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns up to `MOST_CELLS` of some cells (n,), and a point inside of each: (k,), (k, d)."""
    count = min(len(of_mode), MOST_CELLS)
    at = rng.choice(of_mode, count, replace=False) if count else of_mode
    return at, cells.draw(at, rng)


def beaten(
    game: Game, controller: Controller, starts: np.ndarray, modes: np.ndarray, noise: AnyNoise
) -> np.ndarray:
    """Returns from which starts (n, d), in modes (n,), the noise beats the controller: (n,) bool."""
    if not len(starts):
        return np.zeros(0, dtype=bool)
    settings = LoopSettings(quiet=True)
    run = closed_loop(game.task, controller, starts, noise, modes, settings=settings)
    return np.asarray(run.outcome != Outcome.REACHED)


class CellNoise(Signal):
    """Noise that looks one sample ahead, and leads to the worst state.

    Worst is a state that is lost at the nearest node, then one that is not proved, then the latest to arrive.

    Args:
        certificate: gives the cells, and its value beside that of the game on nodes.
        name: the controller that it acts against.
        eps: noise bound.
    """

    kind = "cells"
    needs_controller = True

    def __init__(self, certificate: Certificate, name: str, eps: float):
        assert certificate.cells is not None
        bound = certificate.game.bound(eps)
        largest = float(bound.max())
        super().__init__(largest, bound / (largest or 1.0))
        self._cells, self._controller = certificate.cells, certificate.controllers[name]
        self._outer, self._inner = certificate.value(name, eps), certificate.game.value(name, eps)
        # So many measurements along each noisy coordinate the noise between the nodes chooses from.
        steps = [np.linspace(-b, b, 17 if b else 1) for b in bound]
        candidates = np.array([*product(*steps)])
        # Among equals the largest noise comes first.
        self._candidates = candidates[np.argsort(-np.abs(candidates).sum(axis=1), kind="stable")]

    def sample(self, now: Sample) -> np.ndarray:
        noise = np.zeros_like(now.measurement)
        running = self._cells.lattice.task.ending(now.measurement) == Outcome.RUNNING
        noise[running] = self._worst(now.measurement[running], now.q[running])
        return noise

    def _worst(self, true: np.ndarray, modes: np.ndarray) -> np.ndarray:
        """Returns the worst of the candidates in true states (n, d) and modes (n,): (n, d)."""
        cells, k = self._cells, len(self._candidates)
        measured = (true[:, None] + self._candidates).reshape(-1, true.shape[1])
        q = np.repeat(modes, k)
        fresh = q == NOT_STARTED
        if fresh.any():
            q[fresh] = self._controller.initial_mode(measured[fresh])
        u, after = self._controller.step(q, measured)
        ends = np.repeat(true, k, axis=0) + u @ cells.slope.T + cells.offset
        mode = np.searchsorted(self._controller.modes, after)
        node = cells.lattice.grid.nearest(ends)
        inner = self._inner[mode, node]
        outer = self._outer[mode, cells.place(ends)]
        worst = np.where((inner > NEVER) & (outer >= NEVER), FIRST + inner, outer)
        return self._candidates[worst.reshape(-1, k).argmax(axis=1)]
