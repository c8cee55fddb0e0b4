"""Noise that looks at the closed loop before it chooses."""

from __future__ import annotations

from itertools import product
from typing import Protocol

import numpy as np

from hyrl_mj.plant import Plant
from hyrl_mj.policies import Controller
from hyrl_mj.simulation.noise import Noise
from hyrl_mj.tasks import Outcome, Task

# Modes of runs that have not started yet: their controller picks one from the first measurement.
NOT_STARTED = -1
# How many samples a plant with inertia is followed to see what an input leads to.
AHEAD = 6
# Simulations that are looked ahead of together.
AT_ONCE = 2_048


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
        true, chosen = plant.measurement, np.zeros_like(plant.measurement)
        running = np.flatnonzero(self.task.outcome(true, plant.unstable) == Outcome.RUNNING)
        answer = np.stack(
            [np.column_stack(self._act(true[running] + c, q[running])) for c in self._candidates]
        )
        # Where all candidates get the same answer there is nothing to choose, and each answer is tried once.
        split = (answer != answer[0]).any(axis=(0, 2))
        tried = [(answer[:i] == answer[i]).all(axis=2).any(axis=0) for i in range(len(answer))]
        candidate, at = np.nonzero(split & ~np.stack(tried))
        qpos, qvel = plant.qpos[running[at]], plant.qvel[running[at]]
        danger = np.full(answer.shape[:2], -np.inf)
        for first in range(0, len(at), AT_ONCE):
            these = slice(first, first + AT_ONCE)
            danger[candidate[these], at[these]] = self._danger(
                qpos[these], qvel[these], answer[candidate[these], at[these]]
            )
        chosen[running] = self._candidates[danger.argmax(axis=0)]
        return chosen

    def _danger(self, qpos: np.ndarray, qvel: np.ndarray, answer: np.ndarray) -> np.ndarray:
        """The greatest danger (k,) that follows on answers (k, m + 1), inputs and mode, in k states."""
        ahead = self._ahead = self._ahead or self.task.plant(AT_ONCE)
        rows = np.arange(len(answer))
        worst = np.full(len(answer), -np.inf)
        ahead.set_state(qpos, qvel, rows)
        for _ in range(self.samples):
            u, q = answer[:, :-1], answer[:, -1].astype(int)
            ahead.step(u, rows)
            after = ahead.measurement[rows]
            outcome = self.task.outcome(after, ahead.unstable[rows])
            goes_on = outcome == Outcome.RUNNING
            failed = ~goes_on & (outcome != Outcome.REACHED)
            danger = np.where(failed, np.inf, self.task.danger(after))
            worst[rows] = np.maximum(worst[rows], danger)
            rows = rows[goes_on]
            if not len(rows):
                break
            answer = np.column_stack(self._act(after[goes_on], q[goes_on]))
        return worst

    def _act(self, measured: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the controller answers to measurements (n, p) in modes q (n,): inputs (n, m), modes (n,)."""
        mode = np.where(q == NOT_STARTED, self.controller.initial_mode(measured), q)
        return self.controller.step(mode, measured)
