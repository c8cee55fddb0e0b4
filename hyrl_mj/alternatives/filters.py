"""Filters in front of the policy of stage 1."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, Remembering, register


@dataclass(frozen=True)
class MovingAverage(Remembering):
    """A policy that acts on the mean of the last chart points.

    The memory of a run is how many of them it has, and these, the latest last.
    """

    length: int

    def start(self, n: int) -> np.ndarray:
        return np.zeros((n, 1 + (self.length - 1) * self.task.chart.dimension))

    def act_after(self, memory: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        task, n = self.task, len(measured)
        z = task.z(measured)
        count = np.minimum(memory[:, 0] + 1, self.length)
        before = memory[:, 1:].reshape(n, self.length - 1, z.shape[1])
        # On the same turn of periodic coordinates as the latest.
        before = np.stack([task.chart.near(b, z) for b in before.swapaxes(0, 1)], axis=1)
        last = np.concatenate([before, z[:, None]], axis=1)
        known = np.arange(self.length) >= self.length - count[:, None]
        mean = (last * known[..., None]).sum(axis=1) / count[:, None]
        u = self.policy.act(task.with_z(measured, task.chart.wrap(mean)))
        return u, np.column_stack([count, last[:, 1:].reshape(n, -1)])


@dataclass(frozen=True)
class KalmanFilter(Remembering):
    """A policy that acts on the estimate of a Kalman filter whose model is the task's own plant, whose whole
    state is the chart.

    The errors of all coordinates are as large as each other in units of the noise, and the model passes them
    on as they are: then the gain of all is the same, k / (k + 1) of the variance.

    The memory of a run is the variance of the estimate, in units of that of the noise (0 before the first
    measurement), and the estimate for the next sample.

    Attributes:
        drift: variance that each sample adds to that of the estimate, in units of that of the noise.
    """

    drift: float
    _plants: list[Any] = field(default_factory=list, repr=False, compare=False)

    def start(self, n: int) -> np.ndarray:
        return np.zeros((n, 1 + self.task.chart.dimension))

    def act_after(self, memory: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        task, chart = self.task, self.task.chart
        z, first = task.z(measured), memory[:, :1] == 0
        # Nothing is known before the first measurement.
        known = np.where(first, np.inf, memory[:, :1] + self.drift)
        gain = np.where(first, 1.0, 1 - 1 / (known + 1))
        predicted = np.where(first, z, memory[:, 1:])
        estimate = predicted + gain * chart.difference(z, predicted)
        # Exact coordinates are as they are measured.
        estimate = np.where(task.noise_in_chart(1.0) > 0, estimate, z)
        estimate = chart.wrap(estimate)
        u, rows = self.policy.act(task.with_z(measured, estimate)), np.arange(len(z))
        if not self._plants or self._plants[-1].n < len(z):  # a new one for each sample takes long
            self._plants.append(task.tabulating(len(z)))
        plant = self._plants[-1]
        plant.set_state(*task.state(estimate), ids=rows)
        plant.step(u, rows)
        return u, np.column_stack([gain, task.z(plant.measurement[rows])])


@register
class Filtered(Alternative):
    """A moving average, or a Kalman filter on the task's own plant, before the policy of stage 1."""

    name = "filtered"
    title = "filtered"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        task, policy = given.task, given.run.steady
        for length in (2, 4, 8):
            yield Candidate(f"mean of {length}", MovingAverage(task, policy, length))
        if given.run.why_no_game is not None:  # the chart is not all that the plant remembers
            return
        for drift in (0.0, 0.02, 0.2):
            yield Candidate(f"Kalman filter, drift {drift:g}", KalmanFilter(task, policy, drift))
