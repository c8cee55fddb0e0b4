"""Adversarial noise that simulates the closed loop ahead before it chooses."""

from itertools import product
from typing import Self

import numpy as np

from hyrl_mj.plant import Plant
from hyrl_mj.policies import Controller, answer, nothing_past, remembering
from hyrl_mj.simulation.noise import NOT_STARTED, Sample, Signal, register_noise
from hyrl_mj.tasks import Outcome, Task

# Samples by which a plant with inertia is simulated ahead.
AHEAD = 6
# Simulations side by side.
BATCH = 2_048


@register_noise
class Lookahead(Signal):
    """The noise that leads into the greatest danger, by the task's own measure of it.

    A kinematic plant is simulated ahead by one sample. With inertia one sample shows little: the closed loop
    is simulated for `AHEAD` samples, the first with the candidate noise and the others without noise.

    Candidates on each noisy column are both ends of the bound, their halves and zero; with more than two
    such columns, or two and inertia, the ends and zero.

    Attributes:
        samples: number of samples by which the closed loop is simulated ahead.
    """

    kind = "adversarial"
    needs_controller = True
    task: Task
    controller: Controller
    samples: int
    _candidates: np.ndarray

    def __init__(self, bound: float, shares: np.ndarray):
        super().__init__(bound, shares)
        self._ahead: Plant | None = None

    def against(self, task: Task, controller: Controller | None) -> Self:
        signal = super().against(task, controller)
        assert controller is not None
        signal.task, signal.controller = task, controller
        signal.samples = 1 if task.kinematic else AHEAD
        fine = np.count_nonzero(self.shares) <= (2 if task.kinematic else 1)
        factors = (0.0, -1.0, 1.0, -0.5, 0.5) if fine else (0.0, -1.0, 1.0)
        choices = product(*[factors if share else (0.0,) for share in self.shares])
        signal._candidates = self.bound * np.array(list(choices)) * self.shares
        return signal

    def sample(self, now: Sample) -> np.ndarray:
        """Returns the most dangerous noise; among equals zero comes first, then the largest noise."""
        true, chosen = now.measurement, np.zeros_like(now.measurement)
        unstable = now.plant.unstable[now.rows]
        running = np.flatnonzero(self.task.outcome(true, unstable) == Outcome.RUNNING)
        q = now.q[running]
        past = nothing_past(self.controller, *true.shape) if now.past is None else now.past
        past = past[running]
        answers = np.stack(
            [np.column_stack(self._act(true[running] + c, q, past)) for c in self._candidates]
        )
        # Simulate each distinct answer once, and only where the candidates' answers differ. With memory
        # the same answer to two candidates does not make them equal.
        differs = (answers != answers[0]).any(axis=(0, 2)) | (past.shape[1] > 0)
        repeated = [
            (answers[:i] == answers[i]).all(axis=2).any(axis=0) & (past.shape[1] == 0)
            for i in range(len(answers))
        ]
        candidate, at = np.nonzero(differs & ~np.stack(repeated))
        rows = now.rows[running[at]]
        qpos, qvel = now.plant.qpos[rows], now.plant.qvel[rows]
        danger = np.full(answers.shape[:2], -np.inf)
        for first in range(0, len(at), BATCH):
            batch = slice(first, first + BATCH)
            entries = candidate[batch], at[batch]
            measured = true[running[at[batch]]] + self._candidates[candidate[batch]]
            known = remembering(past[at[batch]], measured)
            danger[entries] = self._danger(qpos[batch], qvel[batch], answers[entries], known)
        chosen[running] = self._candidates[danger.argmax(axis=0)]
        return chosen

    def _danger(
        self, qpos: np.ndarray, qvel: np.ndarray, answers: np.ndarray, past: np.ndarray
    ) -> np.ndarray:
        """Returns the greatest danger (k,) after answers (k, m + 1), inputs and mode, in k states.

        `past` (k, memory, p) are the measurements up to these answers.
        """
        ahead, rows = self._copies(), np.arange(len(answers))
        worst = np.full(len(answers), -np.inf)
        ahead.set_state(qpos, qvel, rows)
        for _ in range(self.samples):
            u, q = answers[:, :-1], answers[:, -1].astype(int)
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
            after, q, past = after[goes_on], q[goes_on], past[goes_on]
            answers = np.column_stack(self._act(after, q, past))
            past = remembering(past, after)
        return worst

    def _copies(self) -> Plant:
        """Returns the copies of the robot that are simulated ahead."""
        self._ahead = self._ahead or self.task.plant(BATCH)
        return self._ahead

    def _act(
        self, measured: np.ndarray, q: np.ndarray, past: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the controller's inputs (n, m) and modes (n,) for measurements (n, p) in modes (n,)."""
        mode = np.where(q == NOT_STARTED, self.controller.initial_mode(measured), q)
        return answer(self.controller, mode, measured, past)
