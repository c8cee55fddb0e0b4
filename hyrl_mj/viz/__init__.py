"""Pictures, videos, tables and pages of the results of a run.

The modules `diagnosis`, `drives`, `encoding`, `figures`, `live`, `replay`, `report`, `shows` and `viewing`
import matplotlib, Pillow or a GL library, so they are imported only where they are needed.
"""

from hyrl_mj.viz.commands import beginning
from hyrl_mj.viz.compared_tables import print_compared
from hyrl_mj.viz.notebook import Run, load_run
from hyrl_mj.viz.options import ReplayOptions
from hyrl_mj.viz.sweep_tables import print_sweep
from hyrl_mj.viz.tables import (
    print_noise,
    print_robustness,
    print_summary,
    replay_sentence,
    robustness_sentence,
)

__all__ = [
    "ReplayOptions",
    "Run",
    "beginning",
    "compared_page",
    "diagnosis",
    "drives",
    "encoding",
    "figures",
    "live",
    "load_run",
    "notebook",
    "pages",
    "print_compared",
    "print_noise",
    "print_robustness",
    "print_summary",
    "print_sweep",
    "replay",
    "replay_sentence",
    "report",
    "robustness_sentence",
    "shows",
    "sweep_page",
    "viewing",
]
