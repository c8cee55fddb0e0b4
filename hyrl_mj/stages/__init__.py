"""The stages of HyRL after training (paper, Section IV-C): a function and a result for each.

Stage 2 is `find_critical_set`, stage 3 `make_partition`, stages 4 and 5 `extend`, and stage 6
`retraining.retrain`. `retraining` and `grounds` import torch: import them where needed. Stage 7 is
`policies.HybridController`.
"""

from hyrl_mj.stages.critical_set import CriticalSet, critical_points, find_critical_set
from hyrl_mj.stages.extended_sets import ExtendedSets, extend, held_inputs
from hyrl_mj.stages.partition import (
    Partition,
    PartPolicy,
    boundary,
    make_partition,
    open_ways,
    part_policies,
    with_room,
)
from hyrl_mj.stages.tables import HeldInputs, TablePolicy, table_for

__all__ = [
    "CriticalSet",
    "ExtendedSets",
    "HeldInputs",
    "PartPolicy",
    "Partition",
    "TablePolicy",
    "boundary",
    "critical_points",
    "extend",
    "find_critical_set",
    "grounds",
    "held_inputs",
    "make_partition",
    "open_ways",
    "part_policies",
    "retraining",
    "table_for",
    "with_room",
]
