"""Pictures of a run, each a function from its artifacts to a PNG and a PDF."""

from hyrl_mj.figures.hybrid import extended_sets_map, runs
from hyrl_mj.figures.policy import overview, policy_map
from hyrl_mj.figures.robustness import robustness_curve, robustness_map

# What the picture of each name shows, in the order of the stages.
CAPTIONS = {
    "overview": "",
}

__all__ = [
    "CAPTIONS",
    "extended_sets_map",
    "overview",
    "policy_map",
    "robustness_curve",
    "robustness_map",
    "runs",
]
