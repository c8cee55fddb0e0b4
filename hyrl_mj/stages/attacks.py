"""An attack on closed loops: a search for noise signals that make them fail, where no game decides.

The search goes over programmes of simple rules by the cross-entropy method. What it reports as lost has been
lost again under the recorded signal, which knows nothing of the loop any more.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hyrl_mj.errors import BadInput, check_seed
from hyrl_mj.game import AttackCount
from hyrl_mj.policies import Controller
from hyrl_mj.simulation import (
    HybridArc,
    LoopSettings,
    Noise,
    Programmes,
    Recorded,
    Rules,
    closed_loop,
    simulate_batch,
)
from hyrl_mj.stages.episodes import Regions
from hyrl_mj.tasks import Outcome, Task

# The longest attack [s], a day, and the most rounds.
LONGEST, MOST_ROUNDS = 86_400.0, 100_000
# Segments of a programme, each of the same time; together as long as a run without noise.
SEGMENTS = 10
# What is looked for in programmes that do not win yet: danger on the way, late arrival, dithering.
GOALS = 3
# Programmes that are tried in a round from each start: some that won from starts nearby, and one a goal.
COPIED = 1
POPULATION = COPIED + GOALS
# The place, among the rules that the first rounds hold throughout, of the noise of `Lookahead`. It takes
# longer than others, and two rounds are usual.
LOOKS_AHEAD = 2 * POPULATION - 1
# The best programmes so far, for each start and goal, that new ones are drawn from; and the share of the
# segments that take any rule instead.
ELITES, EXPLORE = 3, 0.25
# How often starts are drawn until enough of them are winnable.
MOST_DRAWS = 100
# Runs that are simulated at once, which limits the memory.
BATCH = 4_096


@dataclass(frozen=True)
class Budget:
    """How long an attack lasts: a time, or a number of rounds.

    The rounds are the same in both cases: the time only decides how many of them are done. At least one is.

    Attributes:
        seconds: time [s]; a round that would take longer than what is left of it does not begin.
        rounds: number of rounds.
        enough: no round follows one after which each controller has lost so many starts; by default all.
    """

    seconds: float | None = None
    rounds: int | None = None
    enough: int | None = None

    def __post_init__(self) -> None:
        if (self.seconds is None) == (self.rounds is None):
            raise BadInput("an attack has a time or a number of rounds: give one of the two")
        if self.seconds is not None and not (
            math.isfinite(self.seconds) and 0 < self.seconds <= LONGEST
        ):
            raise BadInput(
                f"an attack cannot last {self.seconds:g} s: give a time > 0 and <= {LONGEST:g} s"
            )
        if self.rounds is not None and not 1 <= self.rounds <= MOST_ROUNDS:
            raise BadInput(
                f"an attack cannot have {self.rounds} rounds: give a number from 1 to {MOST_ROUNDS}"
            )


@dataclass(frozen=True)
class Attack:
    """The strongest signals that were found against one controller.

    Attributes:
        count: from how many starts it loses.
        signal: the strongest signal that is known for each start.
        arcs: the run from each start under its signal.
        strongest: index of the start of the strongest signal: of the earliest failure, or where nothing is
            lost of the run with the greatest danger.
    """

    count: AttackCount
    signal: Recorded
    arcs: tuple[HybridArc, ...]
    strongest: int

    @staticmethod
    def from_arcs(
        arcs: Sequence[HybridArc],
        signal: Recorded,
        dangerous: int,
        controller: str,
        everywhere: bool,
        rounds: int,
        seconds: float | None,
    ) -> Attack:
        """Returns the attack of recorded signals, with the arcs under them.

        Args:
            arcs: of the controller, from each start.
            signal: the signals.
            dangerous: index of the start of the greatest danger.
            controller, everywhere, rounds, seconds: as in `AttackCount`.
        """
        from scipy.stats import binomtest  # slow to import, and seldom needed

        lost = np.array([arc.outcome != Outcome.REACHED.label for arc in arcs])
        ends = np.where(lost, [arc.t[-1] for arc in arcs], np.inf)
        strongest = int(np.argmin(ends)) if lost.any() else dangerous
        interval = binomtest(int(lost.sum()), len(lost)).proportion_ci(0.95, method="wilson")
        count = AttackCount(
            controller=controller,
            eps=signal.bound,
            everywhere=everywhere,
            starts=len(lost),
            lost=int(lost.sum()),
            interval=(float(interval.low), float(interval.high)),
            rounds=rounds,
            seconds=seconds,
            start=tuple(map(float, arcs[strongest].z[0])),
            outcome=arcs[strongest].outcome,
        )
        return Attack(count, signal, tuple(arcs), strongest)

    def on(self, name: str, task: Task, controller: Controller) -> Attack:
        """Returns the attack of the same signals on another controller, of a name."""
        starts = np.array([arc.z[0] for arc in self.arcs])
        arcs = simulate_batch(task, controller, starts, self.signal)
        count = self.count
        return Attack.from_arcs(
            arcs, self.signal, self.strongest, name, count.everywhere, count.rounds, count.seconds
        )


def attack_starts(task: Task, regions: Regions, bound: float, n: int, seed: int) -> np.ndarray:
    """Returns n starts (n, d): half of them within twice the bound of M*.

    The others are drawn as the task draws them; so are all where M* is empty or far from the starts. Where
    it is known which starts are winnable, only these are taken: fewer than n if they are rare. If none is
    found, all starts are taken.
    """
    check_seed(seed)
    rng = np.random.default_rng([seed, 2])

    def drawn(where: Regions, count: int) -> np.ndarray:
        kept = np.empty((0, task.chart.dimension))
        for _ in range(MOST_DRAWS if count else 0):
            z = where.draw(task, bound, count, rng)
            kept = np.vstack([kept, z[regions.may_win(z)]])
            if len(kept) >= count:
                break
        return kept[:count]

    near = np.empty((0, task.chart.dimension))
    with suppress(BadInput):  # where no start lies near M*
        near = drawn(replace(regions, near=True), n // 2)
    starts = np.vstack([near, drawn(replace(regions, near=False), n - len(near))])
    return starts if len(starts) else task.starts(n, rng)


def shown_arcs(attacks: Mapping[str, Attack]) -> dict[str, HybridArc]:
    """Returns the arc of each controller from one start under its own strongest signal from there.

    The start is that of the strongest signal against the last controller that loses any, or if none does
    against the last one.
    """
    losing = [found for found in attacks.values() if found.count.lost] or [*attacks.values()]
    return {name: found.arcs[losing[-1].strongest] for name, found in attacks.items()}


def attack(
    task: Task,
    controllers: Mapping[str, Controller],
    starts: np.ndarray,
    bound: float,
    budget: Budget,
    everywhere: bool = False,
    seed: int = 0,
) -> dict[str, Attack]:
    """Searches for noise signals that make closed loops fail.

    Each round tries `POPULATION` signals from every start of every controller that nothing has broken yet.
    The first rounds hold each rule of `Rules` throughout, the second among others that which simulates ahead.
    Later ones
    follow programmes that vary and join the best so far, and those that won from starts nearby. The
    coordinates outside the chart begin at their usual values.

    Args:
        task: the robot and its problem.
        controllers: by name.
        starts: (n, d) chart points, the same for all controllers.
        bound: largest magnitude eps >= 0 of the noise, in the unit of the measurement.
        budget: how long to search.
        everywhere: whether the noise acts on all columns of the measurement, not only on the noisy ones.
        seed: seed of the search.

    Returns:
        The attack on each controller, by name. The same rounds give the same on any number of threads.

    Raises:
        BadInput: starts outside the chart, or a bound or a seed that cannot be used.
    """
    check_seed(seed)
    starts = task.chart.check(starts, task.name)
    shares = Noise("none", bound, everywhere).against(task, None).shares
    began = time.monotonic()
    searches = {
        name: _Search(task, loop, starts, Rules(task, loop, bound, shares), seed)
        for name, loop in controllers.items()
    }
    rounds, enough = 0, min(budget.enough or len(starts), len(starts))
    while any(np.sum(~search.open) < enough for search in searches.values()) or not rounds:
        rounds, before = rounds + 1, time.monotonic() - began
        for search in searches.values():
            search.round(rounds)
        after = time.monotonic() - began
        # The next round will take about as long as this one.
        late = budget.seconds is not None and after + (after - before) > budget.seconds
        if late or rounds == budget.rounds:
            break
    return {
        name: search.result(name, everywhere, rounds, budget.seconds)
        for name, search in searches.items()
    }


class _Search:
    """The search for signals against one controller.

    Attributes:
        open: (n,) bool, the starts that nothing has broken yet.
        signals: (K, n, p) the strongest signal for each start so far.
    """

    def __init__(
        self, task: Task, controller: Controller, starts: np.ndarray, rules: Rules, seed: int
    ):
        self.task, self.controller, self.starts = task, controller, starts
        self.rules, self.seed = rules, seed
        self._label = "attack, without noise"
        n, self.segment = len(starts), task.max_steps
        self.open = np.ones(n, dtype=bool)
        self.signals = np.zeros((task.max_steps, n, rules.fixed.shape[1]))
        self._worst = np.full(n, -np.inf)
        self._winners = np.zeros((n, SEGMENTS), dtype=int)
        self._elites = np.full((n, GOALS, ELITES, SEGMENTS), rules.nothing)
        self._values = np.full((n, GOALS, ELITES), -np.inf)
        self._tried: list[set[bytes]] = [set() for _ in starts]
        without = np.full((n, 1, SEGMENTS), rules.nothing)
        lengths = self._try(np.arange(n), without)
        self.segment = max(math.ceil(np.median(lengths) / SEGMENTS), 1)

    def round(self, number: int) -> None:
        """Tries some programmes from each open start; the rounds are numbered from 1."""
        rows, self._label = np.flatnonzero(self.open), f"attack, round {number}"
        if len(rows):
            self._try(rows, self._population(rows, number))

    def _population(self, rows: np.ndarray, number: int) -> np.ndarray:
        """Returns the programmes (r, POPULATION, SEGMENTS) that a round tries from the starts `rows` (r,)."""
        rng = np.random.default_rng([self.seed, number])
        shape = len(rows), POPULATION, SEGMENTS
        goal = np.broadcast_to(np.arange(POPULATION)[:, None] % GOALS, shape)
        elite, segment = rng.integers(ELITES, size=shape), np.arange(SEGMENTS)
        drawn = self._elites[rows[:, None, None], goal, elite, segment]
        explores = rng.random(shape) < EXPLORE
        programmes = np.where(explores, rng.integers(self.rules.ahead, size=shape), drawn)
        rules = np.arange(self.rules.nothing)
        if self.rules.lookahead is not None:
            rules = np.insert(rules, min(LOOKS_AHEAD, len(rules)), self.rules.ahead)
        held = rules[(number - 1) * POPULATION : number * POPULATION]
        programmes[:, : len(held)] = held[:, None]
        lost = np.flatnonzero(~self.open)
        for row, mine in zip(rows, programmes[:, len(held) :][:, :COPIED], strict=True):
            copies = self._from_nearby(row, lost)[: len(mine)]
            mine[: len(copies)] = np.reshape(copies, (-1, SEGMENTS))
        return programmes

    def _from_nearby(self, row: int, lost: np.ndarray) -> list[np.ndarray]:
        """Returns programmes that broke the starts `lost`, the nearest first, but were not tried at a row."""
        if not len(lost):
            return []
        chart = self.task.chart
        away = chart.difference(self.starts[lost], self.starts[row]) / chart.sides
        nearest = lost[np.argsort(np.linalg.norm(away, axis=1), kind="stable")]
        programmes = {self._winners[i].tobytes(): self._winners[i] for i in nearest}
        return [p for key, p in programmes.items() if key not in self._tried[row]]

    def _try(self, rows: np.ndarray, programmes: np.ndarray) -> np.ndarray:
        """Simulates programmes (r, population, SEGMENTS) from the starts `rows` (r,), and keeps the best.

        Returns:
            (r, population) the lengths of the runs [samples].
        """
        r, population = programmes.shape[:2]
        each, flat = np.repeat(rows, population), programmes.reshape(-1, SEGMENTS)
        length = np.empty(len(each), dtype=int)
        for first in range(0, len(each), BATCH):
            batch = slice(first, first + BATCH)
            length[batch] = self._simulate(each[batch], flat[batch])
        return length.reshape(r, population)

    def _simulate(self, rows: np.ndarray, programmes: np.ndarray) -> np.ndarray:
        """Simulates a programme from each of the starts `rows` (k,), and returns the lengths (k,)."""
        signal = Programmes(self.task, self.controller, self.rules, programmes, self.segment)
        settings = LoopSettings(label=self._label)
        run = closed_loop(self.task, self.controller, self.starts[rows], signal, settings=settings)
        lost = run.outcome != Outcome.REACHED
        mean = signal.rewards / np.maximum(run.length, 1)
        # Among runs of equal length the one with the least reward counts as the latest.
        late = run.length - mean / (1 + np.abs(mean)) / 2
        values = np.stack([signal.danger, late, signal.reversals], axis=1)
        noise = np.reshape(signal.values, (-1, len(rows), self.signals.shape[2]))
        for i, row in enumerate(rows):
            self._tried[row].add(programmes[i].tobytes())
            if not self.open[row]:
                continue
            if lost[i] or signal.danger[i] > self._worst[row]:
                self._worst[row] = signal.danger[i]
                self.signals[: len(noise), row], self.signals[len(noise) :, row] = noise[:, i], 0.0
            if lost[i]:
                self.open[row], self._winners[row] = False, programmes[i]
            for goal, value in enumerate(values[i]):
                elites, least = self._elites[row, goal], self._values[row, goal].argmin()
                if value > self._values[row, goal, least]:
                    elites[least], self._values[row, goal, least] = programmes[i], value
        return run.length

    def result(self, name: str, everywhere: bool, rounds: int, seconds: float | None) -> Attack:
        """Simulates the strongest signals again, as records, and returns what they do."""
        rules = self.rules
        # Replays may be longer than an episode, in which alone the attack acts.
        recorded = Recorded(self.signals, rules.bound, Programmes.kind, "none", rules.shares)
        arcs = simulate_batch(self.task, self.controller, self.starts, recorded)
        dangerous = int(np.argmax(self._worst))
        return Attack.from_arcs(arcs, recorded, dangerous, name, everywhere, rounds, seconds)
