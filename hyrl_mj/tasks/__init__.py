"""The robots: one file each, named as its MJCF. A file that lies here is a task of the package."""

from importlib import import_module
from pkgutil import iter_modules

from hyrl_mj.tasks.base import Mirror, Outcome, Task, passing_side
from hyrl_mj.tasks.chart import Chart
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
]

for _module in iter_modules(__path__, f"{__name__}."):
    import_module(_module.name)
