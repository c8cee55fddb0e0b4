"""Adversarial noise that simulates the closed loop ahead before it chooses."""

from __future__ import annotations

from itertools import product
from typing import Self

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics.plant import Plant
from hyrl_mj.policies import Controller, answer, is_memory, memory_at_start
from hyrl_mj.simulation.noise import NOT_STARTED, Sample, Signal, register_noise
from hyrl_mj.tasks import Outcome, Task, check_finite

# Samples by which a plant with inertia is simulated ahead.
AHEAD = 6
# Simulations side by side.
BATCH = 2_048


def memory_of(controller: Controller, now: Sample) -> np.ndarray:
    """Returns the memory (n, ...) of a controller at a sample of n runs."""
    return memory_at_start(controller, len(now.rows)) if now.memory is None else now.memory


def answer_of(
    controller: Controller, measured: np.ndarray, q: np.ndarray, memory: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a controller's inputs (n, m), modes (n,) and next memory (n, ...) for measurements (n, p).

    Args:
        controller: the controller, which picks the mode of a run that has not begun.
        measured: (n, p) measurements.
        q: (n,) modes, or `NOT_STARTED`.
        memory: (n, ...) its memory before them.
    """
    begins = q == NOT_STARTED
    if begins.any():
        q = np.where(begins, controller.initial_mode(measured), q)
    return answer(controller, q, measured, memory)


def each_answer(
    task: Task,
    controller: Controller,
    true: np.ndarray,
    candidates: np.ndarray,
    q: np.ndarray,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a controller's answers to c candidates of the noise: (c, n, m), (c, n) and (c, n, ...).

    These are inputs, modes and memories. It is asked about several candidates at once.

    Args:
        task: tells what would be measured under noise.
        controller: the controller.
        true: (n, p) measurements without noise.
        candidates: (c, p) noise.
        q, memory: as in `answer_of`, of the n runs.
    """
    n, parts = len(true), []
    several = max(1_024 // max(n, 1), 1)  # more measurements do not stay in a processor's cache
    for first in range(0, len(candidates), several):
        some = candidates[first : first + several]
        each = np.broadcast_to(some[:, None], (len(some), *true.shape)).reshape(-1, true.shape[1])
        measured = task.perturbed(np.tile(true, (len(some), 1)), each)
        at = np.tile(np.arange(n), len(some))
        found = answer_of(controller, measured, q[at], memory[at])
        parts.append([values.reshape(len(some), n, *values.shape[1:]) for values in found])
    u, modes, after = map(np.concatenate, zip(*parts, strict=True))
    return u, modes, after


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
    farthest = AHEAD
    task: Task
    controller: Controller
    samples: int
    _candidates: np.ndarray
    _copies: Plant | None = None

    def against(self, task: Task, controller: Controller | None) -> Self:
        if self.farthest > 1 and not task.effort.looks_ahead:
            raise BadInput(
                f"adversarial noise looks ahead from the middle of episodes, where {task.name} cannot begin: "
                "use the attack (hyrl-mj robustness RUN --attack-rounds 2), or uniform or alternating noise"
            )
        signal = super().against(task, controller)
        assert controller is not None
        signal.task, signal.controller = task, controller
        signal.samples = 1 if task.kinematic else self.farthest
        signal._candidates = self.bound * self._directions(task.kinematic) * self.shares
        return signal

    def _directions(self, kinematic: bool) -> np.ndarray:
        """Returns the candidates (c, p) as shares of the bound, the first of which is no noise.

        With more than six noisy columns, combinations are too many: then the first three of them are
        combined, and each of the others acts alone.
        """
        columns = np.flatnonzero(self.shares)
        few = len(columns) if len(columns) <= 6 else 3
        first, rest = columns[:few], columns[few:]
        fine = len(columns) <= (2 if kinematic else 1)
        factors = (0.0, -1.0, 1.0, -0.5, 0.5) if fine else (0.0, -1.0, 1.0)
        combined = np.array(list(product(factors, repeat=len(first))))
        directions = np.zeros((len(combined) + 2 * len(rest), len(self.shares)))
        directions[: len(combined), first] = combined
        alone = np.arange(len(combined), len(directions)).reshape(2, -1)
        directions[alone[0], rest], directions[alone[1], rest] = -1.0, 1.0
        return directions

    def sample(self, now: Sample) -> np.ndarray:
        """Returns the most dangerous noise; among equals zero comes first, then the largest noise."""
        true, chosen = now.measurement, np.zeros_like(now.measurement)
        unstable = now.plant.unstable[now.rows]
        running = np.flatnonzero(self.task.outcome(true, unstable) == Outcome.RUNNING)
        q, rows = now.q[running], now.rows[running]
        memory = memory_of(self.controller, now)[running]
        asked = true[running], self._candidates, q, memory
        u, q, memory = each_answer(self.task, self.controller, *asked)
        answers, remembers = np.concatenate([u, q[..., None]], axis=2), is_memory(memory[0])
        # Simulate each distinct answer once, and only where the candidates' answers differ. With memory
        # the same answer to two candidates does not make them equal.
        differs = (answers != answers[0]).any(axis=(0, 2)) | remembers
        repeated = [
            (answers[:i] == answers[i]).all(axis=2).any(axis=0) & (not remembers)
            for i in range(len(answers))
        ]
        candidate, at = np.nonzero(differs & ~np.stack(repeated))
        state, danger = now.plant.state[rows[at]], np.full(answers.shape[:2], -np.inf)
        given, after = answers[candidate, at], memory[candidate, at]
        for first in range(0, len(at), BATCH):
            some = slice(first, first + BATCH)
            danger[candidate[some], at[some]] = self._ahead(state[some], given[some], after[some])
        chosen[running] = self._candidates[danger.argmax(axis=0)]
        return chosen

    def _ahead(self, state: np.ndarray, answers: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """Returns the greatest danger (k,) that simulations from whole states (k, nstate) of MuJoCo meet.

        Args:
            state: as above.
            answers: (k, m + 1) the controller's inputs and mode in these states.
            memory: (k, ...) its memory after these answers.
        """
        plant, rows = self._placed(state), np.arange(len(state))
        worst = np.full(len(state), -np.inf)
        for _ in range(self.samples):
            u, q = answers[:, :-1], answers[:, -1].astype(int)
            plant.step(u, rows)
            after = plant.measurement[rows]
            outcome = self.task.outcome(after, plant.unstable[rows])
            goes_on = outcome == Outcome.RUNNING
            failed = ~goes_on & (outcome != Outcome.REACHED)
            danger = np.where(failed, np.inf, self.task.danger(after))
            check_finite(self.task, "danger", danger, after, infinite=True)
            worst[rows] = np.maximum(worst[rows], danger)
            rows = rows[goes_on]
            if not len(rows):
                break
            u, q, memory = answer_of(self.controller, after[goes_on], q[goes_on], memory[goes_on])
            answers = np.column_stack([u, q])
        return worst

    def _placed(self, state: np.ndarray) -> Plant:
        """Returns copies of the robot, the first k of them in whole states (k, nstate) of MuJoCo."""
        self._copies = self._copies or self.task.plant(BATCH)
        self._copies.resume(state, np.arange(len(state)))
        return self._copies
