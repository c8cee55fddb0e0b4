"""The stages of HyRL after training (paper, Section IV-C): a function and a result for each.

Stage 2 is `find_critical_set`, stage 3 `make_partition`, stages 4 and 5 `extend`, stage 6
`retraining.retrain`, and stage 7 `HybridController`. `retraining` and `grounds` import torch: import them
where needed.
"""

from hyrl_mj.stages.attacks import Attack, Budget, attack, attack_starts, shown_arcs
from hyrl_mj.stages.critical_set import CriticalSet, critical_points, find_critical_set
from hyrl_mj.stages.episodes import NoisyEpisodes, Regions, noisy_episodes
from hyrl_mj.stages.extended_sets import ExtendedSets, extend
from hyrl_mj.stages.hybrid import ON_EDGE, HybridController
from hyrl_mj.stages.losses import Losses, sort_losses
from hyrl_mj.stages.partition import (
    Partition,
    PartPolicy,
    boundary,
    make_partition,
    part_policy,
    with_room,
)
from hyrl_mj.stages.results import Arrivals, ModeResult, Retraining
from hyrl_mj.stages.tables import BoundTable, HeldInputs, TableOf, TablePolicy, table_for

__all__ = [
    "ON_EDGE",
    "Arrivals",
    "Attack",
    "BoundTable",
    "Budget",
    "CriticalSet",
    "ExtendedSets",
    "HeldInputs",
    "HybridController",
    "Losses",
    "ModeResult",
    "NoisyEpisodes",
    "PartPolicy",
    "Partition",
    "Regions",
    "Retraining",
    "TableOf",
    "TablePolicy",
    "attack",
    "attack_starts",
    "boundary",
    "critical_points",
    "extend",
    "find_critical_set",
    "grounds",
    "make_partition",
    "noisy_episodes",
    "part_policy",
    "retraining",
    "shown_arcs",
    "sort_losses",
    "table_for",
    "with_room",
]
