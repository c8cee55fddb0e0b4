"""The worst-case game: what no measurement noise within a bound can make the closed loop do.

The plant is tabulated on a lattice of states, and the game is solved on it by backward recursion.
`Game` scores controllers, and `Limit` says what any controller could win.
"""

from hyrl_mj.game.lattice import LATTICE, Lattice
from hyrl_mj.game.limit import Limit, fewest_samples
from hyrl_mj.game.scores import (
    BEATEN,
    LARGEST,
    LIMIT,
    MAP_CLASSES,
    OVER,
    UNWINNABLE,
    WON,
    WON_FROM_SOME,
    Game,
    Score,
    examine,
    save,
    worst_signal,
)
from hyrl_mj.game.solver import LOST, NEVER, Answers, Moves, lasting, noisy_moves, solve

__all__ = [
    "BEATEN",
    "LARGEST",
    "LATTICE",
    "LIMIT",
    "LOST",
    "MAP_CLASSES",
    "NEVER",
    "OVER",
    "UNWINNABLE",
    "WON",
    "WON_FROM_SOME",
    "Answers",
    "Game",
    "Lattice",
    "Limit",
    "Moves",
    "Score",
    "examine",
    "fewest_samples",
    "lasting",
    "noisy_moves",
    "save",
    "scores",
    "solve",
    "worst_signal",
]
