"""The search for noise signals against one controller, which `attack` makes in rounds."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from hyrl_mj.judging.episodes import BATCH, ends_of
from hyrl_mj.judging.game import Ends
from hyrl_mj.policies import Controller
from hyrl_mj.simulation import (
    GIVEN,
    AttackSettings,
    LoopSettings,
    Programmes,
    Rules,
    closed_loop,
)
from hyrl_mj.tasks import Outcome, Task

# What is looked for in programmes that do not win yet: danger on the way, late arrival, dithering.
GOALS = 3


class Waves:
    """Noise that is constant in pieces, or changes its sign with a period in them, from vectors of numbers.

    A vector holds the levels of the pieces on each noisy column, the times of the pieces, and the period.
    Levels beyond -1 and 1 are the ends of the bound, so that most signals are at its ends, where noise is
    strongest.

    Args:
        limits: (p,) the largest magnitude of the noise on each column.
        length: length of a run without noise [samples]; switching times are spread over 1.5 times of it.
        samples: number of samples of the signals.
        pieces: number of pieces.
    """

    def __init__(self, limits: np.ndarray, length: int, samples: int, pieces: int):
        self.limits, self.length, self.samples, self.pieces = limits, length, samples, pieces
        self.noisy = np.flatnonzero(limits)
        self.size = pieces * len(self.noisy) + pieces + 1

    def __call__(self, vectors: np.ndarray) -> np.ndarray:
        """Returns the signals (samples, n, p) of vectors (n, size)."""
        n, k = len(vectors), np.arange(self.samples)[:, None]
        levels, times, period = np.split(vectors, [-self.pieces - 1, -1], axis=1)
        shares = np.exp(2 * times)
        begins = np.cumsum(shares, axis=1) / shares.sum(axis=1, keepdims=True) * 1.5 * self.length
        piece = (k[:, :, None] >= begins[None, :, :-1]).sum(axis=2)
        levels = np.clip(2 * levels, -1, 1).reshape(n, self.pieces, len(self.noisy))
        half = np.maximum(self.length ** np.clip(np.abs(period[:, 0]), 0, 1), 1)
        swings = (period[:, 0] > 0) & ((k // half) % 2 == 1)
        sign = np.where(swings, -1.0, 1.0)
        signals = np.zeros((self.samples, n, len(self.limits)))
        chosen = levels[np.arange(n)[None], piece] * sign[:, :, None]
        signals[:, :, self.noisy] = chosen * self.limits[self.noisy]
        return signals


class Search:
    """The search for signals against one controller.

    Attributes:
        quiet: how the runs end without noise.
        length: the length of a run without noise [samples], the median over the starts.
        unaided: (n,) bool, the starts that are lost without noise.
        open: (n,) bool, the other starts that nothing has broken yet.
        danger: (n,) the greatest danger from each start so far.
        signals: (K, n, p) the strongest signal for each start so far.
        samples: number of samples that were simulated.
        tried: for each kind of rule, in how many runs it was held throughout; and in how many there were
            other signals.
    """

    def __init__(
        self,
        task: Task,
        controller: Controller,
        starts: np.ndarray,
        bound: float,
        shares: np.ndarray,
        seed: int,
        settings: AttackSettings = AttackSettings(),
    ):
        self.task, self.controller, self.starts, self.seed = task, controller, starts, seed
        self.settings, segments = settings, settings.segments
        self.rules = Rules(task, controller, bound, shares, settings=settings)
        self._label, n = "attack, without noise", len(starts)
        self.open, self.segment = np.ones(n, dtype=bool), task.max_steps
        self.signals = np.zeros((task.max_steps, n, len(shares)))
        self.danger = np.full(n, -np.inf)
        self._winners = np.full((n, segments), self.rules.nothing)
        self._values = np.full((n, GOALS, settings.elites), -np.inf)
        self._elites = np.full((*self._values.shape, segments), self.rules.nothing)
        self._known: list[set[bytes]] = [set() for _ in starts]
        self._evolved: dict[int, Any] = {}
        self.samples, self.tried = 0, Counter[str]()
        self.quiet, _ = self._simulate(np.arange(n), self._elites[:, 0, 0])
        self.unaided = ~self.open
        self.length = max(int(np.median(self.quiet.time) / task.dt), 1)

    def prepare(self, length: int) -> None:
        """Prepares the rounds, for runs of a length [samples], which is the same for all controllers."""
        nothing, bound, shares = self.rules.nothing, self.rules.bound, self.rules.shares
        self.rules = Rules(self.task, self.controller, bound, shares, length, self.settings)
        self._elites[self._elites == nothing] = self.rules.nothing
        limits, pieces = bound * np.abs(shares), self.settings.pieces
        self.waves = Waves(limits, length, self.task.max_steps, pieces)
        self.segment = max(math.ceil(length / self.settings.segments), 1)

    def round(self, number: int) -> None:
        """Tries some signals from each open start; the rounds are numbered from 1.

        The first rounds hold each rule throughout; those that only controllers with several modes have come
        on top in the first. The later ones draw programmes of segments, and every second of them evolves
        levels and switching times.
        """
        self._label = f"attack, round {number}"
        first = (number - 1) * self.settings.population
        held = self.rules.common[first : first + self.settings.population]
        if number == 1:
            held = np.concatenate([held, self.rules.own])
        self._copy()
        late = number - math.ceil(len(self.rules.common) / self.settings.population)
        rows, rng = np.flatnonzero(self.open), np.random.default_rng([self.seed, number])
        if not len(rows):
            return
        if late > 0 and late % 2 == 0:
            self._evolve(rows)
        else:
            self._try(rows, self._population(rows, held, rng))

    def _copy(self) -> None:
        """Tries from the open starts what won from the start nearby."""
        lost, chart = np.flatnonzero(~self.open & ~self.unaided), self.task.chart
        keys, pairs = [self._key(int(at)) for at in lost], []
        for row in np.flatnonzero(self.open) if len(lost) else ():
            away = chart.difference(self.starts[lost], self.starts[row]) / chart.sides
            new = np.array([key not in self._known[row] for key in keys])
            if new.any():
                nearest = np.where(new, np.linalg.norm(away, axis=1), np.inf).argmin()
                pairs.append((row, lost[nearest]))
                self._known[row].add(keys[nearest])
        for first in range(0, len(pairs), BATCH):
            rows, at = np.array(pairs[first : first + BATCH]).T
            self._simulate(rows, self._winners[at], self.signals[:, at])

    def _key(self, at: int) -> bytes:
        """Returns what tells the winner of a start from others."""
        programme = self._winners[at]
        return bytes(programme.tobytes() + (b"%d" % at if programme[0] == GIVEN else b""))

    def _population(
        self, rows: np.ndarray, held: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Returns programmes (r, c, segments) for the starts `rows` (r,): rules held, then drawn ones."""
        s = self.settings
        shape = len(rows), max(s.population, len(held)), s.segments
        goal = np.broadcast_to(np.arange(shape[1])[:, None] % GOALS, shape)
        elite, segment = rng.integers(s.elites, size=shape), np.arange(s.segments)
        drawn = self._elites[rows[:, None, None], goal, elite, segment]
        explores = rng.random(shape) < s.explore
        programmes = np.where(explores, rng.choice(self.rules.parts, size=shape), drawn)
        programmes[:, : len(held)] = held[:, None]
        return programmes

    def _try(self, rows: np.ndarray, programmes: np.ndarray) -> None:
        """Simulates programmes (r, c, segments) from the starts `rows` (r,), and keeps the best."""
        each = np.repeat(rows, programmes.shape[1])
        flat = programmes.reshape(-1, programmes.shape[2])
        for first in range(0, len(each), BATCH):
            self._simulate(each[first : first + BATCH], flat[first : first + BATCH])

    def _evolve(self, rows: np.ndarray) -> None:
        """Evolves levels and switching times by CMA-ES, at the most dangerous of the starts `rows` (r,)."""
        import cma  # slow to import, and seldom needed
        from scipy.stats import rankdata

        s = self.settings
        focused = rows[np.argsort(-self.danger[rows], kind="stable")[: s.focused]]
        for row in focused:
            if row not in self._evolved:
                own = np.random.default_rng([self.seed, 1, row])
                options = {
                    "popsize": s.offspring,
                    "randn": lambda *shape, own=own: own.standard_normal(shape),
                    "seed": np.nan,  # the global generator stays as it is
                    "verbose": -9,
                }
                begin = own.normal(0, s.spread, self.waves.size)
                self._evolved[row] = cma.CMAEvolutionStrategy(begin, s.spread, options)
        generations = math.ceil(len(rows) / len(focused) * s.population / s.offspring)
        for _ in range(generations):
            focused = focused[self.open[focused]]
            if not len(focused):
                return
            asked = [np.array(self._evolved[row].ask()) for row in focused]
            each = np.repeat(focused, [len(vectors) for vectors in asked])
            given = self.waves(np.concatenate(asked))
            _, values = self._simulate(each, np.full((len(each), s.segments), GIVEN), given)
            for row, vectors in zip(focused, asked, strict=True):
                # The better rank in danger or in lateness counts; CMA-ES minimises.
                ranks = rankdata(-values[each == row, :2], method="min", axis=0)
                self._evolved[row].tell(list(vectors), list(ranks.min(axis=1) + ranks.sum(axis=1)))

    def _simulate(
        self, rows: np.ndarray, programmes: np.ndarray, given: np.ndarray | None = None
    ) -> tuple[Ends, np.ndarray]:
        """Simulates a programme, or a given signal, from each of the starts `rows` (k,), and keeps the best.

        Returns:
            How the runs end, and their danger, lateness and reversals (k, 3).
        """
        signal = Programmes(self.task, self.controller, self.rules, programmes, self.segment, given)
        settings = LoopSettings(label=self._label)
        run = closed_loop(self.task, self.controller, self.starts[rows], signal, settings=settings)
        lost = run.outcome != Outcome.REACHED
        self.samples += int(run.length.sum())
        mean = signal.rewards / np.maximum(run.length, 1)
        # Among runs of equal length the one with the least reward counts as the latest.
        late = run.length - mean / (1 + np.abs(mean)) / 2
        values = np.stack([signal.danger, late, signal.reversals], axis=1)
        noise = np.reshape(signal.values, (-1, len(rows), self.signals.shape[2]))
        for i, row in enumerate(rows):
            programme = programmes[i]
            self.tried[self._kind(programme)] += 1
            if programme[0] != GIVEN:
                self._known[row].add(programme.tobytes())
            if not self.open[row]:
                continue
            if lost[i] or signal.danger[i] > self.danger[row]:
                self.danger[row] = signal.danger[i]
                self.signals[: len(noise), row], self.signals[len(noise) :, row] = noise[:, i], 0.0
            if lost[i]:
                self.open[row], self._winners[row] = False, programme
            if programme[0] == GIVEN:
                continue
            for goal, value in enumerate(values[i]):
                elites, least = self._elites[row, goal], self._values[row, goal].argmin()
                if value > self._values[row, goal, least]:
                    elites[least], self._values[row, goal, least] = programme, value
        return ends_of(self.task, run), values

    def _kind(self, programme: np.ndarray) -> str:
        """Returns the kind of a programme (segments,), for the count of what was tried."""
        if programme[0] == GIVEN:
            return "evolved"
        return self.rules.all[programme[0]].kind.value if np.ptp(programme) == 0 else "segments"
