"""The worst-case game: measurement noise within a bound plays against the closed loop.

The plant is tabulated on a lattice of states, and the game is solved on it by backward recursion.
`Game` scores controllers, `Limit` is what any controller could win, and `examine` returns a `GameResult`.
"""

from hyrl_mj.game.lattice import LATTICE, Lattice
from hyrl_mj.game.limit import Limit, fewest_samples
from hyrl_mj.game.result import (
    BEATEN,
    LIMIT,
    MAP_CLASSES,
    OVER,
    UNWINNABLE,
    WON,
    WON_FROM_SOME,
    AttackCount,
    Curve,
    EpisodeCount,
    GameResult,
    Maps,
    Robustness,
    Score,
    Wins,
    percent,
)
from hyrl_mj.game.scores import LARGEST, Game, examine, worst_signal
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
    "AttackCount",
    "Curve",
    "EpisodeCount",
    "Game",
    "GameResult",
    "Lattice",
    "Limit",
    "Maps",
    "Moves",
    "Robustness",
    "Score",
    "Wins",
    "examine",
    "fewest_samples",
    "lasting",
    "noisy_moves",
    "percent",
    "solve",
    "worst_signal",
]
