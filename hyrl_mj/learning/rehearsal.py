"""Starts all over the chart: what a policy lately lost is rehearsed."""

import numpy as np

from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.tasks import Outcome, Task

# Of the episodes that start anywhere, the share that starts where the latest policy lost.
LOST_SHARE = 0.5
# Chart points that starts are drawn from, and that a policy is tried from.
POINTS, TRIED = 16_384, 2_048


class Rehearsal:
    """Draws the starts of a training: some of them anywhere on the chart, and where the policy lately lost.

    From its own starts a policy that has learned to pass an obstacle early is never close in front of it
    again, and does not learn to get away from there: between two ways it keeps a wedge in which it crashes.

    Args:
        task: the robot and its problem.
        share: share of the episodes that start anywhere on the chart.
    """

    def __init__(self, task: Task, share: float):
        self._task, self._share = task, share
        self._points = running_points(task, POINTS, np.random.default_rng(0))
        self._lost = self._points[:0]
        self._weight, self._tried = np.empty(0), 0

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws n starts (n, d)."""
        z = self._points[rng.integers(len(self._points), size=n)]
        if len(self._lost):
            lost = self._lost[rng.choice(len(self._lost), n, p=self._weight)]
            z = np.where(rng.random((n, 1)) < LOST_SHARE, lost, z)
        return np.where(rng.random((n, 1)) < self._share, z, self._task.starts(n, rng))

    def update(self, policy: Policy) -> None:
        """Notes from where a policy loses; what it loses late counts more, as it is easier to mend."""
        at = np.arange(self._tried, self._tried + TRIED) % len(self._points)
        self._tried += TRIED
        z = self._points[at]
        run = closed_loop(
            self._task, PolicyController(policy), z, settings=LoopSettings(quiet=True)
        )
        lost = (
            (run.outcome != Outcome.REACHED) & (run.outcome != Outcome.UNSTABLE) & (run.length > 0)
        )
        self._lost, weight = z[lost], run.length[lost].astype(float)
        self._weight = weight / max(weight.sum(), 1.0)


def running_points(task: Task, n: int, rng: np.random.Generator) -> np.ndarray:
    """Returns those of n drawn chart points (k, d) at which no episode ends at once; all n if all end."""
    z = rng.uniform(task.chart.low, task.chart.high, (n, task.chart.dimension))
    plant = task.plant(n)
    plant.set_state(*task.state(z, rng))
    running = task.ending(plant.measurement) == Outcome.RUNNING
    return z[running] if running.any() else z
