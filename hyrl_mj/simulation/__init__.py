"""Simulation: the closed loop of plant, measurement noise and controller, in batches.

`closed_loop` runs many episodes at once; `simulate` returns them as hybrid arcs. Each kind of measurement
noise is a class of its own, a `Signal`, that `register_noise` registers by its name.
"""

from hyrl_mj.simulation.arc import LONGEST, HybridArc, samples, simulate, simulate_batch
from hyrl_mj.simulation.checked_noise import begin_signal, drawn
from hyrl_mj.simulation.lookahead import Lookahead
from hyrl_mj.simulation.noise import (
    KINDS,
    NOT_STARTED,
    OF_RUNS,
    SENSOR,
    AnyNoise,
    Noise,
    Recorded,
    Sample,
    Signal,
    noise_kinds,
    register_noise,
    signal_for,
    try_signal,
)
from hyrl_mj.simulation.noise_of_logs import LogNoise, NamedNoise, noise_from_log, noise_of
from hyrl_mj.simulation.passing import Passing, Rows, windings
from hyrl_mj.simulation.programmes import GIVEN, Programmes
from hyrl_mj.simulation.real import judge, judge_task
from hyrl_mj.simulation.rollout import LoopSettings, Rollout, closed_loop
from hyrl_mj.simulation.rules import AttackSettings, Rules
from hyrl_mj.simulation.sensors import Sensor, covers_sensor, usual_kinds
from hyrl_mj.simulation.way_runs import WayRuns, policy_runs, way_runs

__all__ = [
    "GIVEN",
    "KINDS",
    "LONGEST",
    "NOT_STARTED",
    "OF_RUNS",
    "SENSOR",
    "AnyNoise",
    "AttackSettings",
    "HybridArc",
    "LogNoise",
    "Lookahead",
    "LoopSettings",
    "NamedNoise",
    "Noise",
    "Passing",
    "Programmes",
    "Recorded",
    "Rollout",
    "Rows",
    "Rules",
    "Sample",
    "Sensor",
    "Signal",
    "WayRuns",
    "begin_signal",
    "closed_loop",
    "covers_sensor",
    "drawn",
    "judge",
    "judge_task",
    "noise_from_log",
    "noise_kinds",
    "noise_of",
    "policy_runs",
    "register_noise",
    "samples",
    "signal_for",
    "simulate",
    "simulate_batch",
    "try_signal",
    "usual_kinds",
    "way_runs",
    "windings",
]
