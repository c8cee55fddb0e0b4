"""Tasks: what a robot has to do, one file for each robot, named as its MJCF.

A task is a plant with a measurement, a chart, an observation, a reward, an end and starts. Every
file in this folder that defines a task is a task of the package.
"""

from importlib import import_module
from pkgutil import iter_modules

from hyrl_mj.tasks.base import Mirror, Outcome, Task, at_levels
from hyrl_mj.tasks.checks import check_task
from hyrl_mj.tasks.learning import SEARCHES, Learning
from hyrl_mj.tasks.registry import get_task, reference, register, task_names
from hyrl_mj.tasks.scaffold import write_task
from hyrl_mj.tasks.scene import Scene
from hyrl_mj.tasks.ways import passing_side

__all__ = [
    "SEARCHES",
    "Learning",
    "Mirror",
    "Outcome",
    "Scene",
    "Task",
    "at_levels",
    "check_task",
    "get_task",
    "passing_side",
    "reference",
    "register",
    "task_names",
    "write_task",
]

for _module in iter_modules(__path__, f"{__name__}."):
    import_module(_module.name)
