"""The worst-case game of one task: its examination of controllers, and the worst noise signals."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np

from hyrl_mj import cores
from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.game import result
from hyrl_mj.game.lattice import LATTICE, Lattice
from hyrl_mj.game.limit import Limit
from hyrl_mj.game.result import LIMIT, Curve, GameResult, Maps, Profile, Score, Wins
from hyrl_mj.game.solver import NEVER, Answers, Moves, WorstNoise, lasting, noisy_moves, solve
from hyrl_mj.policies import Controller, Policy, as_controller
from hyrl_mj.progress import progress_bar
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, Recorded, closed_loop
from hyrl_mj.tasks import Task

# The largest noise bound of the curve, and its bounds [chart units].
LARGEST = 0.3
CURVE = tuple(round(0.0125 * k, 4) for k in range(round(LARGEST / 0.0125) + 1))
# Approximate number of episodes without noise.
QUIET_EPISODES = 4000
# Games that are solved at the same time; each takes tens of megabytes.
THREADS = 4


class Game:
    """The worst-case game of one task, for several controllers and any noise bound.

    Args:
        task: the robot and its problem.
        parts: M_i of each mode, or a `Partition`; the limit takes its sides from them.
        controllers: controllers or policies by name; each must be a pure function.
        largest: the largest noise bound that can be played.
        everywhere: whether noise acts on all coordinates, not only on the task's noisy ones.
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
        """Returns the noise bounds by coordinate (d,)."""
        return self.task.noise_in_chart(eps, self.everywhere)

    @cached_property
    def starts(self) -> np.ndarray:
        """(N,) bool, the nodes of the start region."""
        return self.task.may_start(self.lattice.grid.nodes) & self.lattice.running

    def moves(self, name: str, eps: float) -> Moves:
        """Returns the adversary's moves against a controller, or against the limit."""
        if name not in (*self.answers, LIMIT):
            raise unknown("controller", name, (*self.answers, LIMIT))
        self.task.check_noise(eps, self.everywhere)
        if eps > self.largest + 1e-9:
            raise BadInput(
                f"noise {eps:g} exceeds the largest bound of this game, {self.largest:g}: "
                "create Game with a larger `largest`"
            )
        bound = self.bound(eps)
        return self.limit.moves(bound) if name == LIMIT else noisy_moves(self.answers[name], bound)

    def value(self, name: str, eps: float) -> np.ndarray:
        """Returns the game's value (modes + 1, places), the last row for runs that have not started.

        Only what happens within an episode counts: a value below `NEVER` is at most the task's `max_steps`.
        """
        return self._value(name, self.moves(name, eps), eps)

    def winnable(self, eps: float) -> np.ndarray:
        """Returns the nodes (N,) bool where holding the way of the first measurement wins in time."""
        return self.limit.winnable(self.bound(eps))

    def score(self, name: str, eps: float) -> Score:
        """Returns the score of a controller or of the limit."""
        moves = self.moves(name, eps)
        value = self._value(name, moves, eps)[:, :-2]
        region = self.starts & self.winnable(eps)
        own, worst = value[-1, region], value[:-1, region].max(axis=0, initial=0)
        still = lasting(moves) & ~self.lattice.failed
        nodes, dt = self.lattice.grid.nodes, self.task.dt
        return Score(
            eps=eps,
            winnable=float(region.sum() / max(self.starts.sum(), 1)),
            won=share(own < NEVER),
            won_any=share(worst < NEVER),
            time=float(own[own < NEVER].max(initial=0) * dt),
            time_any=float(worst[worst < NEVER].max(initial=0) * dt),
            excursion=float(self.task.miss(nodes[still]).max()) if still.any() else None,
        )

    def _value(self, name: str, moves: Moves, eps: float) -> np.ndarray:
        value = solve(moves, self.task.max_steps)
        if name == LIMIT:  # it holds the mode that it picks by the first measurement
            held = self.limit.held(self.bound(eps))
            value[-1, :-2] = np.where(held <= self.task.max_steps, held, NEVER)
        return value

    def map(self, name: str, eps: float) -> np.ndarray:
        """Returns the class (N,) of every node, an index into `MAP_CLASSES`."""
        value = self.value(name, eps)[:, :-2]
        classes = np.full(self.lattice.nodes, result.BEATEN, dtype=np.int8)
        classes[value[-1] < NEVER] = result.WON_FROM_SOME
        classes[(value < NEVER).all(axis=0)] = result.WON
        classes[(classes == result.BEATEN) & ~self.winnable(eps)] = result.UNWINNABLE
        classes[~self.lattice.running] = result.OVER
        return classes

    def margin(self, name: str) -> float | None:
        """Returns the largest noise bound at which the whole winnable start region is won, by bisection.

        The bound is exact to one cell of the lattice; None if some of the region is lost without noise.
        """
        cell = float(self.lattice.grid.spacing[self.bound(1.0) > 0].min())

        def all_won(cells: int) -> bool:
            own = self.value(name, cells * cell)[-1, :-2]
            return bool((own[self.starts & self.winnable(cells * cell)] < NEVER).all())

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
        """Returns the adversary's noise, to simulate with."""
        return WorstNoise(self.answers[name], self.bound(eps))


def share(won: np.ndarray) -> float:
    """Returns the share of (n,) bool that is true; 1 if n is 0."""
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
    """Returns the worst noise signal against a controller from starts (n, d), sample by sample.

    `simulate` with this signal from the same starts gives the runs of the game. The signal has a number of
    steps, by default the task's limit.
    """
    noise = game.worst_noise(name, eps)
    modes = None if q0 is None else np.full(len(z0), q0)
    loop, settings = as_controller(controller), LoopSettings(steps=steps, record=True)
    rollout = closed_loop(game.task, loop, z0, noise, modes, settings=settings)
    if not len(rollout.measured):  # all runs are over where they start
        return Recorded(np.zeros((1, len(z0), game.task.measurement_columns)), eps, kind="worst")
    rows = zip(rollout.measured, rollout.path[:-1], strict=True)
    true = np.stack([game.task.with_z(measured, z) for measured, z in rows])
    values = np.where(np.isnan(rollout.u).any(axis=-1)[..., None], 0.0, rollout.measured - true)
    return Recorded(values, eps, kind="worst")


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
    lattice = result.LatticeSpacing(spacing, fine.lattice.exact, curve_spacing)
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
    if not len(starts):
        return dict.fromkeys(controllers, 0.0)
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
    with ThreadPoolExecutor(min(THREADS, cores.count())) as pool:
        results = pool.map(lambda call: work(*call), calls)
        yield from progress_bar(results, label, "games", len(calls))
