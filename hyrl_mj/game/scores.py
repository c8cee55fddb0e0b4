"""How much measurement noise a controller survives: worst-case scores, margins and maps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.game.lattice import LATTICE, Lattice
from hyrl_mj.game.limit import Limit
from hyrl_mj.game.solver import NEVER, Answers, Moves, WorstNoise, lasting, noisy_moves, solve
from hyrl_mj.policies import Controller, Policy, as_controller
from hyrl_mj.progress import Progress
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, Recorded, Rollout, closed_loop
from hyrl_mj.tasks import Task

# The controller that nothing can beat, beside those that are examined.
LIMIT = "limit"
# Noise bounds of the curve, and the largest one that is looked at [chart units].
CURVE = tuple(round(0.0125 * k, 4) for k in range(25))
LARGEST = CURVE[-1]
# Classes of the maps.
WON, WON_FROM_SOME, BEATEN, UNWINNABLE, OVER = range(5)
MAP_CLASSES = (
    "won from every start mode",
    "won if the controller picks the start mode",
    "lost to the worst noise",
    "not winnable",
    "over",
)
# About so many episodes without noise tell how far off the set-point they end.
QUIET_EPISODES = 4000

# Games that are played at a time; each takes tens of megabytes.
THREADS = 4


@dataclass(frozen=True)
class Score:
    """What a controller wins in the worst case.

    Attributes:
        eps: bound of the noise.
        winnable: share of the start region that can be won at all.
        won: share of the winnable starts that are won if the controller picks its start mode.
        won_any: share of them that are won from every start mode.
        time, time_any: worst time to arrival [s] from the starts that are won.
        excursion: how far off the set-point the noise can bring or keep a run for ever; None where every
            run is over some day.
    """

    eps: float
    winnable: float
    won: float
    won_any: float
    time: float
    time_any: float
    excursion: float | None


class Game:
    """The worst-case game of one task, for several controllers and any noise bound.

    Args:
        task: what is played.
        parts: M_i of each mode, or a `Partition`; the limit takes its sides from them.
        controllers: by name, controllers or policies; each is asked once.
        largest: the largest noise bound that will be played.
        everywhere: whether noise acts on all coordinates, not only on those the task calls noisy.
        grid: nodes of the lattice, by default the finest.

    Raises:
        BadInput: the chart has three dimensions, the plant's state is more than the chart, or a controller
            gives inputs that cannot be applied.
    """

    def __init__(
        self,
        task: Task,
        parts: Iterable[GridSet],
        controllers: Mapping[str, Controller | Policy],
        largest: float = LARGEST,
        everywhere: bool = False,
        grid: Grid | None = None,
    ):
        self.task, self.everywhere, self.largest = task, everywhere, largest
        task.check_noise(largest, everywhere)
        self.lattice = Lattice.of(task, grid)
        self.limit = Limit.of(self.lattice, parts)
        most = self.bound(largest)
        self.answers = {
            name: Answers.of(self.lattice, as_controller(loop), most)
            for name, loop in controllers.items()
        }

    def bound(self, eps: float) -> np.ndarray:
        """Noise bounds by coordinate (d,)."""
        return self.task.noise_in_chart(eps, self.everywhere)

    @cached_property
    def starts(self) -> np.ndarray:
        """(N,) bool, the nodes of the start region."""
        return self.task.may_start(self.lattice.grid.nodes) & self.lattice.running

    def moves(self, name: str, eps: float) -> Moves:
        """The adversary's moves against a controller, or against the limit."""
        if name not in (*self.answers, LIMIT):
            raise unknown("controller", name, (*self.answers, LIMIT))
        self.task.check_noise(eps, self.everywhere)
        if eps > self.largest + 1e-9:
            raise BadInput(
                f"noise {eps:g} is beyond the largest that was prepared, {self.largest:g}"
            )
        bound = self.bound(eps)
        return self.limit.moves(bound) if name == LIMIT else noisy_moves(self.answers[name], bound)

    def value(self, name: str, eps: float) -> np.ndarray:
        """The game's value (modes + 1, places), the last row for runs that have not started."""
        return self._value(name, self.moves(name, eps), eps)

    def winnable(self, eps: float) -> np.ndarray:
        """(N,) bool, the nodes from which a way picked by the first measurement can be held."""
        return self.limit.winnable(self.bound(eps))

    def score(self, name: str, eps: float) -> Score:
        """The score of a controller, or of the limit."""
        moves = self.moves(name, eps)
        value = self._value(name, moves, eps)[:, :-2]
        region = self.starts & self.winnable(eps)
        own, worst = value[-1, region], value[:-1, region].max(axis=0, initial=0)
        still = lasting(moves) & ~self.lattice.failed
        nodes, dt = self.lattice.grid.nodes, self.task.dt
        return Score(
            eps=eps,
            winnable=float(region.sum() / max(self.starts.sum(), 1)),
            won=_share(own < NEVER),
            won_any=_share(worst < NEVER),
            time=float(own[own < NEVER].max(initial=0) * dt),
            time_any=float(worst[worst < NEVER].max(initial=0) * dt),
            excursion=float(self.task.miss(nodes[still]).max()) if still.any() else None,
        )

    def _value(self, name: str, moves: Moves, eps: float) -> np.ndarray:
        value = solve(moves)
        if name == LIMIT:  # by its first measurement it picks a mode and holds it
            value[-1, :-2] = self.limit.held(self.bound(eps))
        return value

    def map(self, name: str, eps: float) -> np.ndarray:
        """The class (N,) of every node, an index into `MAP_CLASSES`."""
        value = self.value(name, eps)[:, :-2]
        classes = np.full(self.lattice.nodes, BEATEN, dtype=np.int8)
        classes[value[-1] < NEVER] = WON_FROM_SOME
        classes[(value < NEVER).all(axis=0)] = WON
        classes[(classes == BEATEN) & ~self.winnable(eps)] = UNWINNABLE
        classes[~self.lattice.running] = OVER
        return classes

    def margin(self, name: str) -> float | None:
        """The largest noise bound at which the whole winnable start region is won, by bisection.

        It is known to one cell of the lattice; None if not even without noise all of it is won.
        """
        cell = float(self.lattice.grid.spacing[self.bound(1.0) > 0].min())

        def all_won(cells: int) -> bool:
            eps = cells * cell
            own = self.value(name, eps)[-1, :-2]
            return bool((own[self.starts & self.winnable(eps)] < NEVER).all())

        low, high = 0, int(self.largest / cell + 1e-6)
        if not all_won(low):
            return None
        if all_won(high):
            return high * cell
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if all_won(middle) else (low, middle)
        return low * cell

    def worst_noise(self, name: str, eps: float) -> WorstNoise:
        """The adversary's noise, to simulate with."""
        return WorstNoise(self.answers[name], self.bound(eps))


def _share(won: np.ndarray) -> float:
    return float(won.mean()) if len(won) else 1.0


def worst_signal(
    game: Game,
    name: str,
    controller: Controller | Policy,
    z0: np.ndarray,
    eps: float,
    q0: int | None = None,
    steps: int | None = None,
) -> Recorded:
    """The worst noise signal against a controller from starts (n, d), sample by sample.

    `simulate` with it from the same starts gives the runs that the game foresees. It lasts for a number of
    steps, by default until the task's time is up.
    """
    noise = game.worst_noise(name, eps)
    modes = None if q0 is None else np.full(len(z0), q0)
    loop, settings = as_controller(controller), LoopSettings(steps=steps, record=True)
    rollout = closed_loop(game.task, loop, z0, noise, modes, settings=settings)
    if not len(rollout.measured):  # all runs are over where they start
        return Recorded(np.zeros((1, len(z0), game.task.measurement_columns)), eps, kind="worst")
    true = _true_measurements(game.task, rollout)
    values = np.where(np.isnan(rollout.u).any(axis=-1)[..., None], 0.0, rollout.measured - true)
    return Recorded(values, eps, kind="worst")


def _true_measurements(task: Task, rollout: Rollout) -> np.ndarray:
    """What the sensors of a rollout gave before noise: (K, n, p)."""
    path = rollout.path[: len(rollout.measured)]
    return np.stack([task.with_z(m, z) for m, z in zip(rollout.measured, path, strict=True)])


def examine(
    task: Task,
    points: np.ndarray,
    parts: Iterable[GridSet],
    controllers: Mapping[str, Controller],
    bounds: tuple[float, ...],
    everywhere: bool = False,
    cells: int | None = None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Play the game: scores at some noise bounds, margins, the curve over all bounds, and the maps.

    Args:
        task: what is played.
        points: (N, d) of M*; the margin is profiled along them.
        parts: M_i of each mode.
        controllers: by name.
        bounds: noise bounds of the scores; the maps are drawn for the last.
        everywhere: whether noise acts on all coordinates.
        cells: of the lattice along the longest side of the chart, by default the finest. In the plane the
            curve is played on one of half as many.

    Returns:
        What goes into `robustness.json`, and the arrays of the maps.
    """
    for eps in bounds:
        task.check_noise(eps, everywhere)
    names = [*controllers, LIMIT]
    Lattice.check(task)
    cells = cells or LATTICE[task.chart.dimension]
    grids = Grid.with_cells(task.chart, cells), Grid.with_cells(task.chart, cells // 2)
    plane = task.chart.dimension == 2
    progress = Progress("worst-case game", len(bounds) + len(CURVE) + 2, "noise bounds")
    parts = tuple(parts)
    fine = Game(task, parts, controllers, max(*bounds, LARGEST), everywhere, grids[0])
    scores: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    games = [(name, eps) for eps in bounds for name in names]
    for k, ((name, _), score) in enumerate(zip(games, together(fine.score, games), strict=True)):
        scores[name].append(vars(score))
        progress.update((k + 1) // len(names))
    margins = dict(zip(controllers, together(fine.margin, zip(controllers)), strict=True))
    progress.update(len(bounds) + 1)
    maps = {f"map_{name}": fine.map(name, bounds[-1]) for name in controllers}
    coarse = fine
    if plane:
        coarse = Game(task, parts, controllers, LARGEST, everywhere, grids[1])
    along = points[task.may_start(points)]
    at = coarse.lattice.grid.nearest(along)
    curve: dict[str, Any] = {"eps": list(CURVE), "winnable": []}
    curve |= {name: {"won": [], "won_any": [], "time_any": []} for name in names}
    holds = {name: np.ones(len(along), dtype=bool) for name in names}
    profile = {name: np.full(len(along), np.nan) for name in names}
    values = together(coarse.value, [(name, eps) for eps in CURVE for name in names])
    for k, eps in enumerate(CURVE):
        region = coarse.starts & coarse.winnable(eps)
        curve["winnable"].append(float(region.sum() / max(coarse.starts.sum(), 1)))
        for name in names:
            value = next(values)[:, :-2]
            own, worst = value[-1], value[:-1].max(axis=0)
            curve[name]["won"].append(_share(own[region] < NEVER))
            curve[name]["won_any"].append(_share(worst[region] < NEVER))
            times = worst[region & (worst < NEVER)]
            curve[name]["time_any"].append(float(times.max(initial=0) * task.dt))
            holds[name] &= own[at] < NEVER
            profile[name][holds[name]] = eps
        progress.update(len(bounds) + 2 + k)
    progress.close()
    quiet_starts = coarse.lattice.grid.nodes[coarse.starts & coarse.winnable(0.0)]
    quiet_starts = quiet_starts[:: max(len(quiet_starts) // QUIET_EPISODES, 1)]
    ends = {
        name: closed_loop(task, controller, quiet_starts, settings=LoopSettings(quiet=True))
        for name, controller in controllers.items()
    }
    spacing = fine.lattice.grid.spacing.tolist()
    content = {
        "everywhere": everywhere,
        "lattice": {
            "spacing": spacing,
            "exact": fine.lattice.exact,
            "curve_spacing": coarse.lattice.grid.spacing.tolist(),
        },
        "scores": scores,
        "margin": margins,
        "miss_without_noise": {
            name: float(task.miss(rollout.path[-1]).max()) for name, rollout in ends.items()
        },
        "curve": curve,
        "profile": {
            "points": along.tolist(),
            **{k: [None if np.isnan(x) else float(x) for x in v] for k, v in profile.items()},
        },
    }
    arrays = {"grid_counts": np.array(fine.lattice.grid.counts), "eps": np.array(bounds[-1])}
    return content, arrays | maps


def together(work: Callable[..., Any], calls: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """The results of calls, in their order, worked out in threads: NumPy lets others work meanwhile."""
    with ThreadPoolExecutor(THREADS) as pool:
        yield from pool.map(lambda call: work(*call), calls)


def save(path: Path, content: Mapping[str, Any]) -> None:
    """Write `robustness.json`."""
    artifacts.write_json(path, content, kind="robustness")


def load(path: Path) -> dict[str, Any]:
    """Read what `save` wrote.

    Raises:
        BadArtifact: the file is missing, truncated, or not of this version.
    """
    return artifacts.read_json(path, kind="robustness")
