"""Environments of others as tasks: any environment of Gymnasium that MuJoCo simulates, as it is.

`making` takes what the user says, and `opening` makes environments of it. An `instance` plays episodes from
start to end; a `stage` holds the instances of one process, a `pool` has the processes, and the `plant` of a
`task` plays n runs. `inspection` finds out what the environment is like (`coordinates`, `expressions`) before
anything rests on it. What could mislead is looked for in one place each:

- `draws`: what resets draw, which has to be pinned;
- `trials`: whether what is observed follows the state, and whether episodes go as those of a new environment,
  by the judges of `stage`, which also judge the runs of agents later, and look for ways on which wrappers
  are told the place past the noise;
- `starts`: whether a start elsewhere on the chart is as one that a reset would lead to.

They share what 64 `resets` lead to, numbers in `attributes`, and the `fingerprint` of all that is remembered.
"""

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
