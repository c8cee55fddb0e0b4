"""How far a robot moves in one sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.tasks.description import Outcome

if TYPE_CHECKING:
    from hyrl_mj.tasks.problem import Problem

# Runs side by side, and the samples after which those that do not hold their input draw a new one.
RUNS, HELD = 512, 8
# Moves come close to the largest one, and do not reach it: where it depends smoothly on the state, those of
# thousands of samples fall short of it by less than this share.
MARGIN = 1e-3


def largest_moves(task: Problem) -> np.ndarray:
    """Returns the largest change (p,) of each column of the measurement in one sample, as runs show it.

    They start anywhere on the chart, under inputs at their limits or in their middle, which half of the runs
    hold. What a collision or an end does is left out.
    """
    rng, chart, d = np.random.default_rng(0), task.chart, task.chart.dimension
    z = rng.uniform(chart.low, chart.high, (4 * RUNS, d))
    z = z[task.goes_on(z)][:RUNS]
    active, largest = np.arange(len(z)), np.zeros(len(task.noisy))
    plant, (low, high) = task.plant(len(z)), task.input_limits
    plant.set_state(*task.state(z, rng))
    u, changes = np.zeros((len(z), len(low))), active % 2 == 0
    for k in range(task.max_steps):
        if k % HELD == 0:
            drawn = low + (high - low) * rng.integers(3, size=u.shape) / 2
            u = np.where(changes[:, None] | (k == 0), drawn, u)
        before = plant.measurement
        plant.step(u[active], active)
        after, unstable = plant.measurement, plant.unstable
        goes_on = task.outcome(after, unstable)[active] == Outcome.RUNNING
        active = active[goes_on]
        change = after[active] - before[active]
        change[:, :d] = chart.difference(after[active, :d], before[active, :d])
        largest = np.maximum(largest, np.abs(change).max(axis=0, initial=0.0))
    return (1 + MARGIN) * largest
