"""Noise that looks at the closed loop before it chooses."""

from __future__ import annotations

from itertools import product
from typing import Protocol

import numpy as np

from hyrl_mj.controllers import Controller
from hyrl_mj.noise import Noise
from hyrl_mj.plant import Plant
from hyrl_mj.tasks.base import Outcome, Task

# Modes of runs that have not started yet: their controller picks one from the first measurement.
NOT_STARTED = -1
# How many samples a plant with inertia is followed to see what an input leads to.
AHEAD = 8


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
    """The noise that leads into the greatest danger, by the task's own measure of it.

    A kinematic plant is looked at one sample later. With inertia one sample shows little: the closed loop
    is followed for `AHEAD` of them, the first with the noise that is tried and the rest without any.

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
        self.samples = 1 if task.kinematic else AHEAD

    def choose(self, plant: Plant, q: np.ndarray) -> np.ndarray:
        """As `Adversary.choose`. Among equals no noise is preferred, then the largest."""
        ahead = self._ahead = self._ahead or self.task.plant(plant.n)
        true, qpos, qvel = plant.measurement, plant.qpos, plant.qvel
        answers = [np.column_stack(self._act(true + c, q)) for c in self._candidates]
        answer = np.stack(answers)
        # Where all candidates get the same answer there is nothing to choose, and each answer is tried once.
        running = self.task.outcome(true, plant.unstable) == Outcome.RUNNING
        split = (answer != answer[0]).any(axis=(0, 2)) & running
        worst, chosen = np.full(plant.n, -np.inf), np.zeros_like(true)
        for i, candidate in enumerate(self._candidates):
            tried = (answer[:i] == answer[i]).all(axis=2).any(axis=0)
            rows = np.flatnonzero(split & ~tried)
            if not len(rows):
                continue
            ahead.set_state(qpos[rows], qvel[rows], rows)
            danger = self._danger(ahead, rows, answer[i, rows])
            better = rows[danger > worst[rows]]
            worst[rows] = np.maximum(worst[rows], danger)
            chosen[better] = candidate
        return chosen

    def _danger(self, ahead: Plant, rows: np.ndarray, answer: np.ndarray) -> np.ndarray:
        """The greatest danger (k,) of the simulations `rows` (k,) after answers (k, m + 1): inputs, mode."""
        worst = np.full(len(rows), -np.inf)
        under_way = np.arange(len(rows))
        for _ in range(self.samples):
            u, q = answer[:, :-1], answer[:, -1].astype(int)
            ahead.step(u, rows)
            after = ahead.measurement[rows]
            outcome = self.task.outcome(after, ahead.unstable[rows])
            goes_on = outcome == Outcome.RUNNING
            failed = ~goes_on & (outcome != Outcome.REACHED)
            danger = np.where(failed, np.inf, self.task.danger(after))
            worst[under_way] = np.maximum(worst[under_way], danger)
            rows, under_way = rows[goes_on], under_way[goes_on]
            if not len(rows):
                break
            answer = np.column_stack(self._act(after[goes_on], q[goes_on]))
        return worst

    def _act(self, measured: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the controller answers to measurements (n, p) in modes q (n,): inputs (n, m), modes (n,)."""
        mode = np.where(q == NOT_STARTED, self.controller.initial_mode(measured), q)
        return self.controller.step(mode, measured)
