"""The pipeline: runs the stages in order, each of which fills its part of a run directory.

`run`, `robustify` and `diagnose` make a whole run; `run_stage` runs one stage again from what is on disk.
"""

from hyrl_mj.pipeline.examination import examine_run
from hyrl_mj.pipeline.options import AgentOptions, ExamineOptions, RunOptions
from hyrl_mj.pipeline.runs import diagnose, extend_again, robustify, run
from hyrl_mj.pipeline.steps import run_stage

__all__ = [
    "AgentOptions",
    "ExamineOptions",
    "RunOptions",
    "diagnose",
    "examine_run",
    "extend_again",
    "robustify",
    "run",
    "run_stage",
]
