"""Hysteresis-Based RL on MuJoCo: learned policies that measurement noise cannot break at a decision.

`run` trains a policy and makes it robust, `robustify` starts from an agent, and `load_run` opens the result.
The stages between are `find_critical_set`, `make_partition`, `extend` and `HybridController`. Importing this
package needs neither torch nor a GL library.
"""

from importlib.metadata import version

import lazy_loader

from hyrl_mj.system import gl as gl  # first: imports mujoco, with a GL backend that exists here

# isort: split
import gymnasium

# What Gymnasium can make after `import hyrl_mj`: each task, its environment and its steps. They stand here,
# as those of Gymnasium do, so that the tasks are imported only where one is made; a test compares them.
for _task, _env, _steps in (
    ("arm", "Arm", 120),
    ("beam", "Beam", 64),
    ("field", "Field", 300),
    ("gaps", "Gaps", 70),
    ("gate", "Gate", 65),
    ("quadrotor", "Quadrotor", 80),
    ("rover", "Rover", 110),
    ("rover_field", "RoverField", 300),
    ("slalom", "Slalom", 90),
    ("unit_circle", "UnitCircle", 150),
    ("vehicle", "ObstacleAvoidance", 60),
):
    gymnasium.register(
        id=f"hyrl_mj/{_env}-v0",
        entry_point="hyrl_mj.gym_export.gym_env:TaskEnv",
        vector_entry_point="hyrl_mj.gym_export.gym_env:TaskVectorEnv",
        kwargs={"task": _task},
        max_episode_steps=_steps,
    )

__version__ = version("hyrl-mj")
# The names of `__init__.pyi`, each imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
