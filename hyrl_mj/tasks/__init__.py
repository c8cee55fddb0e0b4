"""Tasks: what a robot has to do, one file for each robot, named as its MJCF.

A task is a plant with a measurement, a chart, an observation, a reward, an end and starts. Every
file in this folder that defines a task is a task of the package.
"""

from importlib import import_module
from pkgutil import iter_modules

from hyrl_mj.tasks.base import SEARCHES, Mirror, Outcome, Task, passing_side
from hyrl_mj.tasks.checks import check_task
from hyrl_mj.tasks.registry import get_task, register, task_names
from hyrl_mj.tasks.scaffold import write_task

__all__ = [
    "SEARCHES",
    "Mirror",
    "Outcome",
    "Task",
    "check_task",
    "get_task",
    "passing_side",
    "register",
    "task_names",
    "write_task",
]

for _module in iter_modules(__path__, f"{__name__}."):
    import_module(_module.name)
