"""The worst-case game: measurement noise within a bound plays against the closed loop.

The plant is tabulated on a lattice of states, and the game is solved on it by backward recursion.
`Game` scores controllers on the nodes, and `Limit` is what a split of the states could win.
"""

from hyrl_mj.game.adversary import WorstNoise
from hyrl_mj.game.counts import (
    PROVED_STARTS,
    WON_STARTS,
    AttackCount,
    EpisodeCount,
    LostReplay,
    ReplayCount,
)
from hyrl_mj.game.lattice import EPISODES_INSTEAD, Lattice, nearest_of
from hyrl_mj.game.limit import Limit, fewest_samples
from hyrl_mj.game.resolution import CURVE_CELLS, LATTICE, aligned_cells, curve_grid, lattice_grid
from hyrl_mj.game.result import (
    BEATEN,
    LIMIT,
    MAP_CLASSES,
    NEARLY,
    OVER,
    UNCLEAR,
    UNWINNABLE,
    WON,
    WON_FROM_SOME,
    Curve,
    GameResult,
    LatticeSpacing,
    Maps,
    NodeScore,
    Profile,
    Robustness,
    Score,
    Wins,
    percent,
)
from hyrl_mj.game.scores import CURVE, LARGEST, Game, share, worst_signal
from hyrl_mj.game.solver import (
    FIRST,
    LOST,
    NEVER,
    Answers,
    Moves,
    Places,
    lasting,
    noisy_moves,
    solve,
)

__all__ = [
    "BEATEN",
    "CURVE",
    "CURVE_CELLS",
    "EPISODES_INSTEAD",
    "FIRST",
    "LARGEST",
    "LATTICE",
    "LIMIT",
    "LOST",
    "MAP_CLASSES",
    "NEARLY",
    "NEVER",
    "OVER",
    "PROVED_STARTS",
    "UNCLEAR",
    "UNWINNABLE",
    "WON",
    "WON_FROM_SOME",
    "WON_STARTS",
    "Answers",
    "AttackCount",
    "Curve",
    "EpisodeCount",
    "Game",
    "GameResult",
    "Lattice",
    "LatticeSpacing",
    "Limit",
    "LostReplay",
    "Maps",
    "Moves",
    "NodeScore",
    "Places",
    "Profile",
    "ReplayCount",
    "Robustness",
    "Score",
    "Wins",
    "WorstNoise",
    "aligned_cells",
    "curve_grid",
    "fewest_samples",
    "lasting",
    "lattice_grid",
    "nearest_of",
    "noisy_moves",
    "percent",
    "share",
    "solve",
    "worst_signal",
]
