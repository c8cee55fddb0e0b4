"""How far a robot moves in one sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.tasks.description import Outcome

if TYPE_CHECKING:
    from hyrl_mj.tasks.problem import Problem

# Runs side by side; every second one holds its input, the others draw a new one after so many samples.
RUNS, HELD = 512, 8


def largest_moves(task: Problem) -> np.ndarray:
    """Returns the largest change (p,) of each column of the measurement in one sample, as runs show it.

    They start anywhere on the chart, under inputs at their limits. What a collision or an end does is left
    out.
    """
    rng, chart, d = np.random.default_rng(0), task.chart, task.chart.dimension
    z = rng.uniform(chart.low, chart.high, (4 * RUNS, d))
    z = z[task.goes_on(z)][:RUNS]
    active, largest = np.arange(len(z)), np.zeros(len(task.noisy))
    holds = active % 2 == 0
    plant, limits = task.plant(len(z)), np.array(task.input_limits)
    plant.set_state(*task.state(z, rng))
    u = np.zeros((len(z), limits.shape[1]))
    for k in range(task.max_steps):
        if k % HELD == 0:
            drawn = np.take_along_axis(limits, rng.integers(2, size=u.shape), axis=0)
            u = np.where(holds[:, None] & (k > 0), u, drawn)
        before = plant.measurement
        plant.step(u[active], active)
        after, unstable = plant.measurement, plant.unstable
        goes_on = task.outcome(after, unstable)[active] == Outcome.RUNNING
        active = active[goes_on]
        change = after[active] - before[active]
        change[:, :d] = chart.difference(after[active, :d], before[active, :d])
        largest = np.maximum(largest, np.abs(change).max(axis=0, initial=0.0))
    return largest
