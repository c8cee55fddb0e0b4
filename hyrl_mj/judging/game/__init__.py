"""The worst-case game: measurement noise within a bound plays against the closed loop.

The plant is tabulated on a lattice of states, and the game is solved on it by backward recursion.
`Game` scores controllers on the nodes, and `Limit` is what a split of the states could win.
"""

from hyrl_mj.judging.game.counts import (
    LATE,
    NO_NOISE,
    AttackCount,
    Comparison,
    Ends,
    EpisodeCount,
    LostReplay,
    ReplayCount,
    compare,
    wilson,
)
from hyrl_mj.judging.game.lattice import EPISODES_INSTEAD, Lattice, Places, nearest_of
from hyrl_mj.judging.game.limit import Limit, fewest_samples
from hyrl_mj.judging.game.resolution import (
    CURVE_CELLS,
    LATTICE,
    aligned_cells,
    curve_grid,
    lattice_grid,
)
from hyrl_mj.judging.game.result import (
    LIMIT,
    NEARLY,
    Curve,
    GameResult,
    LatticeSpacing,
    MapClass,
    Maps,
    NodeScore,
    Profile,
    Robustness,
    Score,
    WinningShares,
    percent,
)
from hyrl_mj.judging.game.scores import CURVE, LARGEST, Game, share, worst_signal
from hyrl_mj.judging.game.solver import (
    FIRST,
    LOST,
    NEVER,
    Answers,
    Moves,
    lasting,
    noisy_moves,
    solve,
)

__all__ = [
    "CURVE",
    "CURVE_CELLS",
    "EPISODES_INSTEAD",
    "FIRST",
    "LARGEST",
    "LATE",
    "LATTICE",
    "LIMIT",
    "LOST",
    "NEARLY",
    "NEVER",
    "NO_NOISE",
    "Answers",
    "AttackCount",
    "Comparison",
    "Curve",
    "Ends",
    "EpisodeCount",
    "Game",
    "GameResult",
    "Lattice",
    "LatticeSpacing",
    "Limit",
    "LostReplay",
    "MapClass",
    "Maps",
    "Moves",
    "NodeScore",
    "Places",
    "Profile",
    "ReplayCount",
    "Robustness",
    "Score",
    "WinningShares",
    "aligned_cells",
    "compare",
    "curve_grid",
    "fewest_samples",
    "lasting",
    "lattice_grid",
    "nearest_of",
    "noisy_moves",
    "percent",
    "share",
    "solve",
    "wilson",
    "worst_signal",
]
