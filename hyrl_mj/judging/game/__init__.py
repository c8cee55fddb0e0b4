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
from hyrl_mj.judging.game.lattice import Lattice, Places, nearest_of
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
    SensedScore,
    WinningShares,
    percent,
)
from hyrl_mj.judging.game.scores import CURVE, Game, largest_bound, share, won_in, worst_signal
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
