"""Noise signals made of simple rules, one after the other, against a controller that can be asked."""

from __future__ import annotations

from itertools import product
from typing import Self

import numpy as np

from hyrl_mj.policies import Controller, answer, nothing_past
from hyrl_mj.simulation.lookahead import Lookahead, each_answer
from hyrl_mj.simulation.noise import NOT_STARTED, Sample, Signal
from hyrl_mj.tasks import Outcome, Task

# What the answers of a controller to noise are chosen for, beside steering to either end of an input.
CONTRARY, STRAIGHT, REVERSE, JUMP, STAY = "contrary", "straight", "reverse", "jump", "stay"
# A change of the mode counts for more than any change of the inputs.
DECISIVE = 1e3


class Rules:
    """The rules for a task and a controller: each gives the noise at a sample.

    A rule is a constant noise at the ends of the bound, one whose sign alternates, or a wish about the
    controller's answer: of a few candidates it takes the noise whose answer fulfils the wish best.

    - contrary: the answer that differs most from that to no noise, which keeps a run undecided.
    - straight: the answer nearest to the middle of the input limits, which turns neither way.
    - reverse: the answer that differs most from the one before.
    - jump, stay: as contrary, but before all else with another mode, or with the same.
    - to the lower or upper end of an input.
    - ahead: not asked but simulated, the noise of `Lookahead`, which takes far longer than the others.

    Args:
        task, controller: of the closed loop.
        bound: largest magnitude eps >= 0 of the noise, in the unit of the measurement.
        shares: (p,) how much of the bound acts on each column of the measurement.

    Attributes:
        bound, shares: as above.
        candidates: (c, p) noise that wishes choose from, the first of which is none.
        fixed: (rules, p) noise of the rules that are no wishes; zero for the others.
        alternates: (rules,) bool, whether the sign of this noise alternates.
        wishes: for each rule its wish: None, a word, or the column and direction to steer to.
        lookahead: gives the noise of the rule `ahead`; None where nothing can be simulated ahead.
    """

    def __init__(self, task: Task, controller: Controller, bound: float, shares: np.ndarray):
        self.bound, self.shares = bound, shares
        self.candidates = bound * _directions(shares != 0) * shares
        wishes: list[str | tuple[int, int]] = [CONTRARY, STRAIGHT, REVERSE]
        if len(controller.modes) > 1:
            wishes += [JUMP, STAY]
        wishes += list(product(range(len(task.inputs)), (1, -1)))
        at_ends = np.abs(self.candidates) == bound * np.abs(shares)
        # With many noisy columns the candidates are not all ends, because there are too many of those.
        ends = self.candidates[at_ends.all(axis=1) | (np.count_nonzero(shares) > 3)]
        ends = ends[ends.any(axis=1)]
        first_noise = ends[np.arange(len(ends)), (ends != 0).argmax(axis=1)]
        alternating = ends[first_noise > 0]
        no_noise = np.zeros((len(wishes), len(shares)))
        # Searches try the rules in this order: wishes break the most, and episodes have alternating noise.
        self.fixed = np.vstack([no_noise, ends, alternating, no_noise[:2]])
        self.alternates = np.zeros(len(self.fixed), dtype=bool)
        self.alternates[len(wishes) + len(ends) : -2] = True
        self.wishes = [*wishes, *[None] * (len(self.fixed) - len(wishes))]
        # An environment cannot be simulated ahead from the middle of an episode.
        self.lookahead = (
            Lookahead(bound, shares).against(task, controller)
            if task.abilities.restarts and task.effort.looks_ahead
            else None
        )

    def __len__(self) -> int:
        return len(self.fixed)

    @property
    def nothing(self) -> int:
        """The rule without noise."""
        return len(self) - 2

    @property
    def ahead(self) -> int:
        """The rule that simulates ahead, which is the last one."""
        return len(self) - 1


def _directions(noisy: np.ndarray) -> np.ndarray:
    """Returns the candidates (c, p) as shares of the bound, for the noisy columns (p,) bool.

    These are all combinations of zero and the ends, of one or two columns of their halves too, and of one of
    the quarters; with more than three columns the ends of each alone, and of all together.
    """
    columns = np.flatnonzero(noisy)
    count = len(columns)
    if count <= 3:
        factors = (0.0, 1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 0.75, -0.75)
        some = factors[: {1: 9, 2: 5}.get(count, 3)]
        table = np.array(list(product(some, repeat=count)))
    else:
        one = np.vstack([np.ones((1, count)), np.eye(count)])
        table = np.vstack([np.zeros((1, count)), one, -one])
    directions = np.zeros((len(table), len(noisy)))
    directions[:, columns] = table
    return directions


class Programmes(Signal):
    """A programme of rules for each of n runs: a rule for each segment of time.

    The last rule holds for all that follows.

    It serves one closed loop, and remembers what it saw there.

    Args:
        task, controller: of the closed loop.
        rules: what the programmes are made of.
        programmes: (n, segments) int, rules.
        segment: number of samples in a segment.

    Attributes:
        danger: (n,) the greatest danger that each run has met, by the task's own measure.
        reversals: (n,) how much the answers changed from sample to sample, in shares of the input range;
            a change of the mode counts one.
        rewards: (n,) sums of the rewards.
    """

    kind = "attack"
    needs_controller = True

    def __init__(
        self, task: Task, controller: Controller, rules: Rules, programmes: np.ndarray, segment: int
    ):
        n, columns = len(programmes), rules.fixed.shape[1]
        super().__init__(rules.bound, rules.shares)
        self.task, self.controller, self.rules = task, controller, rules
        self.programmes, self.segment = programmes, segment
        self._noise, self._samples = np.zeros((task.max_steps, n, columns)), 0
        self.danger, self.reversals, self.rewards = np.full(n, -np.inf), np.zeros(n), np.zeros(n)
        self._last = np.full((n, len(task.inputs)), np.nan)

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
        odd = (now.k[rows] % 2).astype(bool)
        sign = np.where(self.rules.alternates[rule] & odd, -1.0, 1.0)
        noise[rows] = self.rules.fixed[rule] * sign[:, None]
        past = nothing_past(self.controller, *true.shape) if now.past is None else now.past
        self._fulfil(noise, rows, rule, now, past)
        mine = rows[rule == self.rules.ahead]
        if len(mine) and self.rules.lookahead is not None:
            runs = now.rows[mine]
            part = Sample(runs, now.k[mine], true[mine], now.q[mine], now.plant, past[mine])
            noise[mine] = self.rules.lookahead.sample(part)
        measured = self.task.perturbed(true[rows], noise[rows])
        u, q = self._answers(measured, now.q[rows], past[rows])
        self._observe(true[rows], now.rows[rows], u, q != now.q[rows])
        self._samples = max(self._samples, int(now.k.max(initial=-1)) + 1)
        self._noise[now.k, now.rows] = noise
        return noise

    def _fulfil(
        self, noise: np.ndarray, rows: np.ndarray, rule: np.ndarray, now: Sample, past: np.ndarray
    ) -> None:
        """Writes the noise of those `rows` (r,) whose `rule` (r,) is a wish into `noise` (n, p)."""
        wishful = np.array([wish is not None for wish in self.rules.wishes])[rule]
        rows, rule = rows[wishful], rule[wishful]
        if not len(rows):
            return
        true, candidates = now.measurement[rows], self.rules.candidates
        answers = [
            *each_answer(self.task, self._answers, true, candidates, now.q[rows], past[rows])
        ]
        u, q = (np.concatenate(parts) for parts in zip(*answers, strict=True))
        u = self._scaled(u)
        usual_mode = np.where(now.q[rows] == NOT_STARTED, q[0], now.q[rows])
        jumps, contrary = DECISIVE * (q != usual_mode), np.linalg.norm(u - u[0], axis=2)
        last = self._scaled(self._last[now.rows[rows]])
        values = {
            CONTRARY: contrary,
            STRAIGHT: -np.linalg.norm(u, axis=2),
            REVERSE: np.linalg.norm(u - np.where(np.isnan(last), u[0], last), axis=2),
            JUMP: contrary + jumps,
            STAY: contrary - jumps,
        }
        for number in np.unique(rule):
            wish, mine = self.rules.wishes[number], rule == number
            if isinstance(wish, str):
                value = values[wish]
            else:
                assert wish is not None
                column, direction = wish
                value = direction * u[:, :, column]
            noise[rows[mine]] = self.rules.candidates[value[:, mine].argmax(axis=0)]

    def _observe(
        self, true: np.ndarray, rows: np.ndarray, u: np.ndarray, jumped: np.ndarray
    ) -> None:
        """Notes what the runs `rows` (r,) meet in states of measurements (r, p), and their answers (r, m)."""
        self.danger[rows] = np.maximum(self.danger[rows], self.task.danger(true))
        self.rewards[rows] += self.task.reward(true, u)
        change = np.linalg.norm(self._scaled(u) - self._scaled(self._last[rows]), axis=1) / 2
        begun = ~np.isnan(change)
        self.reversals[rows[begun]] += change[begun] + jumped[begun]
        self._last[rows] = u

    def _scaled(self, u: np.ndarray) -> np.ndarray:
        """Returns inputs (..., m) between -1 and 1, their limits."""
        low, high = self.task.input_limits
        return np.asarray((2 * u - low - high) / (high - low))

    def _answers(
        self, measured: np.ndarray, q: np.ndarray, past: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the controller's inputs (r, m) and modes (r,) for measurements (r, p) in modes (r,)."""
        begins = q == NOT_STARTED
        if begins.any():
            q = np.where(begins, self.controller.initial_mode(measured), q)
        return answer(self.controller, q, measured, past)
