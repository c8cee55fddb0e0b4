"""Adversarial noise that simulates the closed loop ahead before it chooses."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics.plant import Plant
from hyrl_mj.policies import Controller, answer, is_memory, memory_at_start
from hyrl_mj.simulation.noise import NOT_STARTED, Sample, Signal, register_noise
from hyrl_mj.simulation.passing import Rows
from hyrl_mj.tasks import Outcome, Task, check_finite

# Samples by which a plant with inertia is simulated ahead.
AHEAD = 6
# Simulations side by side.
BATCH = 2_048


@dataclass
class Ahead(Rows):
    """What k simulations ahead show, and how they could go on.

    Attributes:
        danger: (k, samples) the danger after each sample; -inf after the end of a simulation.
        state: (k, nstate) MuJoCo's whole state after the last sample.
        answers: (k, m + 1) the controller's inputs and mode in that state.
        goes_on: (k,) bool, whether the simulation has not ended.
    """

    danger: np.ndarray
    state: np.ndarray
    answers: np.ndarray
    goes_on: np.ndarray


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

    What was simulated for the noise that was chosen is at the next sample the simulation without noise, but
    for its last sample.

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
    _kept: Ahead
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

    def reset(self, n: int, rng: np.random.Generator) -> None:
        super().reset(n, rng)
        self._kept_at = np.full(n, -2)  # the sample at which something was kept of each run

    def sample(self, now: Sample) -> np.ndarray:
        """Returns the most dangerous noise; among equals zero comes first, then the largest noise."""
        true, chosen = now.measurement, np.zeros_like(now.measurement)
        unstable = now.plant.unstable[now.rows]
        running = np.flatnonzero(self.task.outcome(true, unstable) == Outcome.RUNNING)
        q, rows, k = now.q[running], now.rows[running], now.k[running]
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
        after = answers[candidate, at], memory[candidate, at]
        runs = self._ahead(now.plant, rows[at], k[at], candidate, *after)
        danger = np.full(answers.shape[:2], -np.inf)
        danger[candidate, at] = runs.danger.max(axis=1)
        best = danger.argmax(axis=0)
        chosen[running] = self._candidates[best]
        if self.samples > 1 and not remembers:
            self._keep(now.plant.n, rows[at], k[at], runs, candidate == best[at])
        return chosen

    def _ahead(
        self,
        plant: Plant,
        rows: np.ndarray,
        k: np.ndarray,
        candidate: np.ndarray,
        answers: np.ndarray,
        memory: np.ndarray,
    ) -> Ahead:
        """Returns the simulations of candidates (c,) from the states of a plant's `rows` (c,).

        Args:
            plant, rows: as above.
            k: (c,) the number of the sample.
            candidate: (c,) indices of the candidates.
            answers: (c, m + 1) the controller's answers to them, inputs and mode.
            memory: (c, ...) its memory after these answers.
        """
        state = plant.state[rows]
        danger = np.full((len(rows), self.samples), -np.inf)
        runs = Ahead(danger, state, answers, np.ones(len(rows), dtype=bool))
        known = (candidate == 0) & (self._kept_at[rows] == k - 1)
        if known.any():
            kept = self._kept[rows[known]]
            kept.danger = np.hstack([kept.danger[:, 1:], np.full((len(kept.danger), 1), -np.inf)])
            runs.put(np.flatnonzero(known), kept)
        for some, samples in ((~known, self.samples), (known & runs.goes_on, 1)):
            numbers = np.flatnonzero(some)
            for first in range(0, len(numbers), BATCH):
                batch = numbers[first : first + BATCH]
                later = self._simulate(runs[batch], memory[batch], samples)
                later.danger = np.hstack([runs.danger[batch, :-samples], later.danger])
                runs.put(batch, later)
        return runs

    def _keep(
        self, n: int, rows: np.ndarray, k: np.ndarray, runs: Ahead, chosen: np.ndarray
    ) -> None:
        """Keeps the `chosen` (c,) bool of simulations (c,), for `rows` (c,) of n runs at samples k (c,)."""
        if (self._kept_at < 0).all():
            self._kept = Ahead(
                *(np.zeros((n, *values.shape[1:]), values.dtype) for values in vars(runs).values())
            )
        self._kept_at[rows[chosen]] = k[chosen]
        self._kept.put(rows[chosen], runs[chosen])

    def _simulate(self, begun: Ahead, memory: np.ndarray, samples: int) -> Ahead:
        """Simulates from the states of `begun` (k,), with its answers first, over so many samples.

        `memory` (k, ...) is that after these answers.
        """
        plant = self._placed(begun.state)
        answers, rows = begun.answers, np.arange(len(begun.answers))
        danger, next_answers = np.full((len(rows), samples), -np.inf), begun.answers.copy()
        for sample in range(samples):
            u, q = answers[:, :-1], answers[:, -1].astype(int)
            plant.step(u, rows)
            after = plant.measurement[rows]
            outcome = self.task.outcome(after, plant.unstable[rows])
            goes_on = outcome == Outcome.RUNNING
            failed = ~goes_on & (outcome != Outcome.REACHED)
            danger[rows, sample] = np.where(failed, np.inf, self.task.danger(after))
            check_finite(self.task, "danger", danger[rows, sample], after, infinite=True)
            rows = rows[goes_on]
            if not len(rows):
                break
            before = after[goes_on], q[goes_on], memory[goes_on]
            u, q, memory = answer_of(self.controller, *before)
            answers = np.column_stack([u, q])
        next_answers[rows] = answers[: len(rows)]
        end = plant.state[: len(danger)]
        return Ahead(danger, end, next_answers, np.isin(np.arange(len(danger)), rows))

    def _placed(self, state: np.ndarray) -> Plant:
        """Returns copies of the robot, the first k of them in whole states (k, nstate) of MuJoCo."""
        self._copies = self._copies or self.task.plant(BATCH)
        self._copies.resume(state, np.arange(len(state)))
        return self._copies
