"""The certificate: what it calls proved no noise beats, and it misses little; what it calls lost was lost."""

from itertools import pairwise

import numpy as np
import pytest
from planted import halves, ideal_controller, sign_policy

from hyrl_mj import HybridController, MlpPolicy, Noise
from hyrl_mj.judging.game import NEVER, Game, MapClass
from hyrl_mj.judging.proof import CellNoise, Certificate, find_counterexamples
from hyrl_mj.judging.worst_case import worst_case
from hyrl_mj.policies import PolicyController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.tasks import Outcome

WON, WON_FROM_SOME, UNCLEAR, BEATEN, UNWINNABLE, OVER = MapClass

EPS = 0.1


def linear(task, weights, bias, activation="relu"):
    """A network whose outputs are weights @ observation + bias; its hidden units never saturate."""
    weights, bias = np.atleast_2d(weights), np.atleast_1d(bias)
    k = weights.shape[1]
    first = np.vstack([np.eye(k), -np.eye(k)]).astype(np.float32)
    tensors = {
        "mlp_extractor.policy_net.0.weight": first,
        "mlp_extractor.policy_net.0.bias": np.zeros(2 * k, np.float32),
        "action_net.weight": np.hstack([weights, -weights]).astype(np.float32),
        "action_net.bias": bias.astype(np.float32),
    }
    return MlpPolicy(task, "ppo", activation, tensors)


def sideways(task, side, until):
    """Drives to one side of the vehicle's pillar until |y| is `until`, then straight on."""
    prefer = [[0.0, 0.0, 0.0]] * 5
    bias = [-99.0] * 5
    bias[2], bias[4 if side > 0 else 0] = 0.0, until
    prefer[4 if side > 0 else 0] = [0.0, 0.0, -side]
    return linear(task, prefer, bias)


def turning(task):
    """Turns the circle's pointer at a rate of 3 sin(theta - pi), the shorter way to the set-point."""
    return linear(task, [[0.0, -3.0]], [0.0])


def hybrid(task, overlap=0.15, cells=480):
    """The vehicle's hybrid controller of two such policies, with sets that overlap around the axis."""
    grid = Grid.with_cells(task.chart, cells)
    x, y = grid.nodes.T
    both = x > task.obstacle[0]
    # The overlap ends where the other way is about to close.
    width = np.clip(0.439 - x - EPS, EPS, overlap)
    sets = {q: GridSet.from_mask(grid, both | (s * y > -width)) for q, s in ((0, 1), (1, -1))}
    starts = {q: GridSet.from_mask(grid, both | (s * y >= 0)) for q, s in ((0, 1), (1, -1))}
    policies = {q: sideways(task, s, 1.1) for q, s in ((0, 1), (1, -1))}
    return HybridController(task, policies, sets, starts)


@pytest.fixture(scope="module", params=["vehicle", "unit_circle"])
def certified(request, vehicle, circle):
    if request.param == "vehicle":
        loops = {"policy": PolicyController(sideways(vehicle, 1, 1.1)), "hyrl": hybrid(vehicle)}
        task, cells = vehicle, 240
    else:
        loops, task, cells = {"policy": PolicyController(turning(circle))}, circle, 2_000
    game = Game(task, halves(task), loops, EPS, grid=Grid.with_cells(task.chart, cells))
    return game, loops, Certificate.certify(game, loops)


def played(game, loop, starts, noise, modes=None, seed=0):
    """Which runs from starts (n, d) arrive."""
    settings = LoopSettings(quiet=True)
    run = closed_loop(game.task, loop, starts, noise, modes, seed=seed, settings=settings)
    return run.outcome == Outcome.REACHED


@pytest.mark.slow
def test_no_noise_beats_what_is_proved(certified):
    game, loops, certificate = certified
    rng, cells, n = np.random.default_rng(0), certificate.cells, 1_000
    for name, loop in loops.items():
        outer = certificate.value(name, EPS)
        noises = [Noise("uniform", EPS), Noise("alternating", EPS), game.worst_noise(name, EPS)]
        noises.append(CellNoise(certificate, name, EPS))
        for row, mode in enumerate((*loop.modes, None)):
            proved = np.flatnonzero((outer[row, :-2] < NEVER) & cells.running)
            assert len(proved) > 0.2 * cells.nodes
            at = rng.choice(proved, n)
            off = rng.uniform(-0.5, 0.5, (n, len(cells.counts)))
            starts = cells.middle(at) + off * game.lattice.grid.spacing
            modes = None if mode is None else np.full(n, mode)
            for k, noise in enumerate(noises):
                assert played(game, loop, starts, noise, modes, seed=k).all(), (name, mode, noise)


@pytest.mark.parametrize("certified", ["vehicle"], indirect=True)
def test_what_the_game_loses_at_a_corner_is_never_proved(certified):
    """On the vehicle, whose lattice is exact: on the circle the game errs to the adversary's side."""
    game, loops, certificate = certified
    assert game.lattice.exact
    for name in loops:
        for eps in (0.0, 0.05, EPS):
            lost = game.value(name, eps)[:, :-2] >= NEVER
            proved = certificate.value(name, eps)[:, :-2] < NEVER
            for nodes, cells in zip(lost, proved, strict=True):
                touched = certificate.cells.some_corner(nodes & game.lattice.running)
                assert touched.any()
                assert not (touched & cells & certificate.cells.running).any()


@pytest.mark.slow
def test_the_gap_closes_as_the_cells_become_smaller(vehicle):
    loops, gaps = {"hyrl": hybrid(vehicle)}, []
    for cells in (120, 240, 480):
        game = Game(
            vehicle, halves(vehicle), loops, EPS, grid=Grid.with_cells(vehicle.chart, cells)
        )
        certificate = Certificate.certify(game, loops)
        own, some, time, _ = certificate.wins("hyrl", EPS)
        broken = find_counterexamples(certificate, "hyrl", EPS)
        region = certificate.region(EPS)
        gaps.append((~broken.own[region]).mean() - own)
        assert some <= own
        assert time == pytest.approx(3.0)
    assert gaps[2] < gaps[0]
    assert 0 <= gaps[2] < 0.005


def test_the_share_that_is_proved_falls_with_the_noise(certified):
    _, loops, certificate = certified
    for name in loops:
        values = [certificate.value(name, eps)[:, :-2] < NEVER for eps in (0.0, 0.04, 0.08, 0.1)]
        for less, more in pairwise(values):
            assert not (more & ~less).any()


def test_the_time_to_arrival_is_bounded(certified):
    game, loops, certificate = certified
    rng, cells = np.random.default_rng(1), certificate.cells
    for name, loop in loops.items():
        value = certificate.value(name, EPS)[-1, :-2]
        at = rng.choice(np.flatnonzero((value < NEVER) & cells.running), 500)
        starts = cells.middle(at) + rng.uniform(-0.5, 0.5, (500, len(cells.counts))) * (
            game.lattice.grid.spacing
        )
        for noise in (Noise("uniform", EPS), game.worst_noise(name, EPS)):
            settings = LoopSettings(quiet=True)
            run = closed_loop(game.task, loop, starts, noise, seed=3, settings=settings)
            if game.task.name == "unit_circle":  # its episodes go on at the set-point
                arrived = np.array([game.task.arrived(z) for z in run.path])
                assert arrived.any(axis=0).all()
                taken = arrived.argmax(axis=0)
            else:
                taken = run.length
            assert (taken <= value[at]).all()
            assert np.median(value[at] - taken) <= 2, "the bound is no larger than it must be"


def test_starts_that_count_as_broken_are_lost_on_the_plant(certified):
    game, loops, certificate = certified
    for name, loop in loops.items():
        broken = find_counterexamples(certificate, name, EPS)
        region = certificate.region(EPS)
        proved = certificate.value(name, EPS)[:, :-2] < NEVER
        assert not (broken.own & proved[-1] & region).any()
        assert not (broken.some & proved[:-1].all(axis=0) & region).any()
        lost = game.value(name, EPS)[-1, :-2] >= NEVER
        nodes = lost & game.starts & game.winnable(EPS)
        starts = game.lattice.grid.nodes[nodes]
        if len(starts):
            beaten = ~played(game, loop, starts, game.worst_noise(name, EPS))
            expected = np.zeros_like(nodes)
            expected[np.flatnonzero(nodes)[beaten]] = True
            assert (certificate.cells.some_corner(expected) <= broken.own).all()
            assert beaten.mean() > 0.9 or not game.lattice.exact


def test_noise_between_the_nodes_beats_what_the_game_calls_won(vehicle):
    """A start set that flips right beside a node of the game, as nobody can see on the nodes."""
    loops = {"hyrl": hybrid(vehicle, overlap=EPS - 0.004)}
    game = Game(vehicle, halves(vehicle), loops, EPS, grid=Grid.with_cells(vehicle.chart, 120))
    certificate = Certificate.certify(game, loops)
    broken, region = (
        find_counterexamples(certificate, "hyrl", EPS),
        certificate.region(EPS),
    )
    nodes = game.score("hyrl", EPS)
    own, *_ = certificate.wins("hyrl", EPS)
    assert own <= (~broken.own[region]).mean() <= nodes.won


def test_what_cannot_be_bounded_is_attacked_all_the_same(vehicle):
    loops = {"policy": PolicyController(sign_policy(vehicle)), "hyrl": ideal_controller(vehicle)}
    game = Game(vehicle, halves(vehicle), loops, EPS, grid=Grid.with_cells(vehicle.chart, 120))
    certificate = Certificate.certify(game, loops)
    assert certificate.why_not == {
        "policy": "a policy that is a ChartPolicy cannot be bounded",
        "hyrl": "a AnalyticSet cannot be bounded: give sets on grids",
    }
    assert find_counterexamples(certificate, "policy", EPS).own.any()
    none = Certificate(game, loops, None, {}, {})
    nodes = find_counterexamples(none, "policy", EPS)
    assert nodes.own.shape == (game.lattice.nodes,)
    assert nodes.own.any()
    assert (none.region(EPS) == (game.starts & game.winnable(EPS))).all()


@pytest.mark.slow
def test_an_examination_carries_what_is_proved(vehicle):
    loops = {"policy": PolicyController(sideways(vehicle, 1, 1.1)), "hyrl": hybrid(vehicle)}
    result, maps = worst_case(
        vehicle, np.array([[0.0, 0.0], [0.2, 0.0]]), halves(vehicle), loops, (0.0, EPS), cells=120
    )
    for name in loops:
        for score in result.scores[name]:
            assert score.proved <= score.not_broken
            assert score.open == result.scores[name][0].open, (
                "what is open has nothing to do with noise"
            )
            assert score.proved_any <= score.proved
            assert score.proved_any <= score.not_broken_any
        wins = result.curve.wins[name]
        assert len(wins.proved) == len(wins.proved_any) == len(result.curve.eps)
        assert all(proved <= won + 0.02 for proved, won in zip(wins.proved, wins.won, strict=True))
    assert result.proved_margin["hyrl"] >= EPS > 0
    assert result.why_not_proved == {}
    assert result.scores["limit"][0].proved is None
    classes = maps.map["hyrl"]
    assert {WON, WON_FROM_SOME, UNCLEAR, OVER} <= set(np.unique(classes).tolist())
    proved = np.isin(classes, (WON, WON_FROM_SOME))
    game = Game(vehicle, halves(vehicle), loops, EPS, grid=maps.grid(vehicle.chart))
    assert (proved <= np.isin(game.map("hyrl", EPS), (WON, WON_FROM_SOME))).all()


def test_where_runs_never_end_what_is_proved_stays_at_the_set_point(circle):
    loops = {"policy": PolicyController(turning(circle))}
    grid = Grid.with_cells(circle.chart, 1_000)
    game = Game(circle, halves(circle), loops, 0.35, grid=grid)
    certificate = Certificate.certify(game, loops)
    own, *_ = certificate.wins("policy", 0.05)
    assert own > 0.9
    cells, value = certificate.cells, certificate.value("policy", 0.05)[-1, :-2]
    at = np.flatnonzero(value < NEVER)[::7]
    settings = LoopSettings(quiet=True, steps=400)
    noise = CellNoise(certificate, "policy", 0.05)
    run = closed_loop(circle, loops["policy"], cells.middle(at), noise, settings=settings)
    assert (circle.miss(run.path[-1]) <= circle.close).all(), "long after the end of an episode"
    # More noise than the set-point is wide can lead any run away from it again.
    assert certificate.wins("policy", 0.35) == (0.0, 0.0, 0.0, 0.0)


def test_nothing_is_proved_of_a_start_region_that_is_thinner_than_a_cell(vehicle):
    class Line(type(vehicle)):
        start_low, start_high = (0.0, -1.0), (0.0, 1.0)

    task, loops = Line(), {"hyrl": hybrid(vehicle)}
    game = Game(task, halves(task), loops, EPS, grid=Grid.with_cells(task.chart, 60))
    certificate = Certificate.certify(game, loops)
    assert certificate.wins("hyrl", EPS) == (0.0, 0.0, 0.0, 0.0)
    result, _ = worst_case(task, np.empty((0, 2)), halves(task), loops, (EPS,), cells=60)
    score = result.scores["hyrl"][0]
    assert (score.proved, score.not_broken) == (0.0, score.won)
