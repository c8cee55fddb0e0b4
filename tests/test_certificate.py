"""The certificate: what it calls proved no noise and no sensor beats, and it misses little."""

from itertools import pairwise

import numpy as np
import pytest
from planted import halves, ideal_controller, sign_policy

from hyrl_mj import HybridController, MlpPolicy, Noise, Sensor, get_task
from hyrl_mj.judging import worst_case as examination
from hyrl_mj.judging.game import NEVER, Game, MapClass, Robustness
from hyrl_mj.judging.proof import CellNoise, Certificate, find_counterexamples
from hyrl_mj.judging.proof.sensed import Memory, proved_cells
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


def games(task, loops, cells, largest=EPS):
    """The game of some controllers on so many cells, and its certificate."""
    game = Game(task, halves(task), loops, largest, grid=Grid.with_cells(task.chart, cells))
    return game, Certificate.certify(game, loops)


@pytest.fixture(scope="module", params=["vehicle", "unit_circle"])
def certified(request, vehicle, circle):
    if request.param == "vehicle":
        loops = {"policy": PolicyController(sideways(vehicle, 1, 1.1)), "hyrl": hybrid(vehicle)}
        task, cells = vehicle, 120
    else:
        loops, task, cells = {"policy": PolicyController(turning(circle))}, circle, 2_000
    game, certificate = games(task, loops, cells)
    return game, loops, certificate


def played(game, loop, starts, noise, modes=None, seed=0):
    """The runs from starts (n, d), and which of them arrive."""
    settings = LoopSettings(quiet=True)
    run = closed_loop(game.task, loop, starts, noise, modes, seed=seed, settings=settings)
    return run, run.outcome == Outcome.REACHED


@pytest.mark.slow
def test_no_noise_beats_what_is_proved_nor_arrives_later(certified):
    game, loops, certificate = certified
    rng, cells, n = np.random.default_rng(0), certificate.cells, 100
    for name, loop in loops.items():
        outer = certificate.value(name, EPS)
        noises = [Noise("uniform", EPS), Noise("alternating", EPS), game.worst_noise(name, EPS)]
        noises.append(CellNoise(certificate, name, EPS))
        for row, mode in enumerate((*loop.modes, None)):
            proved = np.flatnonzero((outer[row, :-2] < NEVER) & cells.running)
            assert len(proved) > 0.2 * cells.nodes
            starts = cells.draw(at := rng.choice(proved, n), rng)
            modes = None if mode is None else np.full(n, mode)
            for k, noise in enumerate(noises):
                run, arrives = played(game, loop, starts, noise, modes, seed=k)
                assert arrives.all(), (name, mode, noise)
                taken = run.length
                if game.task.name == "unit_circle":  # its episodes go on at the set-point
                    arrived = np.array([game.task.arrived(z) for z in run.path])
                    assert arrived.any(axis=0).all()
                    taken = arrived.argmax(axis=0)
                assert (taken <= outer[row, at]).all()
                if mode is None and noise.kind in ("uniform", "worst"):
                    late = outer[row, at] - taken
                    assert np.median(late) <= 2, "the bound is no larger than it must be"


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
    for cells in (120, 240):
        _, certificate = games(vehicle, loops, cells)
        own, some, time, _ = certificate.wins("hyrl", EPS)
        broken = find_counterexamples(certificate, "hyrl", EPS)
        region = certificate.region(EPS)
        gaps.append((~broken.own[region]).mean() - own)
        assert some <= own
        assert time == pytest.approx(3.0)
    assert 0 <= gaps[1] < 0.005
    assert gaps[1] < gaps[0]


def test_the_share_that_is_proved_falls_with_the_noise(certified):
    _, loops, certificate = certified
    for name in loops:
        values = [certificate.value(name, eps)[:, :-2] < NEVER for eps in (0.0, 0.04, 0.08, 0.1)]
        for less, more in pairwise(values):
            assert not (more & ~less).any()


@pytest.mark.slow
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
            beaten = ~played(game, loop, starts, game.worst_noise(name, EPS))[1]
            expected = np.zeros_like(nodes)
            expected[np.flatnonzero(nodes)[beaten]] = True
            assert (certificate.cells.some_corner(expected) <= broken.own).all()
            assert beaten.mean() > 0.9 or not game.lattice.exact


@pytest.mark.slow
def test_noise_between_the_nodes_beats_what_the_game_calls_won(vehicle):
    """A start set that flips right beside a node of the game, as nobody can see on the nodes."""
    loops = {"hyrl": hybrid(vehicle, overlap=EPS - 0.004)}
    game, certificate = games(vehicle, loops, 120)
    broken, region = find_counterexamples(certificate, "hyrl", EPS), certificate.region(EPS)
    nodes = game.score("hyrl", EPS)
    own, *_ = certificate.wins("hyrl", EPS)
    assert own <= (~broken.own[region]).mean() <= nodes.won


@pytest.mark.slow
def test_what_cannot_be_bounded_is_attacked_all_the_same(vehicle):
    loops = {"policy": PolicyController(sign_policy(vehicle)), "hyrl": ideal_controller(vehicle)}
    game, certificate = games(vehicle, loops, 60)
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
def test_an_examination_carries_what_is_proved(vehicle, monkeypatch):
    monkeypatch.setattr(examination, "CURVE", (0.0, 1 / 3))
    monkeypatch.setattr(examination, "_replays", lambda certificate, scores: ())
    loops = {"policy": PolicyController(sideways(vehicle, 1, 1.1)), "hyrl": hybrid(vehicle)}
    result, maps = examination.worst_case(
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


@pytest.mark.slow
def test_where_runs_never_end_what_is_proved_stays_at_the_set_point(circle):
    loops = {"policy": PolicyController(turning(circle))}
    _, certificate = games(circle, loops, 1_000, 0.35)
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


@pytest.mark.slow
def test_nothing_is_proved_of_a_start_region_that_is_thinner_than_a_cell(vehicle, monkeypatch):
    monkeypatch.setattr(examination, "_replays", lambda certificate, scores: ())

    class Line(type(vehicle)):
        start_low, start_high = (0.0, -1.0), (0.0, 1.0)

    task, loops = Line(), {"hyrl": hybrid(vehicle)}
    _, certificate = games(task, loops, 60)
    assert certificate.wins("hyrl", EPS) == (0.0, 0.0, 0.0, 0.0)
    points = np.empty((0, 2))
    result, _ = examination.worst_case(
        task, points, halves(task), loops, (EPS,), cells=60, curves=False
    )
    score = result.scores["hyrl"][0]
    assert (score.proved, score.not_broken) == (0.0, score.won)


@pytest.mark.slow
def test_shares_of_the_box_are_none_of_starts_that_are_drawn_where_it_loses(vehicle, monkeypatch):
    monkeypatch.setattr(examination, "_replays", lambda certificate, scores: ())

    class Even(type(vehicle)):
        def starts(self, n, rng):
            return rng.uniform(self.start_low, self.start_high, (n, 2))

    class Late(Even):
        def starts(self, n, rng):
            late = rng.uniform((0.3, -0.05), (0.4, 0.05), (n, 2))
            return np.where(rng.random((n, 1)) < 0.9, late, super().starts(n, rng))

    # Of a controller that loses too much for a good word it is not asked.
    for task, loop, told in (
        (Even(), hybrid, False),
        (Late(), hybrid, True),
        (Late(), lambda task: PolicyController(sideways(task, 1, 1.1)), False),
    ):
        result, _ = examination.worst_case(
            task,
            np.empty((0, 2)),
            halves(task),
            {"hyrl": loop(task)},
            (EPS,),
            cells=60,
            curves=False,
        )
        assert not result.estimate
        assert ("starts() of vehicle draws others" in result.other_starts) == told
        assert (Robustness(EPS, False, result, (), 0).deciding is None) == told


# ---- under a sensor that remembers


def nearer_side(task):
    """Drives to the side of the vehicle's pillar on which it is, until |y| is 1.1 m, then straight on."""
    policy = linear(task, np.zeros((5, 3)), [0.0, -99.0, -1.1, -99.0, 0.0])
    weights = dict(policy.weights)
    by_side = weights[
        "action_net.weight"
    ].copy()  # of y where it is positive, and where it is negative
    by_side[[4, 0, 2], 2], by_side[[4, 0, 2], 5] = (1.0, -1.0, 2.0), (-1.0, 1.0, 2.0)
    return MlpPolicy(task, "ppo", "relu", weights | {"action_net.weight": by_side})


@pytest.mark.parametrize(("delay", "hold"), [(0, 3), (1, 2), (3, 1)])
def test_memories_are_what_a_late_sensor_shows(delay, hold):
    shifts = [(2, -1), (2, 0), (2, 1)]
    memory = Memory.of_sensor(shifts, delay, hold, 10_000)
    rng = np.random.default_rng(0)
    for _ in range(20):
        at, held, places, shown = 0, 0, [np.zeros(2, dtype=int)] * (delay + 1), np.zeros(2)
        for _ in range(12):
            which = rng.integers(len(shifts))
            places = [*places, places[-1] + shifts[which]]
            lost = rng.random() < 0.5 and held < hold
            held = held + 1 if lost else 0
            shown = shown if lost else places[-1 - delay]
            at = memory.after[at, which, int(lost)]
            np.testing.assert_array_equal(memory.shown[at], places[-1] - shown)


def test_too_many_memories_are_not_played():
    assert Memory.of_sensor([(1, 0), (1, 1)], 3, 3, 20) is None


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "stronger"),
    [
        ("uniform 0.05 + bias 0.05 + delay 1", "alternating 0.05 + bias 0.05 + delay 1"),
        ("uniform 0.05 + hold 2", "alternating 0.05 + hold 2 rate 0.9"),
        ("uniform 0.08 + delay 0-2", "alternating 0.08 + delay 2"),
    ],
)
def test_no_such_sensor_beats_what_is_proved(text, stronger, monkeypatch):
    monkeypatch.setattr("hyrl_mj.judging.proof.sensed.BIASES", 4)
    sensor = Sensor.parse(text)
    bound, shares = sensor.on(get_task("vehicle"))
    task = get_task("vehicle").with_sensor(text, shares)
    loops = {"policy": PolicyController(nearer_side(task)), "hyrl": hybrid(task)}
    game, certificate = games(task, loops, 120, bound)
    cells, rng, lost = certificate.cells, np.random.default_rng(0), {}
    starts = cells.all_corners(game.starts)
    for name, loop in loops.items():
        own, some = proved_cells(certificate, name, sensor)
        covered = certificate.value(name, bound)[-1, : cells.nodes] < NEVER
        assert own[starts].sum() > covered[starts].sum()
        for proved in (own, ~own):
            at = np.flatnonzero(proved & starts)
            # Those near the axis are the weakest.
            near = at[np.argsort(np.abs(cells.middle(at)[:, 1]))[: len(at) // 3]]
            z = cells.draw(rng.choice(near, 300), rng)
            arrives = [played(game, loop, z, Sensor.parse(noise))[1] for noise in (text, stronger)]
            lost[name, proved is own] = int((~np.array(arrives)).sum())
        z = cells.draw(rng.choice(np.flatnonzero(some & starts), 200), rng)
        for q in loop.modes:
            assert played(game, loop, z, Sensor.parse(stronger), np.full(len(z), q))[1].all()
    assert lost["policy", True] == lost["hyrl", True] == 0
    assert lost["policy", False] > 0
