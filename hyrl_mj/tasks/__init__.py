"""The robots: one file each, named as its MJCF."""

from hyrl_mj.tasks import unit_circle, vehicle
from hyrl_mj.tasks.base import Chart, Mirror, Outcome, Task, passing_side
from hyrl_mj.tasks.registry import get_task, register, task_names

__all__ = [
    "Chart",
    "Mirror",
    "Outcome",
    "Task",
    "get_task",
    "passing_side",
    "register",
    "task_names",
    "unit_circle",
    "vehicle",
]
