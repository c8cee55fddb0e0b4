"""The evidence that a verdict rests on: what controllers win, and whether it is enough for HELD."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from hyrl_mj.judging.game import NEARLY, NO_NOISE, Robustness, wilson
from hyrl_mj.judging.game.counts import NORMAL_95
from hyrl_mj.ranges import Checked, Integer, Number


@dataclass(frozen=True)
class VerdictSettings(Checked):
    """What a verdict asks for: more than the defaults if wanted, never less, or a run could praise itself.

    Attributes:
        winnable: PROVED and WON speak of winnable starts: at least this share of those that are open to one
            who sees the state. Else a split that makes most starts unwinnable would have the first word.
        episodes: the fewest episodes of each kind of noise for HELD.
        attacked: the fewest attacked starts for HELD: of 300 starts none is lost if 99% are won at the lower
            end of a one-sided 95% interval (3 / 300 = 1%).
    """

    winnable: Annotated[float, Number(0.9, 1)] = 0.9
    episodes: Annotated[int, Integer(1_000, 10**9)] = 1_000
    attacked: Annotated[int, Integer(300, 10**9)] = 300


@dataclass(frozen=True)
class Sample:
    """What was won of some episodes, or attacked starts.

    Attributes:
        kind: the kind of noise, or "attack" of starts that were attacked.
        won, total: how many were won, and of how many.
        least: the fewest that HELD needs.
    """

    kind: str
    won: int
    total: int
    least: int

    def __str__(self) -> str:
        others = {"attack": "attacked starts", NO_NOISE: "episodes without noise"}
        what = others.get(self.kind, f"episodes under {self.kind} noise")
        return f"{self.won:,} of {self.total:,} {what}"

    @property
    def held(self) -> bool:
        """Whether they are enough, and nearly all are won at the lower end of the interval."""
        return self.total >= self.least and wilson(self.won, self.total)[0] >= NEARLY

    @property
    def refuted(self) -> bool:
        """Whether fewer than nearly all are won even at the upper end of the interval."""
        return self.total > 0 and wilson(self.won, self.total)[1] < NEARLY

    @property
    def enough(self) -> int:
        """How many may be enough, in hundreds: four times as many where there were enough, but too many lost.

        If all are won, the lower end of the 95% interval (Wilson) is n / (n + z^2): nearly all from 400 on.
        """
        if_all_won = 100 * math.ceil(NORMAL_95**2 * NEARLY / (1 - NEARLY) / 100)
        return max(self.least, if_all_won, 4 * self.total if self.total >= self.least else 0)


def success_rates(robustness: Robustness, who: str) -> tuple[float | None, float | None]:
    """Returns what "policy" or "hyrl" is not known to lose, without noise and under noise.

    These are shares of the winnable starts, or of the episodes; None of what was not examined.
    """
    attacked = [
        1 - c.lost / c.attacked for c in robustness.attacks if c.controller == who and c.attacked
    ]
    if robustness.deciding:
        scores = robustness.deciding.scores[who]
        replays = robustness.deciding.replays_of(who)
        replayed = replays.shares if replays else (1.0, 1.0)
        quiet = [min(score.not_broken, replayed[0]) for score in scores if score.eps == 0]
        noisy = min(scores[-1].not_broken, replayed[1], *attacked, 1.0)
        return quiet[0] if quiet else None, noisy
    shares = {kind: won / total for kind, (won, total) in by_kind(robustness, who).items()}
    quiet_share = shares.pop(NO_NOISE, None)
    return quiet_share, min([*shares.values(), *attacked], default=None)


def by_kind(robustness: Robustness, who: str) -> dict[str, tuple[int, int]]:
    """Returns how many of a controller's episodes arrive, and of how many, by kind of noise.

    Sums of parts and logs, whose texts have several words, have other bounds than the examination.
    """
    counts: dict[str, tuple[int, int]] = {}
    for count in robustness.episodes:
        if count.controller == who and " " not in count.noise:
            arrived, episodes = counts.get(count.noise, (0, 0))
            counts[count.noise] = arrived + count.episodes - count.lost, episodes + count.episodes
    return counts
