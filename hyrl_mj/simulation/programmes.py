"""Noise signals made of simple rules, one after the other, against a controller that can be asked."""

from __future__ import annotations

from typing import Self

import numpy as np

from hyrl_mj.policies import Controller
from hyrl_mj.simulation.lookahead import answer_of, each_answer, memory_of
from hyrl_mj.simulation.noise import NOT_STARTED, Sample, Signal
from hyrl_mj.simulation.rules import RuleKind, Rules
from hyrl_mj.tasks import Outcome, Task, check_finite

# The number of a signal that is given, in a programme: no rule.
GIVEN = -1


class Programmes(Signal):
    """A programme of rules for each of n runs: a rule for each segment of time.

    The last rule holds for all that follows.

    It serves one closed loop, and remembers what it saw there.

    Args:
        task, controller: of the closed loop.
        rules: what the programmes are made of.
        programmes: (n, segments) int, rules, or `GIVEN`.
        segment: number of samples in a segment.
        given: (K, n, p) noise where a programme is `GIVEN`, and none after it; by default none at all.

    Attributes:
        danger: (n,) the greatest danger that each run has met, by the task's own measure.
        reversals: (n,) how much the answers changed from sample to sample, in shares of the input range;
            a change of the mode counts one.
        rewards: (n,) sums of the rewards.
    """

    kind = "attack"
    needs_controller = True

    def __init__(
        self,
        task: Task,
        controller: Controller,
        rules: Rules,
        programmes: np.ndarray,
        segment: int,
        given: np.ndarray | None = None,
    ):
        n, columns = len(programmes), len(rules.shares)
        super().__init__(rules.bound, rules.shares)
        self.task, self.controller, self.rules = task, controller, rules
        self.programmes, self.segment = programmes, segment
        self.given = np.zeros((0, n, columns)) if given is None else given
        self._noise, self._samples = np.zeros((task.max_steps, n, columns)), 0
        self.danger, self.reversals, self.rewards = np.full(n, -np.inf), np.zeros(n), np.zeros(n)
        self._last = np.full((n, len(task.inputs)), np.nan)
        self._first_mode = np.full(n, NOT_STARTED)

    @property
    def values(self) -> np.ndarray:
        """The noise (K, n, p) so far; none in runs that are over."""
        return self._noise[: self._samples]

    def against(self, task: Task, controller: Controller | None) -> Self:
        return self

    def reset(self, n: int, rng: np.random.Generator) -> None:
        super().reset(n, rng)
        if self.rules.lookahead is not None:
            self.rules.lookahead.reset(n, rng)

    def sample(self, now: Sample) -> np.ndarray:
        true, noise = now.measurement, np.zeros_like(now.measurement)
        rows = np.flatnonzero(
            self.task.outcome(true, now.plant.unstable[now.rows]) == Outcome.RUNNING
        )
        segment = np.minimum(now.k[rows] // self.segment, self.programmes.shape[1] - 1)
        rule = self.programmes[now.rows[rows], segment]
        turned = self._turned(now.rows, now.q)[rows]
        noise[rows] = self.rules.noise[rule] * self.rules.signs(rule, now.k[rows], turned)[:, None]
        given = rows[(rule == GIVEN) & (now.k[rows] < len(self.given))]
        noise[rows[rule == GIVEN]] = 0.0
        noise[given] = self.given[now.k[given], now.rows[given]]
        memory = memory_of(self.controller, now)
        self._fulfil(noise, rows, rule, now, memory)
        mine = rows[rule == self.rules.ahead]
        if len(mine) and self.rules.lookahead is not None:
            runs = now.rows[mine]
            part = Sample(runs, now.k[mine], true[mine], now.q[mine], now.plant, memory[mine])
            noise[mine] = self.rules.lookahead.sample(part)
        measured = self.task.perturbed(true[rows], noise[rows])
        u, q, _ = answer_of(self.controller, measured, now.q[rows], memory[rows])
        self._observe(true[rows], now.rows[rows], u, q != now.q[rows])
        self._samples = max(self._samples, int(now.k.max(initial=-1)) + 1)
        self._noise[now.k, now.rows] = noise
        return noise

    def _turned(self, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Returns which of the runs `rows` (r,) in modes q (r,) have left their first mode: (r,) bool."""
        first = self._first_mode[rows]
        self._first_mode[rows] = first = np.where(first == NOT_STARTED, q, first)
        return np.asarray(q != first)

    def _fulfil(
        self, noise: np.ndarray, rows: np.ndarray, rule: np.ndarray, now: Sample, memory: np.ndarray
    ) -> None:
        """Writes the noise of those `rows` (r,) whose `rule` (r,) is a wish into `noise` (n, p)."""
        wishful = self.rules.wishful[rule] & (rule != GIVEN)
        rows, rule = rows[wishful], rule[wishful]
        if not len(rows):
            return
        asked = now.measurement[rows], self.rules.candidates, now.q[rows], memory[rows]
        u, q, _ = each_answer(self.task, self.controller, *asked)
        u = self._scaled(u)
        usual_mode = np.where(now.q[rows] == NOT_STARTED, q[0], now.q[rows])
        # A change of the mode counts for more than any change of the inputs.
        jumps, contrary = 1e3 * (q != usual_mode), np.linalg.norm(u - u[0], axis=2)
        last = self._scaled(self._last[now.rows[rows]])
        values = {
            RuleKind.CONTRARY: contrary,
            RuleKind.STRAIGHT: -np.linalg.norm(u, axis=2),
            RuleKind.REVERSE: np.linalg.norm(u - np.where(np.isnan(last), u[0], last), axis=2),
            RuleKind.JUMP: contrary + jumps,
            RuleKind.STAY: contrary - jumps,
        }
        for number in np.unique(rule):
            asked, mine = self.rules.all[number], rule == number
            column, direction = asked.steer
            value = values.get(asked.kind, direction * u[:, :, column])
            noise[rows[mine]] = self.rules.candidates[value[:, mine].argmax(axis=0)]

    def _observe(
        self, true: np.ndarray, rows: np.ndarray, u: np.ndarray, jumped: np.ndarray
    ) -> None:
        """Notes what the runs `rows` (r,) meet in states of measurements (r, p), and their answers (r, m)."""
        danger = self.task.danger(true)
        check_finite(self.task, "danger", danger, true, infinite=True)
        self.danger[rows] = np.maximum(self.danger[rows], danger)
        self.rewards[rows] += self.task.reward(true, u)
        change = np.linalg.norm(self._scaled(u) - self._scaled(self._last[rows]), axis=1) / 2
        begun = ~np.isnan(change)
        self.reversals[rows[begun]] += change[begun] + jumped[begun]
        self._last[rows] = u

    def _scaled(self, u: np.ndarray) -> np.ndarray:
        """Returns inputs (..., m) between -1 and 1, their limits."""
        low, high = self.task.input_limits
        return np.asarray((2 * u - low - high) / (high - low))
