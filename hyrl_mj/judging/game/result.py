"""The results of an examination under noise: scores, margins, curves, maps and counts of episodes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from hyrl_mj.errors import BadArtifact
from hyrl_mj.files import artifacts
from hyrl_mj.judging.game.counts import AttackCount, Comparison, EpisodeCount, ReplayCount
from hyrl_mj.sets import Chart, Grid

# Name of the limit, a controller that is scored beside the examined ones.
LIMIT = "limit"
# A share of at least this much counts as nearly all.
NEARLY = 0.99


class MapClass(IntEnum):
    """What a map says of a node."""

    WON = 0
    WON_FROM_SOME = 1
    UNCLEAR = 2
    BEATEN = 3
    UNWINNABLE = 4
    OVER = 5

    @property
    def label(self) -> str:
        """The class in words."""
        return (
            "proved to be won from every start mode",
            "proved to be won if the controller picks the start mode",
            "neither proved nor lost",
            "lost to the worst noise",
            "not winnable by this split",
            "over",
        )[self]


def percent(share: float, surely: bool = True) -> str:
    """Returns a share in percent; only 1 is called 100%, and only 0 is called 0%.

    A share of 1 that was not proved (`surely` is false) is written "all tried".
    """
    if share == 1 and not surely:
        return "all tried"
    if share in (0, 1):
        return f"{100 * share:.0f}%"
    text = f"{100 * share:.2f}%"
    return {"100.00%": ">99.99%", "0.00%": "<0.01%"}.get(text, text)


@dataclass(frozen=True)
class NodeScore:
    """What a controller wins on the nodes of the lattice: it arrives before the episode's time is over.

    Attributes:
        eps: bound of the noise.
        winnable: share of the start region that this split can win, by deciding the way from the measurement.
        won: share of the winnable starts that are won if the controller picks its start mode.
        won_any: share of the winnable starts that are won from every start mode.
        time, time_any: worst time to arrival [s] from the starts that are won.
        excursion: greatest distance from the set-point of runs that never end; None if all runs end.
    """

    eps: float
    winnable: float
    won: float
    won_any: float
    time: float
    time_any: float
    excursion: float | None

    def __repr__(self) -> str:
        values = {k: None if v is None else f"{v:.4g}" for k, v in vars(self).items()}
        shown = ", ".join(f"{name}={value}" for name, value in values.items())
        return f"{type(self).__name__}({shown})"


@dataclass(frozen=True)
class Score(NodeScore):
    """What a controller wins on the nodes, what is proved between them, and what was really lost.

    The shares below are of the winnable cells between the nodes: those of the start region all of whose
    corners are winnable. Where a plant allows no cells, they are of the winnable nodes.

    Attributes:
        open: share of the start region that can be won by one who sees the state.
        proved: share that is won if the controller picks its start mode, from every state and under every
            noise signal within the bound; None if the controller could not be bounded.
        proved_any: share that is won so from every start mode.
        proved_time, proved_time_any: bounds of the time to arrival [s] from what is proved.
        not_broken: share in which no start is known that is lost if the controller picks its start mode.
            Each start that is known to be lost was lost on the plant, with its noise signal.
        not_broken_any: share in which no start is known that is lost from some start mode.
    """

    open: float
    proved: float | None
    proved_any: float | None
    proved_time: float | None
    proved_time_any: float | None
    not_broken: float
    not_broken_any: float

    __repr__ = NodeScore.__repr__


@dataclass(frozen=True)
class SensedScore:
    """What is proved of a controller under the task's own sensor, which remembers.

    Attributes:
        proved: share of all starts from which it wins if it picks its start mode, from every state of their
            cells and whatever the sensor does.
        proved_any: share from which it wins so from every start mode.
    """

    proved: float
    proved_any: float


@dataclass(frozen=True)
class WinningShares:
    """What a controller wins at each noise bound of a curve.

    Attributes:
        won, won_any: shares of the winnable nodes that are won on the nodes of the lattice, if the
            controller picks its start mode, and from every start mode; of an estimate what is not broken.
        proved, proved_any: shares of the winnable cells that are proved, as in `Score`; empty for a
            controller that could not be bounded.
        time_any: worst time to arrival [s] from the nodes that are won, from every start mode; None where
            nothing is won.
    """

    won: tuple[float, ...]
    won_any: tuple[float, ...]
    proved: tuple[float, ...]
    proved_any: tuple[float, ...]
    time_any: tuple[float | None, ...]


@dataclass(frozen=True)
class Curve:
    """What is won against the noise bound.

    Attributes:
        eps: the noise bounds.
        winnable: share of the start region that can be won at all, at each bound.
        wins: shares that each controller wins.
    """

    eps: tuple[float, ...]
    winnable: tuple[float, ...]
    wins: dict[str, WinningShares]


@dataclass(frozen=True)
class Profile:
    """The noise that can be borne along M*.

    Attributes:
        points: (N, d) points of M* in the start region.
        eps: by controller, the largest bound up to which each point is won; None if lost without noise.
    """

    points: tuple[tuple[float, ...], ...]
    eps: dict[str, tuple[float | None, ...]]


@dataclass(frozen=True)
class LatticeSpacing:
    """The distances between the nodes of the lattice of states.

    Attributes:
        spacing: distance along each coordinate, in chart units.
        exact: whether every sample leads from node to node.
        cells: whether the starts of the scores are cells.
        curve_spacing: distance on the lattice on which the curve is computed.
    """

    spacing: tuple[float, ...]
    exact: bool
    cells: bool
    curve_spacing: tuple[float, ...]


@dataclass(frozen=True)
class GameResult:
    """The result of the worst-case game for some controllers and the limit.

    Attributes:
        everywhere: whether noise acts on all coordinates.
        lattice: spacing of the lattice.
        scores: for each controller and the limit, one at each noise bound.
        margin: for each controller, the largest bound at which all winnable nodes of the start region are
            won; None if they are not even won without noise.
        proved_margin: for each controller, the largest bound of the curve up to which nearly all winnable
            starts (`NEARLY`) are proved; None if not even without noise.
        why_not_proved: for each controller that could not be bounded, what stopped it.
        miss_without_noise: for each controller, the greatest distance from the set-point at the end of runs
            without noise.
        curve: what is won against the noise bound.
        profile: the noise that can be borne along M*.
        replays: the replays of what is proved or won at the largest noise bound, at most one for each
            controller; none of an estimate.
        sensed: what is proved of each controller under the task's own sensor, if that has a bias, or is late,
            and its game is not too large.
        other_starts: why shares of the start region are none of the starts that a task draws; "" if they are.
    """

    everywhere: bool
    lattice: LatticeSpacing
    scores: dict[str, tuple[Score, ...]]
    margin: dict[str, float | None]
    proved_margin: dict[str, float | None]
    why_not_proved: dict[str, str]
    miss_without_noise: dict[str, float]
    curve: Curve
    profile: Profile
    replays: tuple[ReplayCount, ...] = ()
    sensed: dict[str, SensedScore] = field(default_factory=dict)
    other_starts: str = ""

    @property
    def decides(self) -> bool:
        """Whether it decides a verdict: it is no estimate, and counts the starts that the task draws."""
        return not (self.estimate or self.other_starts)

    @property
    def estimate(self) -> bool:
        """Whether it is an estimate, because no cells stand for what lies between the nodes."""
        return not self.lattice.cells

    @property
    def controllers(self) -> tuple[str, ...]:
        """The names of the controllers, without the limit."""
        return tuple(name for name in self.scores if name != LIMIT)

    def is_whole(self, controllers: Collection[str]) -> bool:
        """Whether all tables have the same controllers, and as many rows as noise bounds."""
        examined, rows = {*controllers}, len(self.curve.eps)
        replayed = [count.controller for count in self.replays if count.is_whole]
        of_all = (self.margin, self.proved_margin, self.miss_without_noise)
        with_limit = (self.scores, self.curve.wins, self.profile.eps)
        columns = [w for wins in self.curve.wins.values() for w in vars(wins).values() if w]
        return (
            len({*replayed}) == len(replayed) == len(self.replays)
            and {*replayed, *self.sensed, *self.why_not_proved} <= examined
            and all({*table} == examined for table in of_all)
            and all({*table} == examined | {LIMIT} for table in with_limit)
            and all(self.scores.values())
            and len(set(map(len, self.scores.values()))) == 1
            and rows > 0
            and set(map(len, [self.curve.winnable, *columns])) == {rows}
            and set(map(len, self.profile.eps.values())) == {len(self.profile.points)}
        )

    def replays_of(self, controller: str) -> ReplayCount | None:
        """Returns the replays of a controller, None if there were none."""
        return next((count for count in self.replays if count.controller == controller), None)

    @property
    def lasting(self) -> bool:
        """Whether some run never ends, so that times and excursions are informative."""
        return any(score.excursion is not None for level in self.scores.values() for score in level)

    def __repr__(self) -> str:
        scores = {name: level[-1] for name, level in self.scores.items() if name != LIMIT}
        shares = ", ".join(f"{name} {score.not_broken:.2%}" for name, score in scores.items())
        eps = f" at eps {next(iter(scores.values())).eps:g}" if scores else ""
        return f"GameResult(not broken{eps}: {shares})"


@dataclass(frozen=True)
class Robustness(artifacts.SavedAsJson):
    """The result of an examination under noise, saved as `robustness.json`.

    Attributes:
        eps: bound of the noise.
        everywhere: whether noise acts on all columns of the measurement.
        game: result of the worst-case game, if it can be played.
        episodes: counts of noisy episodes.
        seed: seed of the starts and the noise of these episodes and attacks.
        attacks: counts of the attack, one for each controller, if there was one.
        comparisons: of the controllers, from the same starts, by kind of noise; that of the attack is last.
        near_critical: whether all episodes and the attack begin near the critical set.
    """

    KIND: ClassVar[str] = "robustness"

    eps: float
    everywhere: bool
    game: GameResult | None
    episodes: tuple[EpisodeCount, ...]
    seed: int
    attacks: tuple[AttackCount, ...] = ()
    comparisons: tuple[Comparison, ...] = ()
    near_critical: bool = False

    @property
    def deciding(self) -> GameResult | None:
        """The game, if it decides the verdict."""
        return self.game if self.game and self.game.decides else None

    def check(self, controllers: Collection[str]) -> None:
        """Raises `BadArtifact` unless there are whole results of these controllers, as stages write them."""
        if not (self.game or self.episodes):
            raise BadArtifact("it holds neither a game nor episodes")
        if self.game and not self.game.is_whole(controllers):
            raise BadArtifact(f"its game is not one of {' and '.join(controllers)}")
        kinds = {
            name: {c.noise for c in self.episodes if c.controller == name} for name in controllers
        }
        known = all(c.controller in controllers and c.is_whole for c in self.episodes)
        if not known or len(set(map(frozenset, kinds.values()))) > 1:
            raise BadArtifact(f"its episodes are not those of {' and '.join(controllers)}")
        attacked = [count.controller for count in self.attacks if count.is_whole]
        if self.attacks and attacked != [*controllers]:
            raise BadArtifact(f"its attacks are not those of {' and '.join(controllers)}")
        wanted = {c.noise for c in self.episodes} | {*(("attack",) if self.attacks else ())}
        if "none" not in {c.noise for c in self.episodes}:
            wanted &= {"attack"}
        compared = {c.noise for c in self.comparisons if c.is_whole and [*c.lost] == [*controllers]}
        if compared != wanted - {"none"} or len(compared) != len(self.comparisons):
            raise BadArtifact(
                f"it does not compare {' and '.join(controllers)} from the same starts"
            )

    def __repr__(self) -> str:
        game = f"{self.game}, " if self.game else ""
        episodes = sum(count.episodes for count in self.episodes)
        return f"Robustness(eps {self.eps:g}, {game}{episodes:,} episodes)"

    @classmethod
    def load(cls, path: Path, of: Collection[str] = ()) -> Self:
        """Reads what `save` wrote.

        Args:
            path: the file.
            of: the controllers whose results it has to hold, if there are any.

        Raises:
            BadArtifact: the file is missing, damaged, of another version, or about other controllers.
        """
        remedy = "run hyrl-mj robustness RUN to write it again"
        robustness = artifacts.read_record(path, cls.KIND, cls, remedy)
        if of:
            with artifacts.reading(path):
                robustness.check(of)
        return robustness


@dataclass(frozen=True)
class Maps(artifacts.Saved):
    """The classes of the maps.

    Attributes:
        eps: bound of the noise.
        grid_counts: (d,) number of nodes along each coordinate.
        map: for each controller, the `MapClass` (N,) of every node.
    """

    KIND: ClassVar[str] = "robustness maps"

    eps: float
    grid_counts: np.ndarray
    map: dict[str, np.ndarray]

    def __repr__(self) -> str:
        return f"Maps(eps {self.eps:g}, {', '.join(self.map)})"

    def grid(self, chart: Chart) -> Grid:
        """Returns the nodes as a grid in the task's chart."""
        return Grid.from_counts(chart, self.grid_counts)
