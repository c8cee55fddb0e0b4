"""The certificate: what a controller wins from every state and under every noise signal within the bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hyrl_mj.judging.game import Game, Moves, Places, solve, won_in
from hyrl_mj.judging.proof.affine import Unbounded
from hyrl_mj.judging.proof.answers import BoundedAnswers
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.policies import Controller


@dataclass(frozen=True)
class Certificate:
    """The worst-case game on closed cells, with everything bounded against the controller.

    From a cell the adversary may take any measurement in the cell widened by the noise, with any answer that
    the controller can give there, and the cell moves onto all cells that it touches. What is won so is won
    from every state of the cell, under every noise signal within the bound.

    Attributes:
        game: the game on the nodes.
        controllers: by name.
        cells: the cells between them.
        answers: the bounded answers of the controllers that can be bounded, by name.
        why_not: for the other controllers, what stopped it.
    """

    game: Game
    controllers: Mapping[str, Controller]
    cells: Cells | None
    answers: Mapping[str, BoundedAnswers]
    why_not: Mapping[str, str]
    _values: dict[tuple[str, float], np.ndarray] = field(default_factory=dict, repr=False)

    @staticmethod
    def certify(game: Game, controllers: Mapping[str, Controller]) -> Certificate:
        """Returns the certificate of some controllers of a game."""
        answers, why_not = {}, dict[str, str]()
        if why := game.lattice.why_estimate(game.task):
            return Certificate(game, controllers, None, {}, dict.fromkeys(controllers, why))
        try:
            cells = Cells.cover(game.lattice)
        except Unbounded as error:
            why_not = dict.fromkeys(controllers, str(error))
            return Certificate(game, controllers, None, {}, why_not)
        for name, controller in controllers.items():
            try:
                answers[name] = BoundedAnswers.enclose(cells, controller, game.bound(game.largest))
            except Unbounded as error:
                why_not[name] = str(error)
        return Certificate(game, controllers, cells, answers, why_not)

    def moves(self, name: str, eps: float) -> Moves:
        """Returns the adversary's moves against a controller, from outside."""
        cells, bound = self.cells, self.game.bound(eps)
        assert cells is not None
        rows = []
        for row in self.answers[name].possible(bound):
            parts = []
            for mode, shift, reached in row:
                node = np.flatnonzero(reached & cells.running)
                parts.append((node, np.full(len(node), mode), cells.after(shift)[node]))
            rows.append(in_order(parts))
        return Moves.gather(cells, rows)

    def value(self, name: str, eps: float) -> np.ndarray:
        """Returns an upper bound of the value of the closed loop (modes + 1, places), as `Game.value`."""
        if (name, eps) not in self._values:
            moves, cells = self.moves(name, eps), self.cells
            assert cells is not None
            stays = staying(moves, cells, cells.success)
            self._values[name, eps] = solve(moves, self.game.task.max_steps, stays)
        return self._values[name, eps]

    def region(self, eps: float) -> np.ndarray:
        """Returns the winnable cells (N,) bool: those of the start region all of whose corners are winnable.

        Without cells these are the winnable nodes.
        """
        nodes = self.game.starts & self.game.winnable(eps)
        return nodes if self.cells is None else self.cells.all_corners(nodes)

    def wins(self, name: str, eps: float) -> tuple[float, float, float, float]:
        """Returns what is proved of a controller, as `won_in`; zeros where no cell is winnable."""
        return won_in(self.region(eps), self.value(name, eps)[:, :-2], self.game.task.dt)


def in_order(parts: Sequence[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a row of `Moves.gather` from parts of it: nodes (k,) in any order, modes (k,), places (k,)."""
    node, mode, ends = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    order = np.argsort(node, kind="stable")
    return node[order], mode[order], ends[order][:, None]


def staying(moves: Moves, places: Places, success: np.ndarray) -> np.ndarray:
    """Returns whether a run stays in places of success (N,) bool, or ends as one: (rows, N) bool."""
    over = np.append(places.arrived, [True, False])
    stays = np.append(success & ~places.arrived, [False, False])
    over, stays = (np.tile(mask, moves.rows) for mask in (over, stays))
    inside = np.zeros(stays.size, dtype=bool)
    inside[moves.state] = stays[moves.state]
    begin = np.append(0, np.cumsum(moves.counts)[:-1])
    while True:
        good = (inside | over)[moves.target]
        leaves = ~np.logical_and.reduceat(good, begin) & inside[moves.state]
        if not leaves.any():
            return inside.reshape(moves.rows, -1)[:, :-2]
        inside[moves.state[leaves]] = False
