"""Stage 6: where a mode is trained, how its policies are judged, and when one is good enough."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from planted import (
    ChartPolicy,
    decisions,
    extended,
    flow_sets,
    halves,
    homing_policy,
    ideal_controller,
    one_way_policy,
    spare,
)

from hyrl_mj import Sensor, closed_loop
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.gym_export.core import cautious_reward
from hyrl_mj.judging.game import Game
from hyrl_mj.judging.results import ModeResult
from hyrl_mj.learning import ModeSettings, symmetry, training
from hyrl_mj.learning.presets import preset
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.policies.hybrid import HybridController
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import KINDS
from hyrl_mj.stages.extended_sets import extend
from hyrl_mj.stages.grounds import ByEpisodes, ByGame, Episodes, Judged, mode_ground
from hyrl_mj.stages.retraining import mirror_image, retrain, with_later_images

# ---- where modes are trained


@pytest.fixture(scope="module")
def vehicle_sets(vehicle):
    sets = flow_sets(ideal_controller(vehicle, 0.15), 60)
    return extended(sets, [part.grid.nodes[:, 0] < 0.4 for part in sets])


def test_mode_starts_cover_the_set_with_room_for_the_noise(vehicle, vehicle_sets):
    domain = mode_ground(vehicle, vehicle_sets, 0).domain(gamma=0.9)
    z = domain.starts(5000, np.random.default_rng(0))
    cell = vehicle_sets.sets[0].grid.cell
    assert vehicle.chart.contains(z).all()
    assert -0.25 - cell <= z[:, 1].min() <= -0.2
    assert z[:, 1].max() > 1.4
    assert z[:, 0].max() <= 0.4 + cell
    again = domain.starts(5000, np.random.default_rng(0))
    np.testing.assert_array_equal(z, again)


def test_a_mode_that_leaves_its_set_pays_for_ever(vehicle, circle, vehicle_sets):
    domain = mode_ground(vehicle, vehicle_sets, 1).domain(gamma=0.9)
    inside = domain.contains(np.array([[0.1, 0.22], [0.1, 0.28], [0.1, -1.0]]))
    np.testing.assert_array_equal(inside, [True, False, True])
    assert domain.exit_reward == 0.0
    grid = Grid.with_cells(circle.chart, 60)
    sets = extended([GridSet.from_mask(grid, np.ones(60, dtype=bool))])
    assert mode_ground(circle, sets, 0).domain(gamma=0.9).exit_reward == pytest.approx(-10.0)


# ---- the way beyond the mode's part


def circle_sets(circle, eps, cells=720):
    """The parts of the circle, and the sets of stage 5 for noise eps."""
    parts, points = halves(circle, cells), decisions(circle).points
    return parts, extend(circle, homing_policy(circle), points, parts, eps)


def discounted(circle, domain, start, u, gamma=0.95):
    """The discounted return of an episode from a start [rad] with a constant input."""
    env = BatchedEnv(circle, 1, domain=domain)
    env.reset(z=np.array([[start]]))
    total, weight = 0.0, 1.0
    for _ in range(circle.max_steps):
        result = env.step(np.array([[u]]))
        total += weight * result.reward[0]
        weight *= gamma
        if result.done[0]:
            break
    return total


@pytest.mark.slow
@pytest.mark.parametrize("eps", [0.05, 0.29])
def test_it_pays_to_go_back_from_the_farthest_edge(circle, eps):
    parts, sets = circle_sets(circle, eps)
    domain = mode_ground(circle, sets, 0, parts).domain(gamma=0.95)
    edge = sets.sets[0].pieces()[0][1] + eps - 0.06  # a little inside
    assert domain.contains(np.array([[edge]])).all()
    assert edge > np.pi + 3 * eps - 0.06
    back, stay = (discounted(circle, domain, edge, u) for u in (-1.0, 0.0))
    assert back > stay + 0.5


@pytest.mark.slow
def test_only_in_its_part_does_a_mode_earn_the_reward_of_the_task(circle):
    parts, sets = circle_sets(circle, 0.25)
    here, beyond, common = np.pi - 1.0, np.pi + 0.5, 0.1
    for mode, sign in ((0, 1.0), (1, -1.0)):
        domain = mode_ground(circle, sets, mode, parts).domain(gamma=0.95)
        z = np.array([[np.pi + sign * (x - np.pi)] for x in (here, beyond, common)])
        env = BatchedEnv(circle, 3, domain=domain)
        env.reset(z=z)
        still = np.zeros((3, 1))
        expected = cautious_reward(circle, z, still, domain.caution)
        expected[1] = circle.worst_reward
        np.testing.assert_allclose(env.step(still).reward, expected, atol=1e-6)
        assert expected[2] > expected[0] > expected[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "eps", [*(pytest.param(eps, marks=pytest.mark.long) for eps in (0.05, 0.15)), 0.25]
)
def test_the_modes_of_the_circle_settle_as_early_as_can_be_at_any_noise(circle, eps):
    # No controller settles within 0.3 rad of the set-point under greater noise than that.
    parts, sets = circle_sets(circle, eps, cells=1440)
    settings = preset(circle, "fast", eps=eps).stage6
    first, result = retrain(mode_ground(circle, sets, 0, parts), settings, seed=1)
    second, _ = retrain(
        mode_ground(circle, sets, 1, parts), settings, seed=1, others=[(first, result)]
    )
    flow_sets = dict(zip(sets.modes, sets.sets, strict=True))
    controller = HybridController(circle, {0: first, 1: second}, flow_sets)
    game = Game(circle, parts, {"hyrl": controller}, eps, grid=parts.grid)
    ours, limit = game.score("hyrl", eps), game.score("limit", eps)
    assert result.won == ours.won == ours.won_any == 1.0
    assert ours.time <= 1.05 * limit.time + 0.1
    assert ours.time_any <= 1.05 * limit.time_any + 0.1


# ---- the judge of stage 6


def lost_by(ground):
    """The nodes from which the latest policy lost that a ground has judged."""
    return ground._latest[1].lost


def test_a_cautious_reward_is_the_least_around(vehicle):
    rng = np.random.default_rng(0)
    measured = rng.uniform([0.1, -1.3], [2.9, 1.3], (200, 2))
    u = rng.uniform(-1.0, 1.0, (200, 1))
    worst = cautious_reward(vehicle, measured, u, np.array([0.0, 0.1]))
    for shift in (-0.1, -0.05, 0.0, 0.05, 0.1):
        state = measured + np.array([0.0, shift])
        crashed = vehicle.clearance(state) <= 1e-3
        assert (worst <= np.where(crashed, 0.0, vehicle.reward(state, u)) + 1e-12).all()
    np.testing.assert_array_equal(
        cautious_reward(vehicle, measured, u, np.zeros(2)),
        np.where(vehicle.clearance(measured) <= 1e-3, 0.0, vehicle.reward(measured, u)),
    )
    # Within the noise of the pillar there is nothing to earn.
    close = np.array([[1.5, 0.84]])
    assert cautious_reward(vehicle, close, u[:1], np.array([0.0, 0.1]))[0] == 0.0


@pytest.fixture(scope="module")
def left(vehicle):
    """The ground of the vehicle's mode 0 with ideal sets, where they can be won."""
    sets = flow_sets(ideal_controller(vehicle, 0.15), 120)
    x, y = sets[0].grid.nodes.T
    open_ = y > -(0.4 - x)
    return mode_ground(vehicle, extended(sets, [open_, ~open_]), 0)


def test_the_judge_prefers_a_policy_that_loses_nothing(vehicle, left):
    wide = left(one_way_policy(vehicle, 1.0, clear=1.0))
    assert wide[0] == 0.0
    assert not len(lost_by(left))
    grazing = left(one_way_policy(vehicle, 1.0, clear=0.8))
    wrong = left(one_way_policy(vehicle, -1.0))
    assert wrong < grazing < wide
    assert len(lost_by(left))


@pytest.mark.slow
def test_where_runs_end_is_judged_as_they_are_simulated(vehicle, left):
    wide = one_way_policy(vehicle, 1.0, clear=1.01)
    # Runs from between two samples' ways end half a sample behind the set-point.
    late = one_way_policy(vehicle, 1.0, clear=1.11)
    swerving = ChartPolicy(vehicle, lambda z: np.where(z[:, :1] > 2.96, late.rule(z), wide.rule(z)))
    for policy in (wide, one_way_policy(vehicle, 1.0, clear=1.06), swerving):
        starts = left.grid.nodes[left.early]
        ends = closed_loop(vehicle, PolicyController(policy), starts).path[-1]
        miss = -left(policy)[1] * vehicle.precision
        assert miss == pytest.approx(vehicle.miss(ends).max(), abs=1e-6)


def test_a_policy_that_ends_far_off_is_not_good_enough(vehicle, left):
    # It passes the pillar and then goes straight on, a metre off the set-point.
    score = left(one_way_policy(vehicle, 1.0, clear=1.0))
    assert score < left.enough
    assert -score[1] * vehicle.precision >= 1.0


@pytest.mark.parametrize(
    ("wide", "few", "suffices"), [(0.02, 0.05, True), (0.08, 0.05, False), (0.02, 1e-4, False)]
)
def test_a_few_states_at_which_the_mode_is_never_selected_may_be_lost(
    vehicle, left, monkeypatch, wide, few, suffices
):
    """About x = 0.2 m it goes the wrong way; y >= -0.1 m are selected."""
    monkeypatch.setattr(left, "settings", ModeSettings(few=few))
    right = one_way_policy(vehicle, 1.0, clear=1.0)

    def rule(z):
        return np.where(np.abs(z[:, :1] - 0.2) < wide, -1.0, right.rule(z))

    policy = ChartPolicy(vehicle, rule)
    assert left(policy) < left.enough
    assert (left.grid.nodes[lost_by(left), 1].max() < -0.1) == (wide == 0.02)
    assert 1e-4 < len(lost_by(left)) / len(left.nodes) < 0.05
    assert left.suffices(policy) == suffices


def test_training_goes_on_where_the_game_is_lost(vehicle, left):
    left(one_way_policy(vehicle, 1.0, clear=0.8))
    rng = np.random.default_rng(0)
    z = left.starts(4000, rng)
    lost = np.isin(left.grid.nearest(z), lost_by(left))
    left(one_way_policy(vehicle, 1.0, clear=1.0))
    elsewhere = np.isin(left.grid.nearest(left.starts(4000, rng)), left.nodes)
    assert lost.mean() > 0.15
    assert elsewhere.all()


# ---- the mirror image of another mode's policy


# A policy that wins half of its own mode.
HALF = ModeResult(0, 0.5, 1)


@pytest.fixture
def quick(vehicle):
    return replace(preset(vehicle, "smoke").stage6, samples=4_096)


def untrained(vehicle, quick):
    return training.export(training.build(vehicle, quick, seed=0), vehicle)


@pytest.mark.slow
def test_a_mirror_image_that_will_do_is_taken(vehicle, vehicle_sets, quick, monkeypatch):
    other = untrained(vehicle, quick)
    image = symmetry.mirrored(other)
    monkeypatch.setattr(ByGame, "judge", lambda *_, **__: Judged((0.0, -0.5), True))
    found, _ = retrain(mode_ground(vehicle, vehicle_sets, 1), quick, seed=0, others=[(other, HALF)])
    for name, weight in image.weights.items():
        np.testing.assert_array_equal(found.weights[name], weight)


def test_a_mode_trained_in_vain_takes_the_image_of_a_later_one(
    vehicle, vehicle_sets, quick, monkeypatch
):
    vain, good = (
        untrained(vehicle, quick),
        training.export(training.build(vehicle, quick, 1), vehicle),
    )
    monkeypatch.setattr(
        ByGame, "judge", lambda ground, policy, twin=None: Judged((0.0, -0.5), policy is not vain)
    )
    grounds = partial(mode_ground, vehicle, vehicle_sets)
    spent, saved = ModeResult(0, 0.5, quick.attempts), ModeResult(0, 0.5, quick.attempts - 1)
    last = good, ModeResult(1, 1.0, 1)
    (found, result), kept = with_later_images([(vain, spent), last], grounds, quick)
    for name, weight in symmetry.mirrored(good).weights.items():
        np.testing.assert_array_equal(found.weights[name], weight)
    assert (result.mode, result.attempts) == (0, 0)
    assert kept == last
    assert with_later_images([(vain, saved), last], grounds, quick) == [(vain, saved), last]
    assert with_later_images([last, (vain, spent)], grounds, quick)[1] == (vain, spent)


def test_one_that_will_not_do_is_not_taken(vehicle, vehicle_sets, quick):
    other = untrained(vehicle, quick)  # it drives into the pillar
    ground = mode_ground(vehicle, vehicle_sets, 1)
    assert ground(symmetry.mirrored(other)) < (0.0, -1.0)
    assert mirror_image(ground, [(other, HALF)]) is None


# ---- where the worst case cannot be played


# Batches of a few episodes.
FEW = (4, 4, 8, 16)


def by_episodes(puck, sets, mode, policy=None, **changes):
    """The ground of a mode, with few episodes."""
    ground = mode_ground(
        puck, sets, mode, policy=policy, settings=ModeSettings(**{"batches": FEW, **changes})
    )
    assert isinstance(ground, ByEpisodes)
    return ground


@pytest.fixture(scope="module")
def puck_sets(puck):
    grid = Grid.with_cells(puck.chart, 60)
    offsets = [s * grid.nodes[:, 1] for s in (1.0, -1.0)]
    return extended([GridSet(grid, -y - 0.25) for y in offsets], [y > -0.4 for y in offsets])


def round_it(puck, side, clear=0.9):
    """Past the pillar on one side, and back to the middle behind it."""
    past = one_way_policy(puck, side, clear)
    back = ChartPolicy(puck, lambda z: np.clip(-3 * z[:, 1:], -1, 1))
    return ChartPolicy(puck, lambda z: np.where(z[:, :1] < 1.8, past.rule(z), back.rule(z)))


@pytest.mark.slow
def test_episodes_tell_policies_apart_and_their_share_is_that_of_the_score(
    puck, puck_sets, monkeypatch
):
    ground = by_episodes(puck, puck_sets, 0, batches=(8, 8))
    away = ground(never := one_way_policy(puck, 1.0))
    assert away[0] == len(ground.plays) + 2, "it never comes back to the set-point, and ends well"
    assert away[1] < -1
    assert ground.suffices(never)
    monkeypatch.setattr(puck, "precision", ground.allowed)
    assert not by_episodes(puck, puck_sets, 0, batches=(8, 8)).suffices(never)
    monkeypatch.undo()
    # As close as it gets without noise, but not with it.
    grazing = ground(close := round_it(puck, 1.0, clear=0.6))
    assert 0.0 < ground.won(close) < 1.0
    good = ground(wide := round_it(puck, 1.0))
    assert ground.won(wide) == 1.0
    assert grazing < away < ground.enough <= good
    assert grazing[0] == 3, "chance does not find it, the adversary does"


@pytest.mark.slow
def test_a_policy_that_just_survives_the_noise_is_attacked_and_not_good_enough(puck, puck_sets):
    """Under somewhat more noise than the bound, 64 episodes of each kind find nothing, but an attack does."""
    narrowly, batches = round_it(puck, 1.0, clear=0.66), (64,)
    ground = by_episodes(puck, puck_sets, 0, batches=batches)
    assert ground(narrowly) == (len(ground.plays) + 1, -1 / 64), "one start of 64 is lost"
    assert not ground.suffices(narrowly)
    assert len(lost_by(ground)) == 1
    assert ground.won(narrowly) == 1 - 1 / 64
    assert by_episodes(puck, puck_sets, 0, batches=batches, margin=1.0).suffices(narrowly)


def test_the_judge_s_noise_never_hides_the_chart(puck, puck_sets):
    share = puck.noise_in_chart(1.0)[1]
    limit = puck.chart.sides[1] / (2 * share)
    for noise in (0.1, 0.95 * limit):
        ground = by_episodes(puck, replace(puck_sets, eps=noise), 0)
        assert noise < puck.check_noise(ground.noise.bound) <= 1.2 * noise + 1e-12


@pytest.mark.long
@pytest.mark.slow
def test_a_policy_that_parks_off_the_goal_is_not_good_enough(puck, puck_sets):
    precise = round_it(puck, 1.0)
    ground = by_episodes(puck, puck_sets, 0, policy=precise)
    # It goes the same way, and then to a place beside the set-point that counts as arrived.
    off = ground.allowed + 0.05
    assert off < puck.close
    parking = ChartPolicy(
        puck,
        lambda z: np.where(z[:, :1] < 1.8, precise.rule(z), np.clip(3 * (off - z[:, 1:]), -1, 1)),
    )
    assert by_episodes(puck, puck_sets, 0)(parking) >= ground.enough
    score = ground(parking)
    assert ground.won(parking) == 1.0
    assert score < ground.enough <= ground(precise)
    assert ground.won(precise) == 1.0
    assert -score[1] * ground.allowed == pytest.approx(off, abs=0.06)


@pytest.mark.slow
def test_a_task_may_say_how_far_off_is_good_enough(puck, puck_sets, monkeypatch):
    precise = round_it(puck, 1.0)
    usual = by_episodes(puck, puck_sets, 0, policy=precise).allowed
    for precision, expected in ((3 * usual, 3 * usual), (1e-3, usual)):
        monkeypatch.setattr(puck, "precision", precision)
        allowed = by_episodes(puck, puck_sets, 0, policy=precise).allowed
        assert allowed <= expected + 1e-12
        assert (allowed > usual) == (precision > usual)
    assert allowed > 1e-3, "as far off as the stage-1 policy is allowed in any case"


@pytest.mark.slow
def test_they_start_where_the_mode_may_be_picked(puck, puck_sets):
    for mode, side in ((0, 1.0), (1, -1.0)):
        ground = by_episodes(puck, puck_sets, mode)
        cell = ground.grid.cell
        y = side * ground.begins[:, 1]
        assert -0.1 - 2 * cell <= y.min() < 0.0
        assert y.max() > 0.6
        grid, starts = ground.grid, ground.begins
        assert puck.may_start(grid.nodes[grid.nearest(starts)]).all()


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "noise"),
    [("uniform 0.02 + delay 1", "sensor"), ("uniform 0.02 + bias 0.02", "uniform")],
)
def test_modes_are_trained_and_judged_under_what_the_sensor_does(
    puck, puck_sets, text, noise, monkeypatch
):
    spare(monkeypatch, checkpoints=2)
    bound, shares = Sensor.parse(text).on(puck)
    task = puck.with_sensor(text, shares)
    sets = replace(puck_sets, eps=bound)
    ground = by_episodes(task, sets, 0, batches=(8,))
    assert ground.noise.kind == noise
    assert {kind for _, kind in ground.plays} == {*KINDS, "sensor"}
    settings = replace(preset(task, "smoke").stage6, samples=2_048, attempts=1)
    policy, result = retrain(ground, settings, seed=0)
    assert result.attempts == 1
    assert ground(policy) < ground.enough, "so little training does not suffice"


@pytest.mark.slow
@pytest.mark.parametrize(("won", "plays", "attacks"), [(0.5, 16, 1), (1.0, 12, 0)])
def test_the_image_of_a_policy_that_wins_all_is_judged_by_fewer_episodes(
    puck, puck_sets, monkeypatch, won, plays, attacks
):
    ground, played = by_episodes(puck, puck_sets, 1), []

    def play(ground, policy, batch, kind):
        played.append((batch, kind))
        return np.ones(FEW[batch], dtype=bool), np.zeros(FEW[batch])

    def lost(ground, policy):
        played.append("attack")
        return np.zeros(len(ground.attacked), dtype=bool)

    monkeypatch.setattr(Episodes, "play", play)
    monkeypatch.setattr(ByEpisodes, "lost_under_attack", lost)
    assert ground.won_by_image(object(), won) == 1.0
    assert played == [*ground.plays[:plays], *["attack"] * attacks]


@pytest.mark.slow
def test_an_episode_that_no_policy_wins_hides_no_others(puck, puck_sets, monkeypatch):
    """One of 32 is lost by all; two policies lose others, too, one of them more than a few."""
    ground = by_episodes(puck, puck_sets, 1, batches=(32, 32), may_break=0.05)
    others = {"best": (), "worse": (2,), "bad": (2, 3)}

    def play(ground, policy, batch, kind):
        won = np.ones(32, dtype=bool)
        won[0] = False
        won[[*others[policy]]] &= kind == "none" and batch == 0
        return won, np.zeros(32)

    monkeypatch.setattr(Episodes, "play", play)
    best, worse, bad = map(ground, others)
    assert ground.enough > best > worse > bad
    assert best == (len(ground.plays), -1 / 32)
    assert bad == (1, pytest.approx(-2 / 32))
    assert not ground.suffices("best")
    assert len(ground.judged("best").lost) == len(ground.plays)
    assert ground.won("best") == 31 / 32


@pytest.mark.slow
def test_an_image_that_loses_is_not_taken(puck, puck_sets):
    ground = by_episodes(puck, puck_sets, 0, batches=(8,))
    assert ground.won_by_image(round_it(puck, 1.0), 1.0) == 1.0
    assert ground.won_by_image(round_it(puck, 1.0, clear=0.6), 1.0) is None


@pytest.mark.slow
def test_they_start_where_all_nodes_around_can_be_won(puck, puck_sets):
    winning = (
        puck_sets.winning[0] & (puck_sets.sets[0].grid.nodes[:, 0] < 0.7),
        puck_sets.winning[1],
    )
    ground = by_episodes(puck, replace(puck_sets, winning=winning), 0)
    nodes, spacing = ground.grid.nodes, ground.grid.spacing
    assert len(ground.begins) == sum(FEW)
    for z in ground.begins:
        around = (np.abs(nodes - z) < spacing - 1e-9).all(axis=1)
        assert around.any()
        assert ground.wanted[around].all()
