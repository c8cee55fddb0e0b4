"""Why a policy loses starts: also without noise, it cannot decide, or it passes closer than the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrl_mj.judging.game import NEVER, Game, curve_grid
from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.sets import GridSet, within_reach
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Losses:
    """The winnable starts that a policy loses in the worst-case game, by what would cure it.

    Attributes:
        unaided: (n, d) starts that are lost without noise, too. The others are won without noise.
        undecided: (n, d) starts that are won if the policy holds the way of its first measurement: noise
            makes it change its mind at M*. Hysteresis cures that.
        grazing: (n, d) starts that are lost all the same: on its way the policy comes so close to where it
            fails that noise does the rest. Training under noise cures that.
    """

    unaided: np.ndarray
    undecided: np.ndarray
    grazing: np.ndarray


def sort_losses(
    task: Task,
    policy: Policy,
    parts: Sequence[GridSet],
    pis: Sequence[Policy],
    eps: float,
    cells: int,
) -> Losses:
    """Sorts the winnable starts that a policy loses to the worst noise.

    Each part's policy pi_i (paper, Step 4) plays the game alone. A start is won by holding the way if all
    pi_i win that the first measurement can select.

    Args:
        task: the robot and its problem.
        policy: the policy, a function of the measurement.
        parts: M_i of each mode.
        pis: pi_i of each mode.
        eps: the noise bound.
        cells: lattice cells along the longest side, as in `curve_grid`.
    """
    loops = {f"part {i}": PolicyController(pi) for i, pi in enumerate(pis)}
    grid = curve_grid(task, cells)
    game = Game(task, parts, {"policy": PolicyController(policy), **loops}, eps, grid=grid)
    lost = game.starts & game.winnable(eps) & (game.value("policy", eps)[-1, :-2] >= NEVER)
    held = np.ones(len(lost), dtype=bool)
    window = np.ceil(game.bound(eps) / grid.spacing).astype(int)
    for name, side in zip(loops, game.limit.sides, strict=True):
        selected = within_reach(side.reshape(grid.counts), window, task.chart.periodic).ravel()
        held &= ~selected | (game.value(name, eps)[-1, :-2] < NEVER)
    nodes, alone = grid.nodes, game.value("policy", 0.0)[-1, :-2] >= NEVER
    return Losses(nodes[lost & alone], nodes[lost & ~alone & held], nodes[lost & ~alone & ~held])
