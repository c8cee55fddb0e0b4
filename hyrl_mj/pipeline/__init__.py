"""The pipeline: runs the stages in order; each fills its part of a run directory.

`run`, `robustify` and `diagnose` make a whole run; `run_stage` runs one stage again from the files on disk.
"""

from hyrl_mj.judging import ExamineOptions
from hyrl_mj.pipeline.comparing import CompareOptions, compare
from hyrl_mj.pipeline.runs import AgentOptions, RunOptions, diagnose, extend_again, robustify, run
from hyrl_mj.pipeline.steps import as_stage, examine_run, run_stage
from hyrl_mj.pipeline.sweeping import SweepOptions, report, sweep

__all__ = [
    "AgentOptions",
    "CompareOptions",
    "ExamineOptions",
    "RunOptions",
    "SweepOptions",
    "as_stage",
    "compare",
    "diagnose",
    "examine_run",
    "extend_again",
    "report",
    "robustify",
    "run",
    "run_stage",
    "sweep",
]
