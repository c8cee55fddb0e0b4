"""Counts of what noise does where the worst case cannot be computed: in episodes, and under attack."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EpisodeCount:
    """How the noisy episodes of one kind of noise, one controller and one start region ended.

    Attributes:
        noise, eps, everywhere: the noise: its kind, its bound, and whether it acts on all coordinates.
        controller: name of the controller.
        region: start region of the episodes: "near M*", "elsewhere" or "not winnable".
        episodes: number of episodes.
        outcomes: number of episodes with each outcome.
        reached: share of the episodes that reached the set-point.
        interval: 95% interval of this share (Wilson).
    """

    noise: str
    eps: float
    everywhere: bool
    controller: str
    region: str
    episodes: int
    outcomes: dict[str, int]
    reached: float
    interval: tuple[float, float]

    @property
    def is_whole(self) -> bool:
        """Whether there are episodes, each of which has an outcome."""
        return self.episodes > 0 and sum(self.outcomes.values()) == self.episodes

    @property
    def lost(self) -> int:
        """The number of episodes that did not reach the set-point."""
        return self.episodes - self.outcomes.get("reached", 0)


@dataclass(frozen=True)
class AttackCount:
    """From how many starts an attack made one controller lose, by a search for noise signals.

    Attributes:
        controller: name of the controller.
        eps, everywhere: the bound of the noise, and whether it acts on all columns of the measurement.
        starts: number of starts that were attacked.
        lost: number of those for which a signal was found under which the run does not reach the set-point.
        interval: 95% interval of the share that is lost (Wilson).
        rounds: number of rounds of the search.
        seconds: the time that was given for them [s]; None if their number was.
        start: (d,) the start of the strongest signal: of the earliest failure, or where nothing is lost of
            the run with the greatest danger.
        outcome: how the run from there ends.
    """

    controller: str
    eps: float
    everywhere: bool
    starts: int
    lost: int
    interval: tuple[float, float]
    rounds: int
    seconds: float | None
    start: tuple[float, ...]
    outcome: str

    @property
    def broken(self) -> str:
        """From how many starts it loses, as "3 of 200 starts"."""
        return f"{self.lost:,} of {self.starts:,} starts"

    @property
    def is_whole(self) -> bool:
        """Whether there are starts, and no more of them are lost than there are."""
        return 0 <= self.lost <= self.starts and self.starts > 0 and self.rounds > 0
