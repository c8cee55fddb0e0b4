"""Starts all over the chart, more of them where a policy lately lost, and where it lately decided."""

import numpy as np

from hyrl_mj.learning.settings import Training
from hyrl_mj.policies import Policy
from hyrl_mj.simulation import WayRuns, way_runs
from hyrl_mj.tasks import Outcome, Task


class Rehearsal:
    """Draws the starts of a training: some of them anywhere, and where the policy lately lost or decided.

    From its own starts a policy that has learned to pass an obstacle early is never close in front of it
    again, and does not learn to get away from there: between two ways it keeps a wedge in which it crashes.
    And where two ways meet, it goes the wrong one of them until it has often seen both from next to each
    other.

    Args:
        task: the robot and its problem.
        settings: give the shares of these episodes.
    """

    def __init__(self, task: Task, settings: Training):
        self._task, self._settings = task, settings
        self._points = running_points(task, 16_384, np.random.default_rng(0))
        self._lost = self._deciding = self._points[:0]
        self._weight, self._tried = np.empty(0), 0
        # A policy is tried from fewer points with dynamics, whose samples are slower to simulate.
        self._count = 2_048 if task.kinematic else 256

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws n starts (n, d)."""
        z = self._points[rng.integers(len(self._points), size=n)]
        which = rng.random((n, 1))
        if len(self._lost):
            lost = self._lost[rng.choice(len(self._lost), n, p=self._weight)]
            z = np.where(which < self._settings.rehearse_lost, lost, z)
        if len(self._deciding):
            deciding = self._deciding[rng.integers(len(self._deciding), size=n)]
            z = np.where(which > 1 - self._settings.rehearse_deciding, deciding, z)
        anywhere = rng.random((n, 1)) < self._settings.rehearse
        return np.where(anywhere, z, self._task.starts(n, rng))

    def update(self, policy: Policy) -> None:
        """Notes where a policy loses and decides; what it loses late counts more, as it is easier to mend."""
        at = np.arange(self._tried, self._tried + self._count) % len(self._points)
        self._tried += self._count
        z = self._points[at]
        ways, run = way_runs(self._task, policy, z, quiet=True)
        lost = ~ways.arrived & ways.stable & ways.alive
        self._lost, weight = z[lost], run.length[lost].astype(float)
        self._weight = weight / max(weight.sum(), 1.0)
        self._deciding = self._between(z, ways)

    def _between(self, z: np.ndarray, runs: WayRuns) -> np.ndarray:
        """Returns the middles (k, d) between neighbours among z (n, d) from which runs go different ways."""
        chart = self._task.chart
        neighbours = 4
        near = chart.nearest(z, z, neighbours + 1)[1][:, 1:]
        first, second = np.repeat(np.arange(len(z)), neighbours), near.ravel()
        part = runs.shows[first] & runs.shows[second] & runs[first].differ(runs[second])
        a, b = z[first[part]], z[second[part]]
        return chart.wrap(a + chart.difference(b, a) / 2)


def running_points(task: Task, n: int, rng: np.random.Generator) -> np.ndarray:
    """Returns those of n drawn chart points (k, d) at which no episode ends at once; all n if all end."""
    z = task.chart.draw(n, rng)
    running = task.ending(task.placed(z, rng).measurement) == Outcome.RUNNING
    return z[running] if running.any() else z
