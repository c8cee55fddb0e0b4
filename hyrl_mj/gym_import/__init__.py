"""Environments of others as tasks: any environment of Gymnasium that MuJoCo simulates, as it is."""

from hyrl_mj.gym_import.making import (
    EnvironmentOptions,
    chosen_task,
    explained,
    from_gymnasium,
)
from hyrl_mj.gym_import.task import EnvironmentTask

__all__ = [
    "EnvironmentOptions",
    "EnvironmentTask",
    "chosen_task",
    "explained",
    "from_gymnasium",
]
