"""What stages 1 and 6 know about the policies that they give: how often each one wins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from hyrl_mj.files import artifacts
from hyrl_mj.judging.game import NEARLY
from hyrl_mj.policies import Policy
from hyrl_mj.simulation import Rollout, policy_runs, simulate
from hyrl_mj.tasks import Outcome, Task

# Number of episodes from which arrivals are counted.
EPISODES = 1_000


@dataclass(frozen=True)
class Arrivals(artifacts.SavedAsJson):
    """From how many of its task's starts a policy arrives without noise, saved as `arrivals.json`.

    Attributes:
        arrived: number of episodes that reach the goal within the task's `max_steps`, as in the game.
        missed: those of them that end farther from the set-point than the task's `close`.
        episodes: number of episodes.
        trainings: number of trainings of which this policy is the best; 0 of an agent.
        shaped: whether its own was paid for being near to the goal, in place of the task's reward.
    """

    KIND: ClassVar[str] = "arrivals"

    arrived: int
    missed: int
    episodes: int
    trainings: int = 0
    shaped: bool = False

    def __str__(self) -> str:
        missed = f", in {self.missed:,} of them off the set-point" if self.missed else ""
        return f"arrives from {self.arrived:,} of {self.episodes:,} starts without noise{missed}"

    @property
    def most(self) -> bool:
        """Whether it arrives from at least half of the starts."""
        return 2 * self.arrived >= self.episodes

    @property
    def nearly_all(self) -> bool:
        """Whether it arrives from nearly all of the starts, as a verdict asks."""
        return self.arrived >= NEARLY * self.episodes

    @staticmethod
    def measure(task: Task, policy: Policy) -> Arrivals:
        """Counts the arrivals of a policy from starts of the task, which are the same each time."""
        starts = task.starts(EPISODES, np.random.default_rng(0))
        if type(task).verify is not Task.verify:  # an environment may not be what it seems
            simulate(task, policy, starts[:64])  # its own judge plays them, too
        run = _episodes(task, policy)
        arrived = run.outcome == Outcome.REACHED
        missed = arrived & ~task.arrived(run.path[-1])
        return Arrivals(int(arrived.sum()), int(missed.sum()), len(arrived))


@dataclass(frozen=True)
class Failures:
    """How the episodes of `Arrivals` end.

    Attributes:
        starts, ends: chart points (n, d), and the `Outcome` (n,) of each.
        nearest: how near those that do not arrive come to the set-point [scaled units]; None of a task
            without one.
        earned: the mean reward at the last sample of those that stall; None if none does.
    """

    starts: np.ndarray
    ends: np.ndarray
    nearest: float | None
    earned: float | None

    @staticmethod
    def of(task: Task, policy: Policy) -> Failures:
        """Plays the episodes of a policy."""
        run, nearest, earned = _episodes(task, policy, record=True), None, None
        failed, stalled = run.outcome != Outcome.REACHED, run.outcome == Outcome.STALLED
        if task.set_point is not None:
            away = [task.chart.distance(z[failed], task.set_point) for z in run.path]
            nearest = min(float(distance.min(initial=np.inf)) for distance in away)
        if stalled.any():
            earned = float(task.reward(run.true[-1, stalled], run.u[-1, stalled]).mean())
        return Failures(run.path[0], run.outcome, nearest, earned)


def _episodes(task: Task, policy: Policy, record: bool = False) -> Rollout:
    """Plays a policy from starts of the task, which are the same each time."""
    starts = task.starts(EPISODES, np.random.default_rng(0))
    return policy_runs(
        task, policy, starts, record=record, states=False, vary=True, label="arrivals"
    )


# What the policy of a mode is.
Kind = Literal["trained", "pi_i", "agent", "table"]


@dataclass(frozen=True)
class ModeResult:
    """How the training of one mode ended.

    Attributes:
        mode: the mode.
        won: share of the states of its set from which its policy arrives in time, whatever the noise; where
            the worst case cannot be computed, share of the noisy episodes in which it arrives.
        attempts: number of trainings; 0 if nothing was trained.
        policy: what the policy is: "trained", "pi_i" (paper, Step 4), the "agent" itself, or a "table" of
            inputs.
    """

    mode: int
    won: float
    attempts: int
    policy: Kind = "trained"


@dataclass(frozen=True)
class Retraining(artifacts.SavedAsJson):
    """How stage 6 ended: a result for each mode. Saved as `retraining.json`."""

    KIND: ClassVar[str] = "retraining"

    modes: tuple[ModeResult, ...]
