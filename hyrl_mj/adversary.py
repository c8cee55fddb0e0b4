"""Noise that looks at the closed loop before it chooses."""

from __future__ import annotations

from itertools import product
from typing import Protocol

import numpy as np

from hyrl_mj.controllers import Controller
from hyrl_mj.noise import Noise
from hyrl_mj.plant import Plant
from hyrl_mj.tasks.base import Task

# Modes of runs that have not started yet: their controller picks one from the first measurement.
NOT_STARTED = -1


class Adversary(Protocol):
    """Measurement noise that is chosen anew at every sample, in view of the state and the mode."""

    @property
    def kind(self) -> str:
        """Its name."""
        ...

    @property
    def bound(self) -> float:
        """The largest magnitude that it may have."""
        ...

    def choose(self, plant: Plant, q: np.ndarray) -> np.ndarray:
        """The noise (n, p) for n simulations in modes q (n,), `NOT_STARTED` before the first sample."""
        ...


class Lookahead:
    """The noise that leads to the greatest danger one sample later, by the task's own measure of it.

    Args:
        task: measures the danger.
        controller: what the noise works against.
        noise: its bound, and on which columns it acts. Of each of them both ends, the middle and zero are
            tried; with more than two columns the ends and zero.
    """

    kind = "adversarial"

    def __init__(self, task: Task, controller: Controller, noise: Noise):
        self.task, self.controller, self.bound = task, controller, noise.bound
        acts = noise.acts_on(task.noisy)
        shares = (0.0, -1.0, 1.0, -0.5, 0.5) if np.count_nonzero(acts) <= 2 else (0.0, -1.0, 1.0)
        choices = product(*[shares if hit else (0.0,) for hit in acts])
        self._candidates = noise.bound * np.array(list(choices)) * acts
        self._ahead: Plant | None = None

    def choose(self, plant: Plant, q: np.ndarray) -> np.ndarray:
        """As `Adversary.choose`. Among equals no noise is preferred, then the largest."""
        ahead = self._ahead = self._ahead or self.task.plant(plant.n)
        true, qpos, qvel = plant.measurement, plant.qpos, plant.qvel
        inputs = np.stack([self._answer(true + candidate, q) for candidate in self._candidates])
        # Where all candidates get the same answer there is nothing to choose, and each answer is tried once.
        split = (inputs != inputs[0]).any(axis=(0, 2))
        worst, chosen = np.full(plant.n, -np.inf), np.zeros_like(true)
        for i, candidate in enumerate(self._candidates):
            tried = (inputs[:i] == inputs[i]).all(axis=2).any(axis=0)
            rows = np.flatnonzero(split & ~tried)
            if not len(rows):
                continue
            ahead.set_state(qpos[rows], qvel[rows], rows)
            ahead.step(inputs[i, rows], rows)
            after = ahead.measurement[rows]
            failed = self.task.failed(after) | ahead.unstable[rows]
            danger = np.where(failed, np.inf, self.task.danger(after))
            better = rows[danger > worst[rows]]
            worst[rows] = np.maximum(worst[rows], danger)
            chosen[better] = candidate
        return chosen

    def _answer(self, measured: np.ndarray, q: np.ndarray) -> np.ndarray:
        """What the controller answers (n, m) to measurements (n, p) in modes q (n,)."""
        mode = np.where(q == NOT_STARTED, self.controller.initial_mode(measured), q)
        return self.controller.step(mode, measured)[0]
