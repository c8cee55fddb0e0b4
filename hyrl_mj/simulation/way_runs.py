"""Which ways runs go: by the angles through which they turn about obstacles, or by a task's `direction`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.simulation.passing import Passing, Rows, windings
from hyrl_mj.simulation.rollout import LoopSettings, Rollout, closed_loop
from hyrl_mj.tasks import ANY, Outcome, Task

# If a smaller share of the runs arrives, the policy has hardly learned, and all runs show ways.
ARRIVING = 0.1


@dataclass(frozen=True)
class WayRuns(Rows):
    """The ways of n runs without noise.

    Attributes:
        alive: (n,) bool, whether the start does not end an episode at once.
        arrived: (n,) bool, whether the run arrives.
        shows: (n,) bool, whether the run shows a way: it arrives, or the task itself gives its direction and
            it does not fail either.
        stable: (n,) bool, whether the physics of the run is.
        direction: (n,) int, the ways that the task itself gives, `ANY` without one; None if it gives none.
        passing: how the runs pass the obstacles, if the task gives no ways.
    """

    alive: np.ndarray
    arrived: np.ndarray
    shows: np.ndarray
    stable: np.ndarray
    direction: np.ndarray | None
    passing: Passing | None

    @staticmethod
    def from_rollout(task: Task, rollout: Rollout) -> WayRuns:
        """Returns the ways of the runs of a rollout, of `way_runs`."""
        outcome = rollout.outcome
        arrived = outcome == Outcome.REACHED
        late = (outcome == Outcome.STALLED) | (outcome == Outcome.RUNNING)
        return WayRuns(
            rollout.length > 0,
            arrived,
            arrived | (late & task.gives_direction),
            outcome != Outcome.UNSTABLE,
            task.direction(rollout.path) if task.gives_direction else None,
            rollout.passing,
        )

    def __len__(self) -> int:
        return len(self.arrived)

    @property
    def arriving(self) -> bool:
        """Whether enough runs arrive to show the ways: `ARRIVING` of those that have something to decide."""
        counted = self.alive & self.stable
        if self.direction is not None:
            counted = counted & (self.direction != ANY)
        return bool(counted.any() and self.arrived[counted].mean() >= ARRIVING)

    @property
    def usable(self) -> np.ndarray:
        """Which of the runs show ways: (n,) bool; all stable ones if hardly any arrives."""
        return self.shows if self.arriving else self.stable

    def differ(self, other: WayRuns) -> np.ndarray:
        """Returns whether runs go another way than those of another: (n,) bool.

        They do if both have decided, or if the loop along one and back along the other winds about an
        obstacle.
        """
        if self.direction is not None and other.direction is not None:
            a, b = self.direction, other.direction
            return np.asarray((a != b) & (a != ANY) & (b != ANY))
        assert self.passing is not None
        assert other.passing is not None
        return np.asarray(windings(self.passing, other.passing).any(axis=1))


def policy_runs(task: Task, policy: Policy, z0: np.ndarray, **settings: Any) -> Rollout:
    """Simulates a policy without noise from starts z0 (n, d); `settings` are those of `LoopSettings`."""
    return closed_loop(task, PolicyController(policy), z0, settings=LoopSettings(**settings))


def way_runs(task: Task, policy: Policy, z: np.ndarray, **settings: Any) -> Rollout:
    """Returns the runs of `policy_runs`, with all that `WayRuns.from_rollout` has to know of them."""
    return policy_runs(task, policy, z, passing=not task.gives_direction, **settings)
