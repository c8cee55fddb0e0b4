"""Pictures of a run, each a function from its artifacts to a PNG and a PDF."""

from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures.charts import drawable
from hyrl_mj.viz.figures.hybrid import extended_sets_map, runs
from hyrl_mj.viz.figures.policy import overview, policy_map
from hyrl_mj.viz.figures.robustness import CLASS_COLOURS, robustness_curve, robustness_map

# What the picture of each name shows, in the order in which they tell the story.
CAPTIONS = {
    "overview": (
        "Where the stage-1 policy goes without noise, in the colour of the mode whose way it is, and "
        "where measurement noise leads it from one start. The red field is all that it can observe along "
        "that path."
    ),
    "policy": (
        "The input that the stage-1 policy gives at each measurement, with the critical set M* in red, "
        "and its runs from the paper's starts under measurement noise."
    ),
    "extended_sets": (
        "The extended set of each mode, and where they overlap: the overlap over the critical set M* is "
        "the hysteresis that is to keep noise from flipping the mode."
    ),
    "robustness_map": (
        "What becomes of runs from each state when an adversary picks the worst noise at every sample."
    ),
    "robustness_curve": (
        "How much of the winnable start region is won against the worst noise, over its bound."
    ),
    "runs": (
        "The hybrid controller and the stage-1 policy from the paper's starts under the same "
        "measurement noise, for each start mode."
    ),
}


def names(task: Task) -> tuple[str, ...]:
    """The pictures of a run that need no worst-case game; some are left out where a chart cannot be shown."""
    return ("overview", "policy", "extended_sets", "runs") if drawable(task) else ("runs",)


__all__ = [
    "CAPTIONS",
    "CLASS_COLOURS",
    "extended_sets_map",
    "names",
    "overview",
    "policy_map",
    "robustness_curve",
    "robustness_map",
    "runs",
]
