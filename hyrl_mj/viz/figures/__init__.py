"""Figures of a run, drawn from the results of its stages.

Each drawing function takes the value that it shows, and returns a matplotlib `Figure`. All but runs,
robustness map and curve raise `BadInput` for a chart that is neither a plane nor a ring. A new figure is a
function in a module here and an entry of `FIGURES`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures import style
from hyrl_mj.viz.figures.charts import drawable
from hyrl_mj.viz.figures.extended_sets import draw_extended_sets
from hyrl_mj.viz.figures.policy import (
    draw_arrivals as draw_arrivals,
    draw_overview,
    draw_policy_map,
)
from hyrl_mj.viz.figures.robustness import (
    CLASS_COLOURS as CLASS_COLOURS,
    draw_robustness_curve,
    draw_robustness_map,
)
from hyrl_mj.viz.figures.runs import draw_runs
from hyrl_mj.viz.figures.shown import Shown


@dataclass(frozen=True)
class Entry:
    """A figure that stages draw and reports show.

    Attributes:
        draw: shown -> the figure.
        of: what it shows, "policy", "controller" or "game"; the stage that makes that draws the figure.
        caption: one or two sentences for the report.
        flat: whether the figure needs a chart, or a section of it, that is a plane or a ring.
    """

    draw: Callable[[Shown], Figure]
    of: str
    caption: str
    flat: bool = True


# By the name of their files, in the order in which reports show them.
FIGURES = {
    "overview": Entry(
        draw_overview,
        "policy",
        "Where the stage-1 policy goes without noise, in the colour of the mode whose way it is, and "
        "where measurement noise leads it from one start. The red field is all that it can observe along "
        "that path, and the dots are what it does observe. Of the other colours, each is the part of one "
        "mode alone.",
    ),
    "policy": Entry(
        draw_policy_map,
        "policy",
        "The input that the stage-1 policy gives at each measurement, with the critical set M* in red, "
        "and its runs from the scene's starts under measurement noise.",
    ),
    "extended_sets": Entry(
        draw_extended_sets,
        "controller",
        "The extended set of each mode, and where they overlap: the overlap over the critical set M* is "
        "the hysteresis that is to keep noise from flipping the mode.",
    ),
    "robustness_map": Entry(
        draw_robustness_map,
        "game",
        "What becomes of runs from each state when an adversary picks the worst noise at every sample.",
        flat=False,
    ),
    "robustness_curve": Entry(
        draw_robustness_curve,
        "game",
        "How much of the winnable start region is won against the worst noise, over its bound.",
        flat=False,
    ),
    "runs": Entry(
        draw_runs,
        "controller",
        "The hybrid controller and the stage-1 policy from the scene's starts under the same "
        "measurement noise, for each start mode.",
        flat=False,
    ),
}


def names(task: Task, *kinds: str) -> tuple[str, ...]:
    """Returns the names of the figures of these kinds, as `Entry.of`, that the task's chart allows."""
    return tuple(
        name
        for name, entry in FIGURES.items()
        if entry.of in kinds and (drawable(task.chart) or not entry.flat)
    )


def draw_all(shown: Shown, folder: Path, *kinds: str) -> tuple[str, ...]:
    """Writes every figure of these kinds into a folder, and returns their names."""
    drawn = names(shown.task, *kinds)
    if "game" in kinds and shown.result.estimate:  # of a few bounds there is no curve
        drawn = tuple(name for name in drawn if name != "robustness_curve")
    for name in drawn:
        style.write(FIGURES[name].draw(shown), folder / f"{name}.png")
    return drawn


shown_run = Shown  # `draw_runs(shown_run(run))`, as the manual has it
