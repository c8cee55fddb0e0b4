"""Tasks written for hyrl_mj 0.1: one sentence that lists what to rename to what."""

from __future__ import annotations

import inspect
import sys

from hyrl_mj.errors import BadInput
from hyrl_mj.tasks.base import Task

# Attributes of a task in 0.1, and where each is now.
SCENE = {
    "replay_starts": "starts",
    "replay_time": "time",
    "policy_starts": "policy_starts",
    "mode_names": "mode_names",
}
LEARNING = {
    "levels": "levels",
    "algorithm": "algorithm",
    "search": "search",
    "horizon": "horizon",
}


def check_current(task: Task | type[Task]) -> None:
    """Raise `BadInput` where a task, or its class, has attributes or a reward as in 0.1."""
    kind = task if isinstance(task, type) else type(task)
    bases = [vars(base) for base in kind.__mro__ if issubclass(base, Task) and base is not Task]
    own = set(vars(task)).union(*bases)
    changes = [
        f"{', '.join(old)} -> {attribute} = hyrl_mj.{value}({', '.join(new[o] + '=...' for o in old)})"
        for attribute, value, new in (
            ("scene", "Scene", SCENE),
            ("learning", "Learning", LEARNING),
        )
        if (old := [name for name in new if name in own])
    ]
    try:
        inspect.signature(kind.reward).bind("self", "measurement", "u")
    except TypeError:
        changes.append("reward(self, measurement) -> reward(self, measurement, u)")
    if changes:
        file = getattr(sys.modules.get(kind.__module__), "__file__", None)
        raise BadInput(
            f"the task {getattr(kind, 'name', kind.__name__)} of {file or kind.__module__} was written for "
            f"hyrl_mj 0.1: rename {'; '.join(changes)}"
        )
