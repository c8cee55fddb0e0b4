"""Hysteresis-Based RL on MuJoCo: learned policies that measurement noise cannot break at a decision.

`run` trains a policy and makes it robust, `robustify` starts from an agent, and `load_run` opens the result.
The stages between are `find_critical_set`, `make_partition`, `extend` and `HybridController`. Importing this
package needs neither torch nor a GL library.
"""

from hyrl_mj import gl as gl  # first: imports mujoco, with a GL backend that exists here
from hyrl_mj.chart import Chart
from hyrl_mj.cores import using_pool
from hyrl_mj.environments import from_gymnasium
from hyrl_mj.errors import BadArtifact, BadInput, HyrlError, NoRenderer
from hyrl_mj.export import export_numpy, export_onnx
from hyrl_mj.game import Game, Robustness, Score
from hyrl_mj.learning import Settings
from hyrl_mj.pipeline import AgentOptions, RunOptions, SweepOptions, diagnose, robustify, run, sweep
from hyrl_mj.policies import Controller, MlpPolicy, Policy, from_callable, load_agent
from hyrl_mj.run_directory import Run, load_run
from hyrl_mj.sets import StateSet
from hyrl_mj.simulation import (
    HybridArc,
    LoopSettings,
    Noise,
    Recorded,
    Sample,
    Signal,
    closed_loop,
    register_noise,
    simulate,
    simulate_batch,
)
from hyrl_mj.stages import (
    CriticalSet,
    ExtendedSets,
    HybridController,
    Partition,
    extend,
    find_critical_set,
    make_partition,
)
from hyrl_mj.tasks import Learning, Mirror, Outcome, Scene, Task, get_task, register, task_names
from hyrl_mj.verdict import Verdict

__version__ = "0.1.0"
__all__ = [
    "AgentOptions",
    "BadArtifact",
    "BadInput",
    "Chart",
    "Controller",
    "CriticalSet",
    "ExtendedSets",
    "Game",
    "HybridArc",
    "HybridController",
    "HyrlError",
    "Learning",
    "LoopSettings",
    "Mirror",
    "MlpPolicy",
    "NoRenderer",
    "Noise",
    "Outcome",
    "Partition",
    "Policy",
    "Recorded",
    "Robustness",
    "Run",
    "RunOptions",
    "Sample",
    "Scene",
    "Score",
    "Settings",
    "Signal",
    "StateSet",
    "SweepOptions",
    "Task",
    "Verdict",
    "closed_loop",
    "diagnose",
    "export_numpy",
    "export_onnx",
    "extend",
    "find_critical_set",
    "from_callable",
    "from_gymnasium",
    "get_task",
    "load_agent",
    "load_run",
    "make_partition",
    "register",
    "register_noise",
    "robustify",
    "run",
    "simulate",
    "simulate_batch",
    "sweep",
    "task_names",
    "using_pool",
]
