"""Counts of what noise does in episodes: drawn ones, under attack, and replays of what the game says."""

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


# What is said of the starts that are replayed: proved, or not known to be lost.
PROVED_STARTS, WON_STARTS = "proved", "won"


@dataclass(frozen=True)
class LostReplay:
    """A start that is said to be won, and was lost in MuJoCo.

    Attributes:
        start: (d,) chart point.
        q0: the mode at the start; None if the controller picked it.
        noise: the kind of noise.
        outcome: how the run ended.
    """

    start: tuple[float, ...]
    q0: int | None
    noise: str
    outcome: str


@dataclass(frozen=True)
class ReplayCount:
    """How many starts that are said to be won were lost when they were played in MuJoCo.

    Attributes:
        controller: name of the controller.
        eps, everywhere: the bound of the noise, and whether it acts on all coordinates.
        of: what is said of the starts, "proved" or "won".
        starts: number of starts that were played, by kind of noise.
        lost: number of those that did not reach the set-point, by kind of noise.
        judged: how many of these episodes, all lost ones among them, were played once more by plain MuJoCo
            in simulations of their own, and were the same at every sample.
        first: the first of the lost starts; None if there is none.
    """

    controller: str
    eps: float
    everywhere: bool
    of: str
    starts: dict[str, int]
    lost: dict[str, int]
    judged: int
    first: LostReplay | None

    @property
    def played(self) -> int:
        """The number of starts that were played."""
        return sum(self.starts.values())

    @property
    def failures(self) -> int:
        """The number of starts that were lost."""
        return sum(self.lost.values())

    @property
    def shares(self) -> tuple[float, float]:
        """The shares of the starts that were not lost without noise, and under noise; 1 of no starts."""
        quiet, noisy = ([k for k in self.starts if (k == "none") == none] for none in (True, False))
        lost = (sum(self.lost[k] for k in kinds) for kinds in (quiet, noisy))
        played = (sum(self.starts[k] for k in kinds) for kinds in (quiet, noisy))
        without, under = (1 - x / max(n, 1) for x, n in zip(lost, played, strict=True))
        return without, under

    @property
    def is_whole(self) -> bool:
        """Whether there are starts, no more of them are lost than there are, and a loss is named."""
        return (
            self.of in (PROVED_STARTS, WON_STARTS)
            and [*self.starts] == [*self.lost]
            and self.played > 0
            and all(0 <= lost <= self.starts[kind] for kind, lost in self.lost.items())
            and self.failures <= self.judged <= self.played
            and (self.first is None) == (self.failures == 0)
            and (self.first is None or self.first.noise in self.starts)
        )
