"""Counts of what noise does in episodes: drawn ones, under attack, and replays of what the game says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

# The kind of noise of episodes without noise.
NO_NOISE = "none"
# A run that takes more than so many times as long as without noise is late: it went back, or to and fro.
LATE = 2
# Standard deviations of a normal distribution within which 95% lie.
NORMAL_95 = 1.959964


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
        unaided: number of those that are lost without noise, too; the attack leaves them alone.
        lost: number of the others for which a signal was found under which the run does not reach the
            set-point.
        interval: 95% interval of the share of the others that is lost (Wilson).
        rounds: number of rounds of the search.
        seconds: the time that was given for them [s]; None if their number was.
        samples: number of samples that were simulated.
        tried: number of runs by the kind of their signal.
        start: (d,) the start of the strongest signal: of the earliest failure, or where nothing is lost of
            the run with the greatest danger.
        outcome: how the run from there ends.
        places: (lost * d,) the starts for which such a signal was found, one after the other; () in files of
            version 1.0.0.
    """

    controller: str
    eps: float
    everywhere: bool
    starts: int
    unaided: int
    lost: int
    interval: tuple[float, float]
    rounds: int
    seconds: float | None
    samples: int
    tried: dict[str, int]
    start: tuple[float, ...]
    outcome: str
    places: tuple[float, ...] = ()

    @property
    def attacked(self) -> int:
        """The number of starts that are won without noise."""
        return self.starts - self.unaided

    @property
    def broken(self) -> str:
        """From how many starts it loses, as "3 of 200 starts"."""
        return f"{self.lost:,} of {self.attacked:,} starts"

    @property
    def is_whole(self) -> bool:
        """Whether there are starts, and no more of them are lost than there are."""
        numbers = len(self.places) in (0, self.lost * len(self.start))
        return numbers and 0 <= self.lost <= self.attacked and self.starts > 0 and self.rounds > 0


@dataclass(frozen=True)
class Comparison:
    """What one kind of noise does to several controllers from the same starts.

    Under noise only those starts are compared that all controllers win without noise. A run that arrives
    is late if it takes more than `LATE` times as long as the same controller takes without noise.

    Attributes:
        noise: the kind of noise, or "attack".
        starts: number of starts.
        unaided: by controller, the number of starts that are lost without noise.
        compared: number of starts that are compared.
        lost: by controller, the number of those that are lost under noise.
        alone: by controller, the number of those that no other controller loses.
        difference: share of those that the first controller loses, less that of the last.
        interval: 95% interval of this difference of paired shares (Agresti and Min 2005,
            doi:10.1002/sim.1781, adjusted Wald).
        late: by controller, the number of starts from which it arrives late.
        time, way: by controller, the median and the 99% quantile of the time to arrival, and of the length
            of the way, relative to those without noise; 1 where no run arrives.
    """

    noise: str
    starts: int
    unaided: dict[str, int]
    compared: int
    lost: dict[str, int]
    alone: dict[str, int]
    difference: float
    interval: tuple[float, float]
    late: dict[str, int]
    time: dict[str, tuple[float, float]]
    way: dict[str, tuple[float, float]]

    @property
    def is_whole(self) -> bool:
        """Whether the numbers fit together."""
        return (
            0 <= self.compared <= self.starts
            and [*self.unaided] == [*self.lost] == [*self.alone] == [*self.late]
            and all(0 <= n <= self.starts for n in self.unaided.values())
            and all(0 <= self.alone[name] <= n <= self.compared for name, n in self.lost.items())
        )


@dataclass(frozen=True)
class Ends:
    """How runs of one controller from some starts end.

    Attributes:
        lost: (n,) bool, whether each did not reach the set-point.
        time: (n,) time until the end [s].
        way: (n,) length of the way in the chart.
    """

    lost: np.ndarray
    time: np.ndarray
    way: np.ndarray


def compare(noise: str, quiet: Mapping[str, Ends], noisy: Mapping[str, Ends]) -> Comparison:
    """Compares controllers by how their runs from the same starts end, without noise and under it.

    Args:
        noise: the kind of noise.
        quiet, noisy: the ends without noise and under it, by controller.
    """
    won = ~np.any([ends.lost for ends in quiet.values()], axis=0)
    lost = {name: ends.lost & won for name, ends in noisy.items()}
    every = np.sum([*lost.values()], axis=0)
    alone = {name: int(np.sum(one & (every == 1))) for name, one in lost.items()}
    late, times, ways = {}, {}, {}
    for name, ends in noisy.items():
        arrives = won & ~ends.lost
        longer, farther = (
            np.divide(here, there, out=np.ones(len(won)), where=there > 0)[arrives]
            for here, there in ((ends.time, quiet[name].time), (ends.way, quiet[name].way))
        )
        late[name] = int(np.sum(longer > LATE))
        times[name], ways[name] = _quantiles(longer), _quantiles(farther)
    n, first, last = (
        int(won.sum()),
        *(lost[name] for name in (next(iter(lost)), next(reversed(lost)))),
    )
    b, c = int(np.sum(first & ~last)), int(np.sum(last & ~first))
    middle = (b - c) / (n + 2)
    half = NORMAL_95 * np.sqrt((b + c + 1) / (n + 2) - middle**2) / np.sqrt(n + 2)
    return Comparison(
        noise=noise,
        starts=len(won),
        unaided={name: int(ends.lost.sum()) for name, ends in quiet.items()},
        compared=n,
        lost={name: int(one.sum()) for name, one in lost.items()},
        alone=alone,
        difference=(b - c) / max(n, 1),
        interval=(max(float(middle - half), -1.0), min(float(middle + half), 1.0)),
        late=late,
        time=times,
        way=ways,
    )


def wilson(some: int, n: int) -> tuple[float, float]:
    """Returns the 95% interval of a share of which `some` of n were counted (Wilson); all of it for n = 0."""
    from scipy.stats import binomtest  # slow to import, and seldom needed

    if not n:
        return 0.0, 1.0
    interval = binomtest(some, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def _quantiles(values: np.ndarray) -> tuple[float, float]:
    """Returns the median and the 99% quantile of values (n,); 1 of none."""
    if not len(values):
        return 1.0, 1.0
    median, most = np.quantile(values, (0.5, 0.99))
    return float(median), float(most)


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
        of: what is said of the starts: "proved", or "won", not known to be lost.
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
        lost, played = (counts.get(NO_NOISE, 0) for counts in (self.lost, self.starts))
        noisy = 1 - (self.failures - lost) / max(self.played - played, 1)
        return 1 - lost / max(played, 1), noisy

    @property
    def is_whole(self) -> bool:
        """Whether there are starts, no more of them are lost than there are, and a loss is named."""
        return (
            self.of in ("proved", "won")
            and [*self.starts] == [*self.lost]
            and self.played > 0
            and all(0 <= lost <= self.starts[kind] for kind, lost in self.lost.items())
            and self.failures <= self.judged <= self.played
            and (self.first is None) == (self.failures == 0)
            and (self.first is None or self.first.noise in self.starts)
        )
