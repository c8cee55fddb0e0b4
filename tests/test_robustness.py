"""Scores, margins and maps of the worst-case game, and the files they go into."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planted import (
    EXACT,
    ChartPolicy,
    circle_policy,
    decisions,
    halves,
    sign_policy,
)

from hyrl_mj import BadInput, Noise, simulate
from hyrl_mj.judging import margin_text, worst_case as examination
from hyrl_mj.judging.game import (
    CURVE,
    LIMIT,
    Curve,
    Game,
    MapClass,
    Robustness,
    largest_bound,
    worst_signal,
)
from hyrl_mj.judging.game.solver import NEVER
from hyrl_mj.judging.worst_case import worst_case
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import closed_loop
from hyrl_mj.tasks import Outcome

WON, WON_FROM_SOME, UNCLEAR, BEATEN, UNWINNABLE, OVER = MapClass

PI = np.pi


@pytest.fixture(scope="module", autouse=True)
def whole_curve():
    """The curve goes through all bounds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(examination, "CURVE", CURVE)
        yield


# ---- scores


def test_the_ideal_rule_wins_everything_but_the_wrong_start_mode(game_on_vehicle):
    score = game_on_vehicle.score("ideal", 0.1)
    assert score.won == 1.0
    assert 0.9 < score.won_any < 1.0
    assert score.time == score.time_any == pytest.approx(3.0)
    assert score.excursion is None, "every run is over some day"


def test_the_excursion_of_a_trapped_policy_is_the_far_side(game_on_circle):
    game = game_on_circle
    assert game.score("sign", 0.1).excursion == pytest.approx(PI, abs=game.lattice.grid.cell)
    assert game.score("sign", 0.1).won == pytest.approx(1 - 0.2 / (2 * PI), abs=2e-3)


def test_noise_on_all_coordinates_is_worse_where_all_matter(vehicle):
    controllers = {
        "straight": PolicyController(sign_policy(vehicle)),
        "slanted": PolicyController(sign_policy(vehicle, lambda x: x - 0.3)),
    }
    grid = Grid.with_cells(vehicle.chart, 120)
    across, everywhere = (
        Game(vehicle, halves(vehicle), controllers, 0.1, flag, grid) for flag in (False, True)
    )
    np.testing.assert_array_equal(across.bound(0.1), [0.0, 0.1])
    np.testing.assert_array_equal(everywhere.bound(0.1), [0.1, 0.1])
    less, more = (game.value("straight", 0.1) for game in (across, everywhere))
    np.testing.assert_array_equal(more, less)
    less, more = (game.value("slanted", 0.1) for game in (across, everywhere))
    assert (more >= less).all()
    assert (more > less).any()


def test_noise_beyond_what_was_prepared_is_refused(game_on_vehicle):
    game = game_on_vehicle
    with pytest.raises(BadInput, match=r"noise 0.25 exceeds the largest bound of this game, 0.2"):
        game.score("sign", 0.25)


def test_a_game_under_noise_that_hides_everything_is_refused(vehicle):
    with pytest.raises(BadInput, match=r"noise bound 1.5 hides the whole state space of vehicle"):
        Game(vehicle, halves(vehicle, 60), {}, 1.5)


@pytest.mark.parametrize(
    ("eps", "largest"), [(0.0, 0.3), (0.1, 0.3), (0.2, 0.6), (0.45, 1.2), (1.4, 1.4)]
)
def test_the_curve_goes_as_far_as_the_bound_of_a_run_and_the_chart_ask_for(vehicle, eps, largest):
    assert largest_bound(vehicle, eps, everywhere=True) == largest
    vehicle.check_noise(largest)
    small = type("Small", (type(vehicle),), {"chart": replace(vehicle.chart, high=(0.1, -1.45))})()
    assert largest_bound(small, eps / 80, everywhere=False) <= 0.02  # of a side of 0.05


def test_a_margin_that_nothing_tried_exceeds_is_at_least_that(vehicle):
    game = SimpleNamespace(
        curve=Curve((0.0, 0.3), (), {}), lattice=SimpleNamespace(spacing=(0.01,))
    )
    texts = [margin_text(margin, "m", game) for margin in (None, 0.28, 0.2951)]
    assert texts == ["none", "0.28 m", "at least 0.295 m"]


# ---- the time of an episode


@pytest.mark.slow
def test_won_is_what_arrives_before_the_episode_ends(circle, monkeypatch):
    monkeypatch.setattr(examination, "CURVE", CURVE[::8])

    def quarter(z):
        return np.where(circle.chart.wrap(z) < PI, -0.25, 0.25)  # it takes 11 s for the longest way

    loop = {"slow": PolicyController(ChartPolicy(circle, quarter))}
    grid = Grid.with_cells(circle.chart, 503)  # a sample leads from node to node
    game = Game(circle, halves(circle), loop, 0.1, grid=grid)
    arcs = simulate(circle, loop["slow"], grid.nodes)
    reached = np.array([arc.outcome == "reached" for arc in arcs])
    assert 0.6 < reached.mean() < 0.8
    value = game.value("slow", 0.0)[-1, :-2]
    assert np.count_nonzero((value < NEVER) != reached) <= 2, "but for the border"
    assert value[value < NEVER].max() == circle.max_steps
    score = game.score("slow", 0.0)
    assert score.won == score.won_any == pytest.approx(reached.mean(), abs=3 / len(reached))
    assert score.time == score.time_any == circle.max_steps * circle.dt
    np.testing.assert_array_equal(game.map("slow", 0.0) == WON, value < NEVER)
    assert (game.map("slow", 0.0) == BEATEN).any(), "faster controllers arrive"
    assert game.margin("slow") is None
    named = {"policy": loop["slow"], "hyrl": loop["slow"]}
    result, maps = worst_case(
        circle, np.empty((0, 1)), halves(circle), named, (0.0, 0.1), cells=503
    )
    assert result.curve.wins["hyrl"].won[0] == score.won
    assert (maps.map["hyrl"] == UNCLEAR).mean() == result.scores["hyrl"][-1].won


def test_what_nobody_reaches_in_time_is_not_winnable(circle):
    class Hurried(type(circle)):
        max_steps = 20  # 1 s, for up to 3.14 rad at 1 rad/s

    task = Hurried()
    loop = {"sign": PolicyController(circle_policy(task))}
    game = Game(task, halves(task), loop, 0.1, grid=Grid.with_cells(task.chart, EXACT))
    score, off = game.score("sign", 0.0), np.abs(task.error(game.lattice.grid.nodes))
    assert score.winnable == pytest.approx((off <= 1.3).mean(), abs=0.01)
    assert score.won == 1.0
    assert game.score(LIMIT, 0.1).won == 1.0
    assert game.map("sign", 0.1)[game.lattice.grid.nearest(np.array([[PI]]))[0]] == UNWINNABLE


# ---- margins


@pytest.mark.parametrize("name", ["narrow", "ideal", "grazing"])
def test_the_margin_of_the_ideal_rule_is_its_overlap_or_its_clearance(game_on_vehicle, name):
    # Beyond its overlap noise turns a run back that has no room left; the pillar is at 0.751 m.
    known = {"narrow": 0.054, "ideal": 0.154, "grazing": 0.904 - 0.751}[name]
    game = game_on_vehicle
    assert game.margin(name) == pytest.approx(known, abs=game.lattice.grid.cell)


def test_the_margin_of_the_sign_rule_is_half_of_a_sample_s_way(game_on_vehicle, game_on_circle):
    for game in (game_on_vehicle, game_on_circle):
        assert game.margin("sign") == pytest.approx(0.025, abs=game.lattice.grid.cell)


def test_the_margin_is_no_larger_than_what_was_prepared(game_on_circle):
    game = game_on_circle
    assert game.margin("hysteresis") == pytest.approx(0.3, abs=game.lattice.grid.cell)
    assert game.margin("hysteresis") <= 0.3


# ---- maps


def test_the_map_s_classes_are_those_of_the_starts(vehicle, game_on_vehicle):
    game = game_on_vehicle

    def classes(name, points):
        return game.map(name, 0.1)[game.lattice.grid.nearest(np.array(points))].tolist()

    # Far out, on the axis, within reach of the wrong mode, too late for any, and in the pillar.
    points = [[0.0, 0.8], [0.0, 0.0], [0.4, 0.15], [0.6, 0.0], [1.5, 0.0]]
    assert classes("sign", points) == [WON, BEATEN, WON, UNWINNABLE, OVER]
    assert classes("ideal", points) == [WON, WON, WON_FROM_SOME, UNWINNABLE, OVER]
    np.testing.assert_array_equal(game.map("sign", 0.1) == OVER, ~game.lattice.running)


@pytest.mark.slow
def test_where_samples_end_between_nodes_a_map_calls_lost_what_is_lost_on_the_plant(circle):
    """A slow policy goes half a cell in a sample: by rounding, the adversary of the game can hold it."""
    quick = circle_policy(circle)
    controllers = {
        "quick": PolicyController(quick),
        "slow": PolicyController(ChartPolicy(circle, lambda z: 0.45 * quick.act(z))),
    }
    game = Game(circle, halves(circle), controllers, 0.1, grid=Grid.with_cells(circle.chart, 150))
    assert not game.lattice.exact
    certificate = SimpleNamespace(game=game, answers={}, cells=None, controllers=controllers)
    lost = {}
    for name, loop in controllers.items():
        of_game = game.map(name, 0.1) == BEATEN
        lost[name] = examination._map(certificate, name, 0.1) == BEATEN
        starts = game.lattice.grid.nodes[of_game]
        run = closed_loop(circle, loop, starts, game.worst_noise(name, 0.1))
        np.testing.assert_array_equal(lost[name][of_game], run.outcome != Outcome.REACHED)
        assert not lost[name][~of_game].any()
    assert lost["quick"].any()
    assert (game.map("slow", 0.1) == BEATEN).sum() > lost["slow"].sum()


# ---- worst signals


def test_the_worst_signal_of_several_starts_is_that_of_each_alone(vehicle, game_on_vehicle):
    game = game_on_vehicle
    z0 = np.array([[0.0, 0.05], [0.3, -0.05], [0.4, 0.0]])
    together = worst_signal(game, "sign", z0, 0.1)
    for i in range(len(z0)):
        alone = worst_signal(game, "sign", z0[i : i + 1], 0.1)
        np.testing.assert_array_equal(together.values[: len(alone.values), i], alone.values[:, 0])
        assert not together.values[len(alone.values) :, i].any(), "none after the end"


def test_a_start_between_the_nodes_is_led_into_the_pillar_too(vehicle, game_on_vehicle):
    game = game_on_vehicle
    x = np.random.default_rng(0).uniform(0.0, 0.4, 50)
    z0 = np.stack([x, np.full_like(x, 0.025)], axis=-1)
    signal = worst_signal(game, "sign", z0, 0.1)
    assert np.abs(signal.values).max() <= 0.1 + 1e-12
    assert {arc.outcome for arc in simulate(vehicle, game.controllers["sign"], z0)} == {"reached"}
    arcs = simulate(vehicle, game.controllers["sign"], z0, noise=signal)
    assert {arc.outcome for arc in arcs} == {"crashed"}


def test_no_milder_noise_crashes_what_the_worst_does_not(vehicle, game_on_vehicle):
    """Rounding errors of the plant do not let a run escape, although the rule is torn on the axis."""
    game = game_on_vehicle
    x, y = np.meshgrid(np.arange(0, 0.31, 0.05), np.linspace(-0.0875, 0.0875, 8))
    z0 = np.stack([x.ravel(), y.ravel()], axis=-1)
    signals = [
        Noise("alternating", 0.1),
        Noise("adversarial", 0.1),
        worst_signal(game, "sign", z0, 0.1),
    ]
    *milder, worst = (
        [
            arc.outcome == "crashed"
            for arc in simulate(vehicle, game.controllers["sign"], z0, noise=s)
        ]
        for s in signals
    )
    assert not (np.any(milder, axis=0) & ~np.array(worst)).any()
    lost = game.value("sign", 0.1)[-1][game.lattice.grid.nearest(z0)] > NEVER
    np.testing.assert_array_equal(worst, lost)


def test_an_answer_is_settled_unless_it_changes_right_beside_the_node(game_on_vehicle):
    answers = game_on_vehicle.answers["sign"]
    y = game_on_vehicle.lattice.grid.spacing[1] * np.arange(
        -answers.pad[1], answers.settled.shape[2]
    )
    torn = np.unique(np.nonzero(~answers.settled)[2])
    # Where the sides part, and where the pillar is passed and it goes straight on.
    assert set(np.round(y[torn] - 1.5, 4)) == {-0.9, 0.0, 0.9}


# ---- the whole examination


CELLS = {"vehicle": 120, "unit_circle": EXACT}


@pytest.fixture(scope="module", params=CELLS)
def examined(request, game_on_vehicle, game_on_circle):
    game = {"vehicle": game_on_vehicle, "unit_circle": game_on_circle}[request.param]
    task, named = game.task, {"policy": game.controllers["sign"]}
    named["hyrl"] = [*game.controllers.values()][-1]
    cells = CELLS[request.param]
    result, maps = worst_case(
        task, decisions(task).points, halves(task), named, (0.05, 0.1), cells=cells
    )
    return task, named, result, maps


@pytest.mark.slow
def test_an_examination_holds_what_the_game_says(examined):
    task, named, result, maps = examined
    grid = Grid.with_cells(task.chart, CELLS[task.name])
    game = Game(task, halves(task), named, grid=grid)
    for name in (*named, LIMIT):
        for found, eps in zip(result.scores[name], (0.05, 0.1), strict=True):
            nodes = {key: getattr(found, key) for key in vars(game.score(name, eps))}
            assert nodes == vars(game.score(name, eps))
    for name in named:
        assert result.margin[name] == game.margin(name)
        # A function of the chart cannot be bounded: what is won is not proved.
        assert "cannot be bounded" in result.why_not_proved[name]
        expected = game.map(name, 0.1)
        expected[np.isin(expected, (WON, WON_FROM_SOME))] = UNCLEAR
        np.testing.assert_array_equal(maps.map[name], expected)
    assert tuple(maps.grid_counts) == grid.counts
    assert maps.eps == 0.1
    assert result.lattice.spacing == tuple(grid.spacing.tolist())


@pytest.mark.slow
def test_the_curve_starts_at_no_noise_and_only_falls_for_the_policy(examined):
    _, _, result, _ = examined
    curve = result.curve
    assert curve.eps[0] == 0
    for name in ("policy", "hyrl", LIMIT):
        assert len(curve.wins[name].won) == len(curve.eps) == len(curve.winnable)
        assert curve.wins[name].won[0] == 1.0
    assert curve.wins["policy"].won[-1] < 0.95
    assert curve.wins[LIMIT].won == (1.0,) * len(curve.eps)


@pytest.mark.slow
def test_the_profile_says_how_much_noise_each_point_of_the_critical_set_bears(examined):
    task, _, result, _ = examined
    profile, points = result.profile, decisions(task).points
    assert profile.points == tuple(map(tuple, points[task.may_start(points)].tolist()))
    for name in ("policy", "hyrl", LIMIT):
        assert len(profile.eps[name]) == len(profile.points)
    # The sign rule can be held on the very line by noise of one sample's way, and by no less.
    assert set(profile.eps["policy"]) <= {0.0375, 0.05}
    assert min(profile.eps["hyrl"]) >= 0.1
    assert set(profile.eps[LIMIT]) == {result.curve.eps[-1]}


@pytest.mark.slow
def test_an_examination_survives_being_written(examined, tmp_path):
    _, _, result, _ = examined
    robustness = Robustness(0.1, False, result, (), seed=0)
    robustness.save(tmp_path / "robustness.json")
    assert Robustness.load(tmp_path / "robustness.json") == robustness


# ---- files


def test_a_game_refuses_what_it_does_not_know(game_on_vehicle):
    game = game_on_vehicle
    with pytest.raises(BadInput, match="unknown controller 'mine'"):
        game.score("mine", 0.1)
    for eps in (-0.1, float("nan")):
        with pytest.raises(BadInput, match="finite number >= 0"):
            game.score("limit", eps)
