"""The batched core of every environment: n episodes of one task, stepped side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.errors import BadInput
from hyrl_mj.ranges import Integer, Optional
from hyrl_mj.simulation import (
    NOT_STARTED,
    AnyNoise,
    Sample,
    begin_signal,
    drawn,
    signal_for,
    try_signal,
)
from hyrl_mj.tasks import Outcome, Task, at_levels, check_finite

# The most episodes side by side.
MOST = 2**20


@dataclass(frozen=True)
class Pay:
    """What episodes are paid for.

    Attributes:
        reward: rewards (n,) of measurements (n, p) and inputs (n, m), as `Task.reward`.
        worst: a lower bound of them.
    """

    reward: Callable[[np.ndarray, np.ndarray], np.ndarray]
    worst: float


@dataclass(frozen=True)
class Domain:
    """Where the episodes of a training start, and to which part of the state space they are restricted.

    The paper's Step 6 restricts the training of a mode.

    Attributes:
        starts: draws n chart points (n, d) with a generator.
        contains: (n, d) -> (n,) bool; an episode ends where it leaves the domain. By default it may go
            anywhere.
        exit_reward: with `contains`, reward for leaving the domain, and for failing in it.
        caution: (p,) largest error of a measurement: if given, the reward is `cautious_reward`.
        earns: (n, d) -> (n,) bool; elsewhere every step is worth the worst reward.
        pay: what is paid for; by default the task's reward.
    """

    starts: Callable[[int, np.random.Generator], np.ndarray]
    contains: Callable[[np.ndarray], np.ndarray] | None = None
    exit_reward: float = 0.0
    caution: np.ndarray | None = None
    earns: Callable[[np.ndarray], np.ndarray] | None = None
    pay: Pay | None = None


@dataclass(frozen=True)
class StepResult:
    """The result of one step of n episodes; all arrays have n rows.

    Attributes:
        observation: (n, k) float32, noise included.
        reward: (n,) rewards of the true states after the step.
        terminated: (n,) bool, whether the task or leaving the domain ended the episode.
        truncated: (n,) bool, whether the time limit ended the episode.
        outcome: (n,) `Outcome`; RUNNING unless the episode is over.
    """

    observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    outcome: np.ndarray

    @property
    def done(self) -> np.ndarray:
        """Whether the episode is over: (n,) bool."""
        return self.terminated | self.truncated


class BatchedEnv:
    """n episodes of one task. The environments add only the conventions of their libraries.

    Args:
        task: the robot and its problem.
        n: number of episodes side by side.
        noise: measurement noise on the observations, of a kind that needs no controller; reward and end
            depend on the true state.
        domain: where episodes start and stay; by default the task's starts, and everywhere.
        max_steps: samples until truncation, by default the task's limit.
        threads: threads of the physics, 0 for all cores; results do not depend on it.

    Raises:
        BadInput: a value that cannot be used.
    """

    def __init__(
        self,
        task: Task,
        n: int,
        *,
        noise: AnyNoise | None = None,
        domain: Domain | None = None,
        max_steps: int | None = None,
        threads: int = 0,
    ):
        n = Integer(1, MOST).checked("the number of episodes side by side", n)
        limit = Optional(Integer(1, 10**9)).checked("the limit of samples", max_steps)
        threads = Integer(0, 1_024).checked("threads", threads)
        self.task, self.n, self.domain = task, n, domain
        self._noise = signal_for(noise, task, None)
        try_signal(self._noise, task, n)
        self.max_steps = limit or task.max_steps
        self.plant = task.plant(n, threads)
        self.samples = np.zeros(n, dtype=int)  # of each episode so far
        self.measured = np.zeros_like(self.plant.measurement)  # what observations are computed from
        self.seed(None)

    def seed(self, seed: int | None) -> None:
        """Restarts the generator from which starts and noise are drawn.

        Raises:
            BadInput: the seed is not an integer >= 0, or None.
        """
        seed = Optional(Integer(0, 2**64)).checked("seed", seed)
        self._rng = np.random.default_rng(seed)
        begin_signal(self._noise, self.n, self._rng)

    def reset(self, ids: np.ndarray | None = None, z: np.ndarray | None = None) -> np.ndarray:
        """Starts new episodes in the rows `ids` (k,), by default all; returns observations (k, o) float32.

        The episodes start at chart points z (k, d), by default drawn from the start distribution.

        Raises:
            BadInput: the numbers of starts and rows differ.
        """
        ids = np.arange(self.n) if ids is None else ids
        if z is None:
            draw = self.task.starts if self.domain is None else self.domain.starts
            z = draw(len(ids), self._rng)
        if len(z) != len(ids):
            raise BadInput(f"{len(ids)} episode(s) need as many starts, got {len(z)}")
        self.plant.set_state(*self.task.state(z, self._rng), ids=ids)
        self.samples[ids] = 0
        return self.task.observation(self._measure(ids)).astype(np.float32)

    def step(self, u: np.ndarray) -> StepResult:
        """Advances all episodes by one sample under inputs u (n, m) in the plant's units.

        The caller resets the episodes that are over.

        Raises:
            BadInput: inputs that cannot be applied, or a method of the task that fails.
        """
        self.plant.step(u)
        self.samples += 1
        measured = self._measure(np.arange(self.n))
        measurement, unstable = self.plant.measurement, self.plant.unstable
        outcome = self.task.outcome(measurement, unstable)
        terminated = outcome != Outcome.RUNNING
        pay = pay_of(self.task, self.domain)
        reward = pay.reward(measurement, u)
        reward[unstable] = pay.worst
        if self.domain is not None:
            if (caution := self.domain.caution) is not None:
                reward = np.minimum(reward, cautious_reward(self.task, measured, u, caution, pay))
            z = self.task.z(measurement)
            if self.domain.earns is not None:
                reward = np.where(self.domain.earns(z), reward, pay.worst)
            if self.domain.contains is not None:
                left = ~terminated & ~self.domain.contains(z)
                # A failure costs as much: else it would end a way that costs something, and pay.
                reward[left | (terminated & (outcome != Outcome.REACHED))] = self.domain.exit_reward
                terminated = terminated | left
                outcome[left] = Outcome.OUT_OF_BOUNDS
        check_finite(self.task, "reward", reward, measurement)
        truncated = ~terminated & (self.samples >= self.max_steps)
        if truncated.any():
            outcome[truncated] = self.task.verdict(measurement[truncated])
        observation = self.task.observation(measured).astype(np.float32)
        return StepResult(observation, reward, terminated, truncated, outcome)

    @property
    def z(self) -> np.ndarray:
        """The true chart points (n, d)."""
        return self.task.z(self.plant.measurement)

    def inputs(self, actions: ArrayLike) -> np.ndarray:
        """Returns inputs (n, m) in the plant's units, for levels (n,) int or inputs (n, m) of a controller.

        The latter are clipped to their limits.

        Raises:
            BadInput: actions of another shape or type, or numbers of no level.
        """
        try:
            values = np.asarray(actions)
        except ValueError:
            raise BadInput(f"actions {actions!r} cannot be used: give an array") from None
        discrete, m = self.task.input_levels is not None, len(self.task.inputs)
        is_input = values.ndim == 2 and values.shape[1] == m
        is_input &= not discrete or values.dtype.kind == "f"
        fits = is_input or (discrete and values.ndim == 1)
        if not fits or not values.size or values.dtype.kind not in "iuf":
            one = "an integer, or floats" if discrete else "an array"
            one += f" of shape ({m},)"
            raise BadInput(
                f"actions of shape {values.shape} and type {values.dtype} cannot be used: {self.task.name} "
                f"takes {one} for each episode"
            )
        if not is_input:
            return at_levels(self.task, values)
        return np.clip(values.astype(float), *self.task.input_limits)

    def _measure(self, ids: np.ndarray) -> np.ndarray:
        """Returns noisy measurements (k, p) of the rows `ids`, which `measured` holds from then on."""
        true, modes = self.plant.truth(ids), np.full(len(ids), NOT_STARTED)
        noise = drawn(self._noise, Sample(ids, self.samples[ids], true, modes, self.plant))
        self.measured[ids] = measured = self.plant.observe(true, noise, ids)
        return measured


def pay_of(task: Task, domain: Domain | None = None) -> Pay:
    """Returns what episodes are paid for: the reward of the task, unless the domain says otherwise."""
    return (domain and domain.pay) or Pay(task.reward, task.worst_reward)


def cautious_reward(
    task: Task, measured: np.ndarray, u: np.ndarray, caution: np.ndarray, pay: Pay | None = None
) -> np.ndarray:
    """Returns the least reward (n,) of states within `caution` (p,) of measurements (n, p), inputs (n, m).

    The reward is that of the task, or what is paid. It is the worst where one of these states has failed.
    With this reward a policy learns to keep clear of what noise could hide, without noise in training.
    """
    shares = (-1.0, -0.5, 0.0, 0.5, 1.0) if np.count_nonzero(caution) <= 2 else (-1.0, 0.0, 1.0)
    signs = np.array(list(product(*[shares if c else (0.0,) for c in caution])))
    # All states in one call: each method takes as long for a few rows as for many.
    states = (measured + (signs * caution)[:, None]).reshape(-1, measured.shape[1])
    pay = pay or pay_of(task)
    reward = pay.reward(states, np.tile(u, (len(signs), 1)))
    reward = np.where(task.failed(states), pay.worst, reward)
    return np.asarray(reward.reshape(len(signs), -1).min(axis=0))
