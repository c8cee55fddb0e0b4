"""What a measurement of an environment holds: chart, state, memory, and what the environment reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from hyrl_mj.environments.coordinates import Coordinate
from hyrl_mj.environments.copies import STATE, Host, Report
from hyrl_mj.environments.crew import Crew
from hyrl_mj.environments.success import Success


@dataclass(frozen=True)
class Layout:
    """The columns of a measurement (n, p).

    These are the chart's coordinates, MuJoCo's state, the memory of the environment, what it reported after
    the last step, and the outcome.

    Attributes:
        host: the environment.
        chart: the coordinates of the chart.
        success: the criterion of success.
        usual: MuJoCo's state (S,) and the memory (A,) from which copies begin.
        low, high: limits of the inputs (m,).
    """

    host: Host
    chart: Sequence[Coordinate]
    success: Success
    usual: tuple[np.ndarray, np.ndarray]
    low: np.ndarray
    high: np.ndarray

    @cached_property
    def qpos(self) -> np.ndarray:
        """The columns (nq,) of a state that are positions."""
        return self._columns("qpos")

    @cached_property
    def qvel(self) -> np.ndarray:
        """The columns (nv,) of a state that are velocities."""
        return self._columns("qvel")

    @cached_property
    def crew(self) -> Crew:
        """What steps copies of the environment."""
        return Crew(self.host)

    def _columns(self, kind: str) -> np.ndarray:
        model, data = self.host.model, mujoco.MjData(self.host.model)
        state = np.empty(mujoco.mj_stateSize(model, STATE))
        found = []
        for i in range(len(getattr(data, kind))):
            mujoco.mj_resetData(model, data)
            getattr(data, kind)[i] = np.pi * 1e3  # a number that stands nowhere else
            mujoco.mj_getState(model, data, state, STATE)
            found.append(int(np.flatnonzero(state == np.pi * 1e3)[0]))
        return np.array(found, dtype=int)

    @cached_property
    def of_chart(self) -> np.ndarray:
        """The columns (d,) of a state that the chart's coordinates are in."""
        return np.array([getattr(self, c.kind)[c.index] for c in self.chart])

    @cached_property
    def offset(self) -> np.ndarray:
        """What the chart's coordinates are greater by than the state (d,)."""
        return np.array([c.offset for c in self.chart])

    @property
    def sizes(self) -> tuple[int, ...]:
        """The numbers of columns of chart, state, memory, report and outcome."""
        return len(self.chart), len(self.usual[0]), len(self.usual[1]), self.host.width + 5, 1

    def measurement(
        self, state: np.ndarray, memory: np.ndarray, report: np.ndarray, outcome: np.ndarray
    ) -> np.ndarray:
        """Returns the measurements (n, p) of copies."""
        z = state[:, self.of_chart] + self.offset
        return np.column_stack([z, state, memory, report, outcome])

    def parts(self, measured: np.ndarray) -> tuple[np.ndarray, ...]:
        """Returns chart points, states, memories, reports and outcomes of measurements (n, p)."""
        return tuple(np.split(measured, np.cumsum(self.sizes)[:-1], axis=1))

    def observation(self, measured: np.ndarray) -> np.ndarray:
        """Returns what the environment observes (n, o) in the states that measurements (n, p) tell of.

        Where noise has moved the chart's coordinates, the state is that at which they are so.
        """
        z, state, memory, report, _ = self.parts(measured)
        observed = report[:, : self.host.width].copy()
        there = z - self.offset
        noisy = np.flatnonzero((np.abs(there - state[:, self.of_chart]) > 1e-12).any(axis=1))
        if len(noisy):
            moved = state[noisy].copy()
            moved[:, self.of_chart] = there[noisy]
            observed[noisy] = self.crew.observe(moved, memory[noisy])[0]
        return observed

    def report(self, measured: np.ndarray) -> Report:
        """Returns what the environment reported in measurements (n, p)."""
        return Report.of(self.parts(measured)[3])
