"""Controllers in the worst case: what is proved, what is lost, margins, curve and maps."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from hyrl_mj.judging.game import (
    CURVE,
    LIMIT,
    NEARLY,
    NEVER,
    Curve,
    Game,
    GameResult,
    Lattice,
    LatticeSpacing,
    MapClass,
    Maps,
    NodeScore,
    Profile,
    ReplayCount,
    Score,
    SensedScore,
    WinningShares,
    curve_grid,
    largest_bound,
    lattice_grid,
    percent,
    share,
    wilson,
    won_in,
)
from hyrl_mj.judging.proof.cells import why_no_cells
from hyrl_mj.judging.proof.certificate import Certificate
from hyrl_mj.judging.proof.counterexamples import Broken, beaten, find_counterexamples
from hyrl_mj.judging.proof.replays import replay
from hyrl_mj.judging.proof.sensed import prove_under
from hyrl_mj.policies import BLAS, Controller
from hyrl_mj.sets import GridSet
from hyrl_mj.simulation import NOT_STARTED, LoopSettings, Sensor, closed_loop, covers_sensor
from hyrl_mj.system import cores
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Task


def worst_case(
    task: Task,
    points: np.ndarray,
    parts: Iterable[GridSet],
    controllers: Mapping[str, Controller],
    bounds: tuple[float, ...],
    everywhere: bool = False,
    cells: int = 0,
    curves: bool = True,
) -> tuple[GameResult, Maps]:
    """Plays the game: scores at some noise bounds, margins, the curve over all bounds, and the maps.

    Args:
        task: the robot and its problem.
        points: (N, d) points of M*, along which the margin is profiled.
        parts: M_i of each mode.
        controllers: controllers by name.
        bounds: noise bounds of the scores; the maps are drawn for the last.
        everywhere: whether noise acts on all coordinates.
        cells: number of lattice cells along the longest side of the chart, as in `lattice_grid`. The curve is
            computed with no more than `CURVE_CELLS`; where the game is an estimate it goes through the
            scores, and there are no margins.
        curves: whether there are margins and a curve; without them the curve goes through the scores, too.
    """
    Lattice.check(task)
    parts, grid = tuple(parts), lattice_grid(task, cells)
    Lattice.check(task, grid)
    exact = Lattice.decides(task, grid) and not why_no_cells(task, grid.counts)
    curves = curves and exact  # a coarser lattice would estimate nothing
    largest = largest_bound(task, max(bounds), everywhere) if curves else max(bounds)
    fine = Game(task, parts, controllers, largest, everywhere, grid)
    certificate = Certificate.certify(fine, controllers)
    scores, maps = _scores(certificate, bounds)
    replays = _replays(certificate, scores)
    if not curves:
        coarse, margins = fine, dict.fromkeys(controllers)
        curve, profile = _known(bounds, scores), Profile((), dict.fromkeys(scores, ()))
        sensed = {}
    else:
        coarse = Game(task, parts, controllers, largest, everywhere, curve_grid(task, cells))
        of_coarse = Certificate.certify(coarse, controllers)
        curve, profile = _sweep(of_coarse, points)
        sensed = _sensed(task, bounds[-1], (certificate, of_coarse))
        likely = [(name, _last_won(curve, curve.wins[name])) for name in controllers]
        margins = {name: x for (name, _), x in _in_threads("margins", fine.margin, likely).items()}
    spacing, curve_spacing = (tuple(g.lattice.grid.spacing.tolist()) for g in (fine, coarse))
    lattice = LatticeSpacing(
        spacing, fine.lattice.exact, certificate.cells is not None, curve_spacing
    )
    proved = {name: _proved_margin(curve, curve.wins[name]) for name in controllers}
    misses = _misses(coarse, controllers)
    result = GameResult(
        everywhere, lattice, scores, margins, proved, dict(certificate.why_not), misses, curve, profile,
        replays, sensed, _why_starts_are_others(certificate, scores, maps),
    )  # fmt: skip
    return result, maps


def _why_starts_are_others(
    certificate: Certificate, scores: Mapping[str, tuple[Score, ...]], maps: Maps
) -> str:
    """Returns why shares of the start region are no shares of the starts that a task draws; "" if they are.

    Scores count all of the region alike. A task may draw most of its starts where the hybrid controller
    loses; of one that wins too little for a good verdict that is not asked.
    """
    task, grid = certificate.game.task, certificate.game.lattice.grid
    classes, usual = maps.map.get("hyrl"), type(task).starts is Task.starts
    if usual or classes is None or certificate.cells is None:
        return ""
    if scores["hyrl"][-1].not_broken < NEARLY:
        return ""
    rng, number = np.random.default_rng(0), 100_000
    even = rng.uniform(task.start_low, task.start_high, (number, task.chart.dimension))
    samples = task.starts(number, rng), even[task.may_start(even)]
    proved = np.isin(classes, (MapClass.WON, MapClass.WON_FROM_SOME))
    for wins in (proved, proved | (classes == MapClass.UNCLEAR)):
        won = [wins[grid.nearest(z)] for z in samples]
        (_, most), (least, _) = (wilson(int(one.sum()), len(one)) for one in won)
        if most < NEARLY * least:  # by more than chance
            drawn, evenly = map(percent, map(share, won))
            return (
                f"the game counts all starts of the box alike, of which HyRL wins {evenly}, and "
                f"starts() of {task.name} draws others, of which it wins {drawn}"
            )
    return ""


def _scores(
    certificate: Certificate, bounds: tuple[float, ...]
) -> tuple[dict[str, tuple[Score, ...]], Maps]:
    """Returns the scores by controller, and the maps."""
    game, names = certificate.game, [*certificate.controllers, LIMIT]
    games = [(name, eps) for eps in bounds for name in names]
    nodes = _in_threads("worst-case scores", game.score, games)
    tried = [(name, eps) for name, eps in games if name != LIMIT]
    broken = _in_threads("attacks", partial(find_counterexamples, certificate), tried)
    scores = {
        name: tuple(
            _score(certificate, name, nodes[name, eps], broken.get((name, eps))) for eps in bounds
        )
        for name in names
    }
    classes = {name: _map(certificate, name, bounds[-1]) for name in certificate.controllers}
    maps = Maps(bounds[-1], np.array(game.lattice.grid.counts), classes)
    return scores, maps


def _sensed(
    task: Task, eps: float, certificates: tuple[Certificate, ...]
) -> dict[str, SensedScore]:
    """Returns what is proved under the task's own sensor, on the first lattice that is coarse enough."""
    if not covers_sensor(task, eps):
        return {}
    sensor = Sensor.parse(task.sensor)
    if not (sensor.late or sensor.bounds(task)[1].any()):  # all of it is noise, drawn anew
        return {}
    for certificate in certificates:
        if found := prove_under(certificate, sensor, eps):
            return found
    return {}


def _replays(
    certificate: Certificate, scores: Mapping[str, tuple[Score, ...]]
) -> tuple[ReplayCount, ...]:
    """Plays in MuJoCo what the scores at the largest bound say, and returns what was lost."""
    counts = (replay(certificate, name, scores[name][-1]) for name in certificate.controllers)
    return tuple(count for count in counts if count)


def _score(certificate: Certificate, name: str, nodes: NodeScore, broken: Broken | None) -> Score:
    """Returns the score of a controller, or of the limit, from that on the nodes."""
    game, eps = certificate.game, nodes.eps
    open_ = share(game.limit.open[game.starts])
    if broken is None:
        own, some = nodes.won, nodes.won_any
    else:
        region = certificate.region(eps) & broken.tried
        own, some = share(~broken.own[region]), share(~broken.some[region])
        if not region.any():  # a start region thinner than a cell
            own, some = nodes.won, nodes.won_any
    proved = certificate.wins(name, eps) if name in certificate.answers else (None,) * 4
    values: list[Any] = [*vars(nodes).values(), open_, *proved, own, some]
    return Score(*values)


def _map(certificate: Certificate, name: str, eps: float) -> np.ndarray:
    """Returns the class (N,) of every node; what is won counts as proved if all cells around it are.

    Where samples end between nodes the game calls a node lost too often: there it has to lose on the plant.
    """
    game = certificate.game
    classes = game.map(name, eps)
    lost = classes == MapClass.BEATEN
    if lost.any() and not (game.lattice.exact or game.lattice.estimate):
        starts, noise = game.lattice.grid.nodes[lost], game.worst_noise(name, eps)
        modes = np.full(len(starts), NOT_STARTED)
        plays = beaten(game, certificate.controllers[name], starts, modes, noise)
        classes[lost] = np.where(plays, MapClass.BEATEN, MapClass.UNCLEAR)
    won = np.isin(classes, (MapClass.WON, MapClass.WON_FROM_SOME))
    some = every = np.zeros_like(won)
    if name in certificate.answers and certificate.cells is not None:
        value, cells = certificate.value(name, eps)[:, :-2], certificate.cells
        some, every = (
            cells.all_around(wins | ~cells.running) & ~cells.all_around(~(wins & cells.running))
            for wins in (value[-1] < NEVER, (value < NEVER).all(axis=0))
        )
    classes[won] = np.where(
        every, MapClass.WON, np.where(some, MapClass.WON_FROM_SOME, MapClass.UNCLEAR)
    )[won]
    return classes


def _sweep(certificate: Certificate, points: np.ndarray) -> tuple[Curve, Profile]:
    """Returns the curve up to the game's largest bound, and the noise that points (N, d) of M* bear."""
    bounds = tuple(float(f"{certificate.game.largest * part:.10g}") for part in CURVE)
    game, names = certificate.game, [*certificate.controllers, LIMIT]
    task = game.task
    along = points[task.may_start(points)]
    at = game.lattice.grid.nearest(along)
    games = [(name, eps) for eps in bounds for name in names]
    values = _in_threads("worst-case curve", game.value, games)
    regions = [game.starts & game.winnable(eps) for eps in bounds]
    proofs = [(name, eps) for name in certificate.answers for eps in bounds]
    proved = _in_threads("proofs", certificate.wins, proofs)
    wins, borne = {}, {}
    for name in names:
        holds, bears = np.ones(len(along), dtype=bool), np.full(len(along), np.nan)
        rows: list[tuple[float, float, float | None]] = []
        for eps, region in zip(bounds, regions, strict=True):
            value = values[name, eps][:, :-2]
            first, worst, _, latest = won_in(region, value, task.dt)
            rows.append((first, worst, latest if worst else None))
            holds &= value[-1, at] < NEVER
            bears[holds] = eps
        of_cells = [proved[name, eps] for eps in bounds if name in certificate.answers]
        own, some = (tuple(found[i] for found in of_cells) for i in range(2))
        won, won_any, times = zip(*rows, strict=True)
        wins[name] = WinningShares(won, won_any, own, some, times)
        borne[name] = tuple(None if np.isnan(x) else float(x) for x in bears)
    winnable = tuple(float(region.sum() / max(game.starts.sum(), 1)) for region in regions)
    profile = Profile(tuple(tuple(point) for point in along.tolist()), borne)
    return Curve(bounds, winnable, wins), profile


def _known(bounds: tuple[float, ...], scores: Mapping[str, tuple[Score, ...]]) -> Curve:
    """Returns the curve through the scores at some bounds, of what is not broken."""
    wins = {}
    for name, level in scores.items():
        own, some = zip(*((s.not_broken, s.not_broken_any) for s in level), strict=True)
        wins[name] = WinningShares(own, some, (), (), tuple(s.time_any for s in level))
    winnable = tuple(score.winnable for score in next(iter(scores.values())))
    return Curve(bounds, winnable, wins)


def _last_won(curve: Curve, wins: WinningShares) -> tuple[float, float]:
    """Returns the bounds of the curve between which some nodes begin to be lost."""
    lost = next((i for i, won in enumerate(wins.won) if won < 1), len(curve.eps) - 1)
    return curve.eps[max(lost - 1, 0)], curve.eps[lost]


def _proved_margin(curve: Curve, wins: WinningShares) -> float | None:
    """Returns the largest bound of the curve up to which nearly all winnable starts are proved."""
    margin = None
    for eps, proved in zip(curve.eps, wins.proved, strict=False):
        if proved < NEARLY:
            break
        margin = eps
    return margin


def _misses(game: Game, controllers: Mapping[str, Controller]) -> dict[str, float]:
    """Returns each controller's greatest distance from the set-point at the end of runs without noise."""
    task = game.task
    starts = game.lattice.grid.nodes[game.starts & game.winnable(0.0)]
    if not len(starts):
        return dict.fromkeys(controllers, 0.0)
    starts = starts[:: max(len(starts) // 1_000, 1)]  # about as many episodes
    quiet = LoopSettings(quiet=True)
    return {
        name: float(task.miss(closed_loop(task, loop, starts, settings=quiet).path[-1]).max())
        for name, loop in controllers.items()
    }


def _in_threads(
    label: str, work: Callable[..., Any], calls: Sequence[tuple[Any, ...]]
) -> dict[tuple[Any, ...], Any]:
    """Returns what calls give by their arguments, from threads: NumPy releases the interpreter's lock."""
    threads = min(4, cores.count())  # each game takes tens of megabytes
    # One limit for all threads: those within would undo each other's.
    with BLAS.limit(limits=1, user_api="blas"), ThreadPoolExecutor(threads) as pool:
        results = pool.map(lambda call: work(*call), calls)
        found = progress_bar(results, label, "games", len(calls))
        return dict(zip(calls, found, strict=True))
