"""The noise of the adversary where the game is an estimate: it looks a sample ahead with the plant itself."""

import numpy as np

from hyrl_mj.game.lattice import Lattice
from hyrl_mj.game.solver import LOST, NEVER
from hyrl_mj.simulation.lookahead import BATCH, Lookahead
from hyrl_mj.tasks import Outcome


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

    def __init__(
        self, lattice: Lattice, modes: tuple[int, ...], value: np.ndarray, bound: np.ndarray
    ):
        largest = float(bound.max(initial=0.0))
        super().__init__(largest, bound / (largest or 1.0))
        self._lattice, self._modes = lattice, modes
        # Between 0 and 1 if won, the later the greater; from 2 to 3 if lost, the earlier the greater.
        samples = np.where(value > NEVER, LOST - value, value) / lattice.task.max_steps
        worth = [3 - samples, samples]
        self._worth = np.select([value > NEVER, value < NEVER], worth, 1.5)

    def _danger(
        self, qpos: np.ndarray, qvel: np.ndarray, answers: np.ndarray, past: np.ndarray
    ) -> np.ndarray:
        task, grid = self._lattice.task, self._lattice.grid
        ahead = self._ahead = self._ahead or task.plant(BATCH)
        rows = np.arange(len(answers))
        ahead.set_state(qpos, qvel, rows)
        ahead.step(answers[:, :-1], rows)
        measured = ahead.measurement[rows]
        worth = np.full(len(rows), np.inf)
        for mode, values in zip(self._modes, self._worth, strict=False):
            at = (answers[:, -1] == mode) & ~task.failed(measured)
            worth[at] = grid.interpolate(values[:-2], task.z(measured[at]))
        return np.where(task.ending(measured) == Outcome.REACHED, 0.0, worth)
