"""Which ways runs go: by the angles through which they turn about obstacles, or by a task's `direction`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.simulation.passing import Passing, Rows, windings
from hyrl_mj.simulation.rollout import LoopSettings, Rollout, closed_loop
from hyrl_mj.tasks import ANY, Outcome, Task


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

    def __len__(self) -> int:
        return len(self.arrived)

    @property
    def arriving(self) -> bool:
        """Whether a tenth of the runs arrives that have something to decide.

        Otherwise the policy has hardly learned, and all runs show ways.
        """
        counted = self.alive & self.stable
        if self.direction is not None:
            counted = counted & (self.direction != ANY)
        return bool(counted.any() and self.arrived[counted].mean() >= 0.1)

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


def way_runs(task: Task, policy: Policy, z: np.ndarray, **settings: Any) -> tuple[WayRuns, Rollout]:
    """Returns which ways the runs of `policy_runs` go, and these runs."""
    own = task.gives_direction
    rollout = policy_runs(task, policy, z, passing=not own, **settings)
    outcome = rollout.outcome
    arrived = outcome == Outcome.REACHED
    late = (outcome == Outcome.STALLED) | (outcome == Outcome.RUNNING)
    ways = WayRuns(
        alive=rollout.length > 0,
        arrived=arrived,
        shows=arrived | (late & own),
        stable=outcome != Outcome.UNSTABLE,
        direction=task.direction(rollout.path) if own else None,
        passing=rollout.passing,
    )
    return ways, rollout
