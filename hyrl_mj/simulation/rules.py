"""The rules that noise signals of an attack are made of, in one order for every controller; its settings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import product
from typing import Annotated

import numpy as np

from hyrl_mj.policies import Controller
from hyrl_mj.ranges import Checked, Integer, Number
from hyrl_mj.simulation.lookahead import Lookahead
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class AttackSettings(Checked):
    """What an attack tries, in all stages that attack. No preset changes the defaults.

    Attributes:
        flips: times at which the sign of a signal changes once, spread over the length of a run.
        period_step: of two neighbouring periods of alternating signals the longer is longer by this share: a
            resonance with a quality factor of five still answers to the nearer of them.
        segments: segments of a programme of rules, each of the same time; together as long as a run without
            noise.
        population: signals that are tried in a round from each start, after one that won from a start nearby.
        elites: the best programmes so far, for each start and goal, that new ones are drawn from.
        explore: share of the segments of new programmes that take any rule instead.
        focused: open starts, the most dangerous ones, at which levels and switching times are evolved.
        offspring: signals in a generation of that evolution.
        pieces: pieces of such a signal, within each of which its level or its period stays.
        spread: standard deviation of the numbers with which the evolution begins. A level is twice its
            number, and beyond 1 the end of the bound: about a third of the first levels lie there.
    """

    flips: Annotated[int, Integer(1, 1_000)] = 8
    period_step: Annotated[float, Number(0.01, 10)] = 0.2
    segments: Annotated[int, Integer(1, 1_000)] = 10
    population: Annotated[int, Integer(1, 1_000)] = 8
    elites: Annotated[int, Integer(1, 1_000)] = 3
    explore: Annotated[float, Number(0, 1)] = 0.25
    focused: Annotated[int, Integer(1, 1_000)] = 16
    offspring: Annotated[int, Integer(2, 1_000)] = 12
    pieces: Annotated[int, Integer(1, 100)] = 4
    spread: Annotated[float, Number(0, 10, above=True)] = 0.5


class RuleKind(StrEnum):
    """The kinds of rules; the first six, `WISHES`, say what a controller's answer to noise is chosen for."""

    CONTRARY = "contrary"
    STRAIGHT = "straight"
    REVERSE = "reverse"
    JUMP = "jump"
    STAY = "stay"
    STEER = "steer"
    CONSTANT = "constant"
    ALTERNATING = "alternating"
    FLIP = "flip"
    PERIODIC = "periodic"
    TURN = "turn"
    NOTHING = "none"
    AHEAD = "ahead"


WISHES = tuple(RuleKind)[:6]
# With more noisy columns than this, rules of noise act on each of them alone and on all together, since
# their combinations are too many.
COMBINED = 3


@dataclass(frozen=True)
class Rule:
    """What noise does during a segment of a programme.

    Attributes:
        kind: its kind; the same for both signs and for all columns, periods and times.
        noise: (p,) the noise; zero of a rule that chooses it.
        period: number of samples after which the sign has changed twice; 0 where it never changes.
        flip: the sample from which the sign is the other one; 0 where it stays.
        steer: the column and the direction of the input to steer to.
    """

    kind: RuleKind
    noise: np.ndarray
    period: int = 0
    flip: int = 0
    steer: tuple[int, int] = (0, 0)


class Rules:
    """The rules for a task and a controller: each gives the noise at a sample.

    A rule is a constant noise at the ends of the bound; one whose sign changes once, with a period, or with
    the mode; or a wish about the controller's answer: of a few candidates it takes the noise whose answer
    fulfils the wish best.

    - contrary: the answer that differs most from that to no noise, which keeps a run undecided.
    - straight: the answer nearest to the middle of the input limits, which turns neither way.
    - reverse: the answer that differs most from the one before.
    - steer: to the lower or upper end of an input.
    - jump, stay: as contrary, but before all else with another mode, or with the same.
    - ahead: not asked but simulated, the noise of `Lookahead`, which takes far longer than the others.

    `common` does not depend on the controller. What only a controller with several modes can be tried with
    is in `own`, beside it.

    Args:
        task, controller: of the closed loop.
        bound: largest magnitude eps >= 0 of the noise, in the unit of the measurement.
        shares: (p,) how much of the bound acts on each column of the measurement.
        length: the length of a run without noise [samples], over which the times of flips are spread; by
            default that of an episode.
        settings: at how many times, and with which periods, signs change.

    Attributes:
        bound, shares: as above.
        candidates: (c, p) noise that wishes choose from, the first of which is none.
        all: the rules.
        nothing, ahead: the indices of the last two of them: without noise, and by `lookahead`.
        common: indices of the rules that every controller is tried with, in this order.
        own: indices of the rules for a controller with several modes; none for others.
        parts: indices of the rules that programmes of several segments are drawn from.
        lookahead: gives the noise of the rule `ahead`; None where nothing can be simulated ahead.
    """

    def __init__(
        self,
        task: Task,
        controller: Controller,
        bound: float,
        shares: np.ndarray,
        length: int | None = None,
        settings: AttackSettings = AttackSettings(),
    ):
        self.bound, self.shares = bound, shares
        self.candidates = bound * _directions(shares != 0) * shares
        none, ends = np.zeros(len(shares)), list(self._ends())
        wishes = [Rule(kind, none) for kind in WISHES[:3]]
        directions = product(range(len(task.inputs)), (1, -1))
        wishes += [Rule(RuleKind.STEER, none, steer=direction) for direction in directions]
        own = []
        if len(controller.modes) > 1:
            own = [Rule(kind, none) for kind in (RuleKind.JUMP, RuleKind.STAY)]
            own += [Rule(RuleKind.TURN, sign * noise) for noise in ends for sign in (1, -1)]
        common = [*wishes]
        for noise in ends or [none]:
            common += [Rule(RuleKind.CONSTANT, sign * noise) for sign in (1, -1)]
            common.append(Rule(RuleKind.ALTERNATING, noise, period=2))
        common += _timed((ends or [none])[0], length or task.max_steps, settings)
        self.all = [*common, *own, Rule(RuleKind.NOTHING, none), Rule(RuleKind.AHEAD, none)]
        self.own = np.arange(len(common), len(common) + len(own))
        self.nothing, self.ahead = len(self.all) - 2, len(self.all) - 1
        # An environment cannot be simulated ahead from the middle of an episode.
        self.lookahead = (
            Lookahead(bound, shares).against(task, controller)
            if task.abilities.restarts and task.effort.looks_ahead
            else None
        )
        self.common = np.arange(len(common))
        if self.lookahead is not None:  # it is the strongest, and takes longer than the others
            self.common = np.insert(self.common, len(wishes) + 3, self.ahead)
        timed = (RuleKind.FLIP, RuleKind.PERIODIC)
        held = [number for number, rule in enumerate(self.all) if rule.kind not in timed]
        self.parts = np.array(held[:-1])  # without `ahead`
        self.noise = np.array([rule.noise for rule in self.all])
        self.period = np.array([rule.period for rule in self.all])
        self.flip = np.array([rule.flip for rule in self.all])
        self.turns = np.array([rule.kind == RuleKind.TURN for rule in self.all])
        self.wishful = np.array([rule.kind in WISHES for rule in self.all])

    def signs(self, rule: np.ndarray, k: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """Returns the signs (r,) of the noise of rules (r,) at samples k (r,).

        `turned` (r,) bool tells which runs have left their first mode.
        """
        period, flip = self.period[rule], self.flip[rule]
        halves = np.where(period > 0, 2 * k // np.maximum(period, 1), 0)
        other = (halves % 2 == 1) ^ ((flip > 0) & (k >= flip)) ^ (self.turns[rule] & turned)
        return np.where(other, -1.0, 1.0)

    def _ends(self) -> Iterator[np.ndarray]:
        """Yields the ends (p,) of the noise, up to their sign: on all columns, then on each of them alone."""
        noisy = np.flatnonzero(self.shares)
        signs = [(1.0, -1.0) if len(noisy) <= COMBINED else (1.0,)] * max(len(noisy) - 1, 0)
        together = [(1.0, *rest) for rest in product(*signs)] if len(noisy) > 1 else []
        for factors in (*together, *np.eye(len(noisy))):
            noise = np.zeros(len(self.shares))
            noise[noisy] = np.array(factors) * self.bound * self.shares[noisy]
            yield noise


def _timed(noise: np.ndarray, length: int, settings: AttackSettings) -> Iterator[Rule]:
    """Yields the rules of a noise (p,) that turns once, or with a period, in runs of a length."""
    flips, ratio = settings.flips, 1 + settings.period_step
    times = np.ceil(length * np.arange(1, flips + 1) / (flips + 1)).astype(int)
    for flip in np.unique(times[times > 0]):
        yield from (Rule(RuleKind.FLIP, sign * noise, flip=int(flip)) for sign in (1, -1))
    periods = 3 * ratio ** np.arange(math.ceil(math.log(max(length, 3), ratio)))
    for period in np.unique(np.rint(periods[periods <= length]).astype(int)):
        yield Rule(RuleKind.PERIODIC, noise, period=int(period))


def _directions(noisy: np.ndarray) -> np.ndarray:
    """Returns the candidates (c, p) as shares of the bound, for the noisy columns (p,) bool.

    These are all combinations of zero and the ends, of one or two columns of their halves too, and of one of
    the quarters; with more than `COMBINED` columns the ends of each alone, and of all together.
    """
    columns = np.flatnonzero(noisy)
    count = len(columns)
    if count <= COMBINED:
        factors = (0.0, 1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 0.75, -0.75)
        some = factors[: {1: 9, 2: 5}.get(count, 3)]
        table = np.array(list(product(some, repeat=count)))
    else:
        one = np.vstack([np.ones((1, count)), np.eye(count)])
        table = np.vstack([np.zeros((1, count)), one, -one])
    directions = np.zeros((len(table), len(noisy)))
    directions[:, columns] = table
    return directions
