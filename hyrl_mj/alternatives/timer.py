"""The supervisor with a timer, over the policies of HyRL's modes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, Unfit, register
from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.tasks import Outcome, Task


@dataclass(frozen=True)
class TimerSupervisor:
    """The policy of the greatest value acts, for at least some samples.

    Mode i * (dwell + 1) + k means that policy i acts, and for k samples more no other one may.

    Attributes:
        task: gives the chart.
        policies: (Q,).
        grid, values: (Q, N) values of the policies at the nodes of a grid.
        dwell: the samples for which each policy acts at least.
        better: by how much the value of another has to be greater, as a share of the values' range.
    """

    task: Task
    policies: tuple[Policy, ...]
    grid: Grid
    values: np.ndarray
    dwell: int
    better: float

    @property
    def modes(self) -> tuple[int, ...]:
        return tuple(range(len(self.policies) * (self.dwell + 1)))

    def _of(self, measured: np.ndarray) -> np.ndarray:
        """Returns the values (Q, n) at measurements (n, p)."""
        z = self.task.z(measured)
        return np.stack([self.grid.interpolate(values, z) for values in self.values])

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        return np.asarray(self._of(measured).argmax(axis=0) * (self.dwell + 1) + self.dwell)

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        acting, left = q // (self.dwell + 1), q % (self.dwell + 1)
        values, rows = self._of(measured), np.arange(len(q))
        best = values.argmax(axis=0)
        gain = values[best, rows] - values[acting, rows]
        switch = (left == 0) & (best != acting) & (gain > self.better * np.ptp(self.values))
        acting = np.where(switch, best, acting)
        left = np.where(switch, self.dwell, np.maximum(left - 1, 0))
        u = np.empty((len(q), len(self.task.inputs)))
        for i, policy in enumerate(self.policies):
            if len(at := np.flatnonzero(acting == i)):
                u[at] = policy.act(measured[at])
        return u, acting * (self.dwell + 1) + left


def returns(task: Task, policy: Policy, z: np.ndarray, gamma: float) -> np.ndarray:
    """Returns the discounted return (n,) of a policy from chart points z (n, d), without noise."""
    settings = LoopSettings(record=True, states=False, quiet=True)
    run = closed_loop(task, PolicyController(policy), z, settings=settings)
    total = np.zeros(len(z))
    for k, u in enumerate(run.u):
        rows = np.flatnonzero(k < run.length)
        reward = task.reward(run.true[k + 1][rows], u[rows])
        total[rows] += gamma**k * reward
    # What a failed or a truncated episode would go on to cost is its worst reward for ever.
    lost = run.outcome != Outcome.REACHED
    total[lost] += gamma ** run.length[lost] * task.worst_reward / (1 - gamma)
    return total


@register
class Timer(Alternative):
    """Of the policies of HyRL's modes that of the greatest value acts, and for a least time (after de
    Priester et al., RLC 2025), in place of sets with hysteresis."""

    name = "timer"
    title = "timer supervisor"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        run, task = given.run, given.task
        policies: Mapping[int, Policy] = run.controller.policies
        if len(policies) < 2:
            raise Unfit("the run has one mode, so that nothing is switched")
        grid, gamma = run.extended_sets.sets[0].grid, run.settings.stage6.gamma
        if not isinstance(grid, Grid):
            raise Unfit("values need the nodes of a grid, and this chart has scattered ones")
        on = np.flatnonzero(task.goes_on(grid.nodes))
        values = np.full((len(policies), grid.size), task.worst_reward / (1 - gamma))
        for row, policy in zip(values, policies.values(), strict=True):
            row[on] = returns(task, policy, grid.nodes[on], gamma)
        for dwell in (0, 4, 10, 20):
            for better in (0.0, 0.05):
                made = TimerSupervisor(task, tuple(policies.values()), grid, values, dwell, better)
                yield Candidate(f"{dwell} samples, {better:.0%} better", made)
