"""Simulation: the closed loop of plant, measurement noise and controller, in batches.

`closed_loop` runs many episodes at once; `simulate` returns them as hybrid arcs. Each kind of
measurement noise is a class of its own.
"""

from hyrl_mj.simulation.arc import HybridArc, samples, simulate
from hyrl_mj.simulation.lookahead import NOT_STARTED
from hyrl_mj.simulation.noise import KINDS, SIGNALS, Noise, Recorded
from hyrl_mj.simulation.rollout import AnyNoise, Rollout, closed_loop, ways

__all__ = [
    "KINDS",
    "NOT_STARTED",
    "SIGNALS",
    "AnyNoise",
    "HybridArc",
    "Noise",
    "Recorded",
    "Rollout",
    "closed_loop",
    "samples",
    "simulate",
    "ways",
]
