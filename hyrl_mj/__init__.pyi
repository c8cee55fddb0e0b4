from . import (
    alternatives as alternatives,
    export as export,
    fields as fields,
    gym_export as gym_export,
    gym_import as gym_import,
    judging as judging,
    learning as learning,
    physics as physics,
    pipeline as pipeline,
    policies as policies,
    runs as runs,
    sets as sets,
    simulation as simulation,
    stages as stages,
    tasks as tasks,
    viz as viz,
)
from .errors import BadArtifact, BadInput, HyrlError, NoRenderer
from .export import export_numpy, export_onnx
from .gym_import import from_gymnasium
from .judging import Verdict
from .judging.game import Game, Robustness, Score
from .learning import Settings
from .physics import mjcf as mjcf
from .pipeline import (
    AgentOptions,
    CompareOptions,
    RunOptions,
    SweepOptions,
    compare,
    diagnose,
    robustify,
    run,
    sweep,
)
from .policies import Controller, HybridController, MlpPolicy, Policy, from_callable, load_agent
from .sets import Chart, StateSet
from .simulation import (
    HybridArc,
    LoopSettings,
    Noise,
    Recorded,
    Sample,
    Sensor,
    Signal,
    closed_loop,
    noise_from_log,
    register_noise,
    simulate,
    simulate_batch,
)
from .stages import (
    CriticalSet,
    ExtendedSets,
    Partition,
    extend,
    find_critical_set,
    make_partition,
)
from .system import gl as gl
from .system.cores import using_pool
from .tasks import Learning, Mirror, Outcome, Scene, Task, get_task, register, task_names
from .viz.figures.vector_field import vector_field
from .viz.notebook import Run, load_run

__version__: str
__all__ = [
    "AgentOptions",
    "BadArtifact",
    "BadInput",
    "Chart",
    "CompareOptions",
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
    "Sensor",
    "Settings",
    "Signal",
    "StateSet",
    "SweepOptions",
    "Task",
    "Verdict",
    "closed_loop",
    "compare",
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
    "noise_from_log",
    "register",
    "register_noise",
    "robustify",
    "run",
    "simulate",
    "simulate_batch",
    "sweep",
    "task_names",
    "using_pool",
    "vector_field",
]
