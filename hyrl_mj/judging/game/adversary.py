"""The noise of the game's adversary, for simulations."""

from __future__ import annotations

from itertools import product

import numpy as np

from hyrl_mj.judging.game.lattice import Lattice, nearest_of
from hyrl_mj.judging.game.solver import (
    AT_ONCE,
    FIRST,
    LOST,
    NEVER,
    Answers,
    nodes_within,
    noisy_moves,
    solve,
)
from hyrl_mj.simulation import NOT_STARTED, Lookahead, Sample, Signal
from hyrl_mj.tasks import Outcome


class WorstNoise(Signal):
    """The noise of the game's adversary (bounds (d,)) against a controller's answers, for simulations.

    Where possible, it avoids measurements on the very border of two answers, where rounding errors of the
    plant could let a run escape.
    """

    kind = "worst"
    needs_controller = True

    def __init__(self, answers: Answers, bound: np.ndarray):
        largest = float(bound.max(initial=0.0))
        super().__init__(largest, bound / (largest or 1.0))
        self._answers, self._bound = answers, bound
        self._any = solve(noisy_moves(answers, bound))
        self._settled = solve(noisy_moves(answers, bound, settled_only=True))
        window = nodes_within(answers.lattice, bound)
        shifts = np.array(list(product(*[range(-w, w + 1) for w in window])))
        # Among equals the largest noise comes first, for states between the nodes.
        self._shifts = shifts[np.argsort(-np.abs(shifts).sum(axis=1), kind="stable")]
        # For every row and node the number of the worst shift, -1 where it has not been needed yet.
        self._worst = np.full((len(answers.index), answers.lattice.nodes), -1, dtype=np.int32)

    def sample(self, now: Sample) -> np.ndarray:
        answers, grid = self._answers, self._answers.lattice.grid
        true, modes = now.measurement, answers.modes
        place = grid.nearest(true)
        row = np.where(now.q == NOT_STARTED, len(modes), np.searchsorted(modes, now.q))
        unknown = self._worst[row, place] < 0
        states = np.unique(row[unknown] * answers.lattice.nodes + place[unknown])
        few = max(AT_ONCE // len(self._shifts), 1)
        for i in range(0, len(states), few):
            rows, places = np.divmod(states[i : i + few], answers.lattice.nodes)
            self._worst[rows, places] = self._find(rows, places)
        at = np.stack(np.unravel_index(place, grid.counts), axis=-1)
        measured = grid.chart.low + grid.spacing * (at + self._shifts[self._worst[row, place]])
        noise = grid.chart.difference(measured, grid.chart.wrap(true))
        return np.clip(noise, -self._bound, self._bound)

    def _find(self, row: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Returns the numbers (n,) of the worst shifts at nodes `place` (n,), in rows (n,)."""
        answers, lattice = self._answers, self._answers.lattice
        grid, modes = lattice.grid, answers.modes
        near = np.stack(np.unravel_index(place, grid.counts), axis=-1)[:, None] + self._shifts
        node = np.where(grid.chart.periodic, near % grid.counts, near + answers.pad)
        entry = (row[:, None], *np.moveaxis(node, -1, 0))
        level, mode = np.divmod(answers.index[entry], len(modes))
        ends = mode[..., None], lattice.after[level, :, place[:, None]]
        value, settled = self._any[ends].max(axis=-1), self._settled[ends].max(axis=-1)
        counts = answers.settled[entry] | (self._shifts == 0).all(axis=1)
        value = np.where(counts & (settled >= NEVER), FIRST + settled, value)
        return np.asarray(value.argmax(axis=1))


class WorstEstimate(Lookahead):
    """Noise that leads to the state with the worst value of the game, interpolated between the nodes.

    Rounding to nodes, by which the game is an estimate, would mislead noise that follows the nodes.

    Args:
        lattice: the nodes.
        modes: the controller's modes.
        value: (modes + 1, places) value of the game, from `solve`.
        bound: (d,) noise bounds.
    """

    kind = "worst"
    farthest = 1

    def __init__(
        self, lattice: Lattice, modes: tuple[int, ...], value: np.ndarray, bound: np.ndarray
    ):
        largest = float(bound.max(initial=0.0))
        shares = np.zeros(lattice.task.measurement_columns)
        shares[: len(bound)] = bound / (largest or 1.0)
        super().__init__(largest, shares)
        self._lattice, self._modes = lattice, modes
        # Between 0 and 1 if won, the later the greater; from 2 to 3 if lost, the earlier the greater.
        samples = np.where(value > NEVER, LOST - value, value) / lattice.task.max_steps
        worth = [3 - samples, samples]
        self._worth = np.select([value > NEVER, value < NEVER], worth, 1.5)[:, :-2]
        if (
            lattice.task.abilities.stopped_by_walls
        ):  # beside a wall, what lies inside of it is not worse
            self._worth = self._worth[:, nearest_of(lattice.grid, lattice.running)]

    def _ahead(self, state: np.ndarray, answers: np.ndarray, memory: np.ndarray) -> np.ndarray:
        task, grid = self._lattice.task, self._lattice.grid
        plant, rows = self._placed(state), np.arange(len(state))
        plant.step(answers[:, :-1], rows)
        measured = plant.measurement[rows]
        lost = task.failed(measured) | ~grid.chart.contains(task.z(measured))
        worth = np.full(len(rows), np.inf)
        for mode, values in zip(self._modes, self._worth, strict=False):
            at = (answers[:, -1] == mode) & ~lost
            worth[at] = grid.interpolate(values, task.z(measured[at]))
        return np.where(task.ending(measured) == Outcome.REACHED, 0.0, worth)
