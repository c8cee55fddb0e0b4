"""The input is held for some samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, Remembering, register
from hyrl_mj.policies import Policy
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class HeldLevels:
    """A policy on levels whose input is held: which one, and for how many samples more, is the mode.

    Attributes:
        task: gives the levels.
        policy: is asked in mode 0.
        samples: for how many samples each input is applied.
    """

    task: Task
    policy: Policy
    samples: int

    @property
    def levels(self) -> np.ndarray:
        """The inputs (L, m)."""
        assert self.task.input_levels is not None
        return self.task.input_levels

    @property
    def modes(self) -> tuple[int, ...]:
        """Mode 0 asks; mode 1 + level + L * (k - 1) applies a level for the last k samples."""
        return tuple(range(1 + len(self.levels) * (self.samples - 1)))

    def initial_mode(self, measured: np.ndarray) -> np.ndarray:
        """Returns mode 0 (n,)."""
        return np.zeros(len(measured), dtype=int)

    def step(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,)."""
        count = len(self.levels)
        level, left = (q - 1) % count, (q - 1) // count + 1  # of those that hold
        asks = np.flatnonzero(q == 0)
        if len(asks):
            u = self.policy.act(measured[asks])
            away = np.abs(self.levels[None] - u[:, None]).sum(axis=2)
            level[asks], left[asks] = away.argmin(axis=1), self.samples
        after = np.where(left > 1, 1 + level + count * (left - 2), 0)
        return self.levels[level], after


@dataclass(frozen=True)
class HeldInputs(Remembering):
    """A policy on continuous inputs whose input is held; its memory is the input, and for how long yet."""

    samples: int

    def start(self, n: int) -> np.ndarray:
        return np.zeros((n, len(self.task.inputs) + 1))

    def act_after(self, memory: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, left = memory[:, :-1].copy(), memory[:, -1].copy()
        asks = left == 0
        if asks.any():
            u[asks], left[asks] = self.policy.act(measured[asks]), self.samples
        return u, np.column_stack([u, left - 1])


@register
class Held(Alternative):
    """Each input of the policy of stage 1 is applied for several samples."""

    name = "held"
    title = "inputs held"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        task, policy = given.task, given.run.steady
        held = HeldInputs if task.input_levels is None else HeldLevels
        for samples in (2, 3, 5, 8):
            yield Candidate(f"{samples} samples", held(task, policy, samples))
