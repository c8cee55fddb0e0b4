"""Tasks: what a robot has to do, one file for each robot, named as its MJCF.

A task is a plant with a measurement, a chart, an observation, a reward, an end and starts. Every
file in this folder that defines a task is a task of the package.
"""

from importlib import import_module
from pkgutil import iter_modules

from hyrl_mj.tasks.base import Task, at_levels
from hyrl_mj.tasks.checks import check_task, hidden_goal, jumped_over, overlooked, torn
from hyrl_mj.tasks.description import (
    SEARCHES,
    SPARING,
    Abilities,
    Effort,
    FullState,
    Learning,
    Mirror,
    Outcome,
    Scene,
)
from hyrl_mj.tasks.field import CLEAR, FASTEST, PROJECTED, RADII, TAKEN, Field, FieldTask
from hyrl_mj.tasks.guard import check_finite, read_only, writes
from hyrl_mj.tasks.layouts import POSE, Layouts, only_post, posts_of
from hyrl_mj.tasks.motion import largest_moves, stands_still
from hyrl_mj.tasks.obstacles import (
    ANY,
    LEFT,
    RIGHT,
    length,
    number_of,
    pattern_of,
    sides,
    touching,
    way_name,
    wrapped,
)
from hyrl_mj.tasks.registry import (
    ENVIRONMENT,
    check_as_made,
    described_task,
    get_task,
    is_of_this_package,
    reference,
    register,
    task_names,
)
from hyrl_mj.tasks.scaffold import write_task
from hyrl_mj.tasks.trial import try_elsewhere

__all__ = [
    "ANY",
    "CLEAR",
    "ENVIRONMENT",
    "FASTEST",
    "LEFT",
    "POSE",
    "PROJECTED",
    "RADII",
    "RIGHT",
    "SEARCHES",
    "SPARING",
    "TAKEN",
    "Abilities",
    "Effort",
    "Field",
    "FieldTask",
    "FullState",
    "Layouts",
    "Learning",
    "Mirror",
    "Outcome",
    "Scene",
    "Task",
    "at_levels",
    "check_as_made",
    "check_finite",
    "check_task",
    "described_task",
    "get_task",
    "hidden_goal",
    "is_of_this_package",
    "jumped_over",
    "largest_moves",
    "length",
    "number_of",
    "only_post",
    "overlooked",
    "pattern_of",
    "posts_of",
    "read_only",
    "reference",
    "register",
    "sides",
    "stands_still",
    "task_names",
    "torn",
    "touching",
    "try_elsewhere",
    "way_name",
    "wrapped",
    "write_task",
    "writes",
]

for _module in iter_modules(__path__, f"{__name__}."):
    import_module(_module.name)
