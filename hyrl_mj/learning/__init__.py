"""Learning: the settings of a run, and the training of policies with Stable-Baselines3.

The modules `training`, `distillation` and `symmetry` import torch: import them only where they are needed.
"""

from hyrl_mj.learning.changes import STAGES, changed, changes, differing, setting_value
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.settings import (
    ModeSettings,
    OverlapSettings,
    Settings,
    TableSettings,
    Training,
    WaySettings,
)

__all__ = [
    "STAGES",
    "ModeSettings",
    "OverlapSettings",
    "Settings",
    "TableSettings",
    "Training",
    "WaySettings",
    "changed",
    "changes",
    "differing",
    "distillation",
    "preset",
    "presets",
    "setting_value",
    "symmetry",
    "to_go",
    "training",
]
