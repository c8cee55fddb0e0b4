"""Examining controllers in the worst case: scores, margins, the curve over all bounds, and maps."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from hyrl_mj.game.lattice import LATTICE, Lattice
from hyrl_mj.game.result import LIMIT, Curve, GameResult, LatticeSpacing, Maps, Profile, Wins
from hyrl_mj.game.scores import LARGEST, Game, share
from hyrl_mj.game.solver import NEVER
from hyrl_mj.policies import Controller
from hyrl_mj.progress import progress_bar
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.tasks import Task

# Noise bounds of the curve [chart units].
CURVE = tuple(round(0.0125 * k, 4) for k in range(round(LARGEST / 0.0125) + 1))
# Approximate number of episodes without noise.
QUIET_EPISODES = 4000
# Games that are solved at the same time; each takes tens of megabytes.
THREADS = 4


def examine(
    task: Task,
    points: np.ndarray,
    parts: Iterable[GridSet],
    controllers: Mapping[str, Controller],
    bounds: tuple[float, ...],
    everywhere: bool = False,
    cells: int | None = None,
) -> tuple[GameResult, Maps]:
    """Plays the game: scores at some noise bounds, margins, the curve over all bounds, and the maps.

    Args:
        task: the robot and its problem.
        points: (N, d) points of M*, along which the margin is profiled.
        parts: M_i of each mode.
        controllers: controllers by name.
        bounds: noise bounds of the scores; the maps are drawn for the last.
        everywhere: whether noise acts on all coordinates.
        cells: number of lattice cells along the longest side of the chart, by default the finest lattice.
            In the plane the curve is computed on a lattice of half as many.
    """
    for eps in bounds:
        task.check_noise(eps, everywhere)
    Lattice.check(task)
    cells = cells or LATTICE[task.chart.dimension]
    parts = tuple(parts)
    grid = Grid.with_cells(task.chart, cells)
    fine = Game(task, parts, controllers, max(*bounds, LARGEST), everywhere, grid)
    names = [*controllers, LIMIT]
    games = [(name, eps) for eps in bounds for name in names]
    results = list(_in_threads("worst-case scores", fine.score, games))
    scores = {name: tuple(results[i :: len(names)]) for i, name in enumerate(names)}
    bounds_won = _in_threads("margins", fine.margin, [(name,) for name in controllers])
    margins = dict(zip(controllers, bounds_won, strict=True))
    classes = {name: fine.map(name, bounds[-1]) for name in controllers}
    maps = Maps(bounds[-1], np.array(grid.counts), classes)
    coarse = fine
    if task.chart.dimension == 2:
        half = Grid.with_cells(task.chart, cells // 2)
        coarse = Game(task, parts, controllers, LARGEST, everywhere, half)
    curve, profile = _sweep(coarse, names, points)
    spacing, curve_spacing = (tuple(g.lattice.grid.spacing.tolist()) for g in (fine, coarse))
    lattice = LatticeSpacing(spacing, fine.lattice.exact, curve_spacing)
    misses = _misses(coarse, controllers)
    return GameResult(everywhere, lattice, scores, margins, misses, curve, profile), maps


def _sweep(game: Game, names: list[str], points: np.ndarray) -> tuple[Curve, Profile]:
    """Returns the curve over `CURVE`, and the profile of the noise that points (N, d) of M* bear."""
    task, dt = game.task, game.task.dt
    along = points[task.may_start(points)]
    at = game.lattice.grid.nearest(along)
    winnable: list[float] = []
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in names}
    holds = {name: np.ones(len(along), dtype=bool) for name in names}
    borne = {name: np.full(len(along), np.nan) for name in names}
    games = [(name, eps) for eps in CURVE for name in names]
    values = _in_threads("worst-case curve", game.value, games)
    for eps in CURVE:
        region = game.starts & game.winnable(eps)
        winnable.append(float(region.sum() / max(game.starts.sum(), 1)))
        for name in names:
            value = next(values)[:, :-2]
            own, worst = value[-1], value[:-1].max(axis=0)
            time_any = float(worst[region & (worst < NEVER)].max(initial=0) * dt)
            rows[name].append((share(own[region] < NEVER), share(worst[region] < NEVER), time_any))
            holds[name] &= own[at] < NEVER
            borne[name][holds[name]] = eps
    profile = Profile(
        points=tuple(tuple(point) for point in along.tolist()),
        eps={k: tuple(None if np.isnan(x) else float(x) for x in v) for k, v in borne.items()},
    )
    wins = {name: Wins(*zip(*row, strict=True)) for name, row in rows.items()}
    return Curve(CURVE, tuple(winnable), wins), profile


def _misses(game: Game, controllers: Mapping[str, Controller]) -> dict[str, float]:
    """Returns each controller's greatest distance from the set-point at the end of runs without noise."""
    task = game.task
    starts = game.lattice.grid.nodes[game.starts & game.winnable(0.0)]
    starts = starts[:: max(len(starts) // QUIET_EPISODES, 1)]
    quiet = LoopSettings(quiet=True)
    return {
        name: float(task.miss(closed_loop(task, loop, starts, settings=quiet).path[-1]).max())
        for name, loop in controllers.items()
    }


def _in_threads(
    label: str, work: Callable[..., Any], calls: Sequence[tuple[Any, ...]]
) -> Iterator[Any]:
    """Yields the results of calls in their order, from threads: NumPy releases the interpreter's lock."""
    with ThreadPoolExecutor(THREADS) as pool:
        results = pool.map(lambda call: work(*call), calls)
        yield from progress_bar(results, label, "games", len(calls))
