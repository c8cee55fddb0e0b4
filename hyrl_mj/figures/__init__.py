"""Pictures of a run, each a function from its artifacts to a PNG and a PDF."""

from hyrl_mj.figures.robustness import robustness_curve, robustness_map

__all__ = ["robustness_curve", "robustness_map"]
