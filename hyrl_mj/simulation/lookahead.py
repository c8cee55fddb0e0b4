"""Noise that looks at the closed loop before it chooses."""

from __future__ import annotations

from itertools import product
from typing import Self

import numpy as np

from hyrl_mj.plant import Plant
from hyrl_mj.policies import Controller
from hyrl_mj.simulation.noise import NOT_STARTED, Sample, Signal, check_controller, register_noise
from hyrl_mj.tasks import Outcome, Task

# How many samples a plant with inertia is followed to see what an input leads to.
AHEAD = 6
# Simulations that are followed side by side.
AT_ONCE = 2_048


@register_noise
class Lookahead(Signal):
    """The noise that leads into the greatest danger, by the task's own measure of it.

    A kinematic plant is looked at one sample later. With inertia one sample shows little: the closed loop
    is followed for `AHEAD` of them, the first with the noise that is tried and the rest without any.

    On each column that noise acts on, both ends of the bound, their halves and zero are tried; with more
    than two such columns the ends and zero.

    Attributes:
        samples: how many samples the closed loop is followed.
    """

    kind = "adversarial"
    task: Task
    controller: Controller
    samples: int

    def __init__(self, bound: float, shares: np.ndarray):
        super().__init__(bound, shares)
        tried = (0.0, -1.0, 1.0, -0.5, 0.5) if np.count_nonzero(shares) <= 2 else (0.0, -1.0, 1.0)
        choices = product(*[tried if share else (0.0,) for share in shares])
        self._candidates = bound * np.array(list(choices)) * shares
        self._ahead: Plant | None = None

    def against(self, task: Task, controller: Controller | None) -> Self:
        signal = super().against(task, controller)
        signal.task, signal.controller = task, check_controller(controller, self.kind)
        signal.samples = 1 if task.kinematic else AHEAD
        return signal

    def sample(self, now: Sample) -> np.ndarray:
        """As `Signal.sample`. Among equals no noise is preferred, then the largest."""
        true, chosen = now.measurement, np.zeros_like(now.measurement)
        unstable = now.plant.unstable[now.rows]
        running = np.flatnonzero(self.task.outcome(true, unstable) == Outcome.RUNNING)
        q = now.q[running]
        answer = np.stack(
            [np.column_stack(self._act(true[running] + c, q)) for c in self._candidates]
        )
        # Where all candidates get the same answer there is nothing to choose, and each answer is tried once.
        split = (answer != answer[0]).any(axis=(0, 2))
        tried = [(answer[:i] == answer[i]).all(axis=2).any(axis=0) for i in range(len(answer))]
        candidate, at = np.nonzero(split & ~np.stack(tried))
        rows = now.rows[running[at]]
        qpos, qvel = now.plant.qpos[rows], now.plant.qvel[rows]
        danger = np.full(answer.shape[:2], -np.inf)
        for first in range(0, len(at), AT_ONCE):
            these = slice(first, first + AT_ONCE)
            danger[candidate[these], at[these]] = self._danger(
                qpos[these], qvel[these], answer[candidate[these], at[these]]
            )
        chosen[running] = self._candidates[danger.argmax(axis=0)]
        return chosen

    def _danger(self, qpos: np.ndarray, qvel: np.ndarray, answer: np.ndarray) -> np.ndarray:
        """Returns the greatest danger (k,) after answers (k, m + 1), inputs and mode, in k states."""
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
        """Returns the controller's inputs (n, m) and modes (n,) for measurements (n, p) in modes (n,)."""
        mode = np.where(q == NOT_STARTED, self.controller.initial_mode(measured), q)
        return self.controller.step(mode, measured)
