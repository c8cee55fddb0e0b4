"""The search for noise signals finds those that are planted, and reports only what is lost again."""

import math
from dataclasses import dataclass, field, replace
from itertools import cycle

import numpy as np
import pytest
from planted import (
    ChartPolicy,
    circle_controller,
    circle_policy,
    decisions,
    halves,
    ideal_controller,
    one_way_policy,
    sign_policy,
)

from hyrl_mj import BadInput, Noise, Outcome, Recorded, Sample, simulate, simulate_batch
from hyrl_mj.judging.attack_search import Search, Waves
from hyrl_mj.judging.attacks import Budget, attack, attack_starts
from hyrl_mj.judging.episodes import Regions
from hyrl_mj.judging.examination import ExamineOptions
from hyrl_mj.judging.game import NEVER
from hyrl_mj.learning.presets import preset
from hyrl_mj.policies import PolicyController
from hyrl_mj.policies.hybrid import HybridController
from hyrl_mj.runs.directory import Run
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import GIVEN, Programmes, Rules, closed_loop
from hyrl_mj.stages.partition import PartPolicy
from hyrl_mj.system import cores
from hyrl_mj.tasks import Effort

EPS = 0.1
ON_THE_LEFT = np.array([[0.0, 1.0], [0.05, 1.0], [0.1, 1.0], [0.0, 1.02]])


@dataclass(frozen=True)
class Lock:
    """A controller of the vehicle that only one order of noise opens, from a start at y = 1.

    After a measurement below 0.95 at x = 0.2 to 0.4, one above 1.05 at x = 0.5 to 0.7 opens it, and another
    one from x = 0.8 on closes it again. If it is open, it leaves the arena after a measurement below 0.95 at
    x = 1.6 to 1.8.
    """

    modes = (0, 1, 2, 3)

    def initial_mode(self, measured):
        return np.zeros(len(measured), dtype=int)

    def step(self, q, measured):
        x, y = measured.T
        high, low = y > 1.05, y < 0.95
        following = np.where((q == 0) & (x > 0.19) & (x < 0.41) & low, 3, q)
        following = np.where((q == 3) & (x > 0.49) & (x < 0.71) & high, 1, following)
        following = np.where((q == 1) & (x > 0.79) & high, 0, following)
        following = np.where((q == 1) & (x > 1.59) & (x < 1.81) & low, 2, following)
        return np.where(following == 2, 1.0, 0.0)[:, None], following


def on(task, controller, starts, rounds=2, **options):
    return attack(task, {"it": controller}, starts, EPS, Budget(rounds=rounds), **options)["it"]


# ---- what is found


def test_all_that_the_game_loses_is_lost_and_nothing_that_is_won_by_far(vehicle, game_on_vehicle):
    game, sign = game_on_vehicle, game_on_vehicle.controllers["sign"]
    nodes = game.lattice.grid.nodes[game.starts]
    lost = game.value("sign", EPS)[-1, :-2][game.starts] >= NEVER
    rng = np.random.default_rng(0)
    picked = np.concatenate([rng.permutation(np.flatnonzero(side))[:12] for side in (lost, ~lost)])
    found = on(vehicle, sign, nodes[picked])
    broken = np.array([arc.outcome != "reached" for arc in found.arcs])
    np.testing.assert_array_equal(broken, lost[picked])
    assert found.count.unaided + found.count.lost == lost[picked].sum() == 12


def test_a_run_that_only_stalls_is_lost(circle):
    starts = np.array([[np.pi], [np.pi - 0.05], [1.0]])
    found = on(circle, PolicyController(circle_policy(circle)), starts, rounds=1)
    assert [arc.outcome for arc in found.arcs] == ["stalled", "stalled", "reached"]
    assert found.strongest in (0, 1)


@pytest.mark.slow
def test_an_order_of_noise_is_found_that_no_rule_gives_alone(vehicle):
    held = on(vehicle, Lock(), ON_THE_LEFT, rounds=2)
    assert held.count.lost == 0
    found = on(vehicle, Lock(), ON_THE_LEFT, rounds=40)
    assert found.count.lost == len(ON_THE_LEFT)
    assert {arc.outcome for arc in found.arcs} == {"out_of_bounds"}
    assert found.arcs[found.strongest].t[-1] == min(arc.t[-1] for arc in found.arcs)


def kept_parts(vehicle, agent):
    """Policies of two modes that are both the agent itself."""
    halved = halves(vehicle)
    parts = zip(halved.modes, halved.parts, strict=True)
    return {q: PartPolicy(vehicle, agent, part, 0.1, whole=True) for q, part in parts}


@pytest.mark.slow
def test_signals_against_an_agent_do_the_same_to_modes_that_all_keep_it(vehicle):
    agent = sign_policy(vehicle)
    flow_sets = dict(zip((0, 1), halves(vehicle).parts, strict=True))
    hybrid = HybridController(vehicle, kept_parts(vehicle, agent), flow_sets)
    starts = np.random.default_rng(0).uniform((0.0, -0.6), (0.3, 0.6), (15, 2))
    found = on(vehicle, PolicyController(agent), starts)
    assert 0 < found.count.lost < len(starts)
    passed_on = found.on("hyrl", vehicle, hybrid)
    assert passed_on.count == replace(found.count, controller="hyrl")
    assert passed_on.count.lost == on(vehicle, hybrid, starts).count.lost
    for one, two in zip(found.arcs, passed_on.arcs, strict=True):
        flowing = np.append(True, np.diff(two.j) == 0)  # a jump repeats the state
        np.testing.assert_array_equal(one.z, two.z[flowing])
    # Modes that go their own ways are tried under the same signals, and lose fewer.
    ideal = found.on("hyrl", vehicle, ideal_controller(vehicle))
    assert ideal.count.lost < found.count.lost


def test_a_run_keeps_its_agent_if_each_mode_is_the_agent_everywhere(vehicle, tmp_path):
    agent = sign_policy(vehicle)
    kept = kept_parts(vehicle, agent)
    own = {**kept, 1: replace(kept[1], whole=False)}
    other = {**kept, 1: replace(kept[1], policy=one_way_policy(vehicle))}
    for policies, keeps in ((kept, True), (own, False), (other, False)):
        run = Run(tmp_path, preset(vehicle))
        vars(run).update(policy=agent, mode_policies=policies)
        assert run.keeps_agent == keeps


@pytest.mark.slow
def test_what_cannot_be_beaten_is_not(vehicle, circle):
    starts = np.random.default_rng(0).uniform((0.0, -0.1), (0.2, 0.1), (20, 2))
    left = on(vehicle, PolicyController(one_way_policy(vehicle, clear=1.004)), starts, rounds=1)
    assert left.count.lost == 0
    assert left.count.interval[0] == 0
    assert 0.1 < left.count.interval[1] < 0.2  # of 20 starts
    assert {arc.outcome for arc in left.arcs} == {"reached"}
    around = on(circle, circle_controller(circle), np.array([[np.pi], [3.3]]), rounds=1)
    assert around.count.lost == 0


def test_where_nothing_is_lost_the_greatest_danger_is_the_strongest(vehicle):
    starts = np.array([[0.0, 0.5], [0.3, 0.0], [0.0, 0.9]])
    found = on(vehicle, PolicyController(one_way_policy(vehicle, clear=1.004)), starts)
    clearance = [vehicle.clearance(arc.z).min() for arc in found.arcs]
    assert found.strongest == np.argmin(clearance)
    assert found.count.start == tuple(starts[found.strongest])


def test_the_strongest_signals_make_a_run_lose_alone_too(vehicle):
    starts = np.array([[0.0, 0.03], [0.3, 0.0], [0.0, 0.9]])
    loop = PolicyController(sign_policy(vehicle))
    for start, arc in zip(starts, on(vehicle, loop, starts).arcs, strict=True):
        noise = arc.measured[:-1] - arc.z[:-1]
        assert (arc.noise, arc.bound) == ("attack", EPS)
        assert np.abs(noise).max() <= EPS + 1e-12
        assert not noise[:, 0].any()  # the vehicle's noise acts on y
        again = simulate(vehicle, loop, start, Recorded(noise[:, None], EPS))
        assert again.outcome == arc.outcome
        np.testing.assert_allclose(again.z, arc.z, atol=1e-9)


def test_the_hybrid_controller_may_be_attacked_in_its_choice_of_a_mode(vehicle):
    """With an overlap narrower than the noise, some signal keeps the mode changing."""
    starts = np.array([[0.1, 0.0], [0.2, 0.01]])
    narrow = on(vehicle, ideal_controller(vehicle, overlap=0.02, clear=1.004), starts)
    wide = on(vehicle, ideal_controller(vehicle, overlap=0.154, clear=1.004), starts, rounds=4)
    assert (narrow.count.lost, wide.count.lost) == (2, 0)


# ---- budgets


@pytest.mark.slow
def test_the_same_rounds_give_the_same_on_any_number_of_threads(vehicle, monkeypatch):
    monkeypatch.setattr(cores, "allowed", 1)
    first = on(vehicle, Lock(), ON_THE_LEFT, rounds=4, seed=3)
    monkeypatch.setattr(cores, "allowed", 2)
    second = on(vehicle, Lock(), ON_THE_LEFT, rounds=4, seed=3)
    assert first.count == second.count
    for one, two in zip(first.arcs, second.arcs, strict=True):
        np.testing.assert_array_equal(one.measured, two.measured)


@pytest.mark.slow
def test_seconds_only_decide_how_many_rounds_are_done(vehicle):
    loop = {"it": Lock()}
    timed = attack(vehicle, loop, ON_THE_LEFT, EPS, Budget(seconds=0.3))["it"]
    counted = attack(vehicle, loop, ON_THE_LEFT, EPS, Budget(rounds=timed.count.rounds))["it"]
    assert (timed.count.seconds, counted.count.seconds) == (0.3, None)
    assert timed.count.lost == counted.count.lost
    for one, two in zip(timed.arcs, counted.arcs, strict=True):
        np.testing.assert_array_equal(one.measured, two.measured)


def test_the_seed_decides_what_is_tried(vehicle):
    tried = []
    for seed in (0, 0, 1):
        search = Search(vehicle, Lock(), ON_THE_LEFT, EPS, np.array([0.0, 1.0]), seed=seed)
        search.prepare(search.length)
        search._try = lambda rows, programmes: tried.append(programmes)
        held = math.ceil(len(search.rules.common) / search.settings.population)
        search.round(held + 1)  # the first that draws
    np.testing.assert_array_equal(tried[0], tried[1])
    assert not np.array_equal(tried[0], tried[2])


def test_no_round_is_done_once_all_is_lost(vehicle):
    loop = PolicyController(sign_policy(vehicle))
    assert on(vehicle, loop, np.array([[0.3, 0.0]]), rounds=50).count.rounds == 1


def test_no_round_follows_one_by_which_enough_is_lost(vehicle):
    loop, starts = PolicyController(sign_policy(vehicle)), np.array([[0.3, 0.0], [0.0, 0.9]])
    for enough, rounds in ((None, 3), (1, 1)):
        budget = Budget(rounds=3, enough=enough)
        count = attack(vehicle, {"it": loop}, starts, EPS, budget)["it"].count
        assert (count.lost, count.rounds) == (1, rounds)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"attack_seconds": 0.0},
            "attack_seconds 0.0 cannot be used: give a number > 0 and <= 86400",
        ),
        ({"attack_seconds": float("nan")}, "attack_seconds nan"),
        ({"attack_rounds": 0}, "attack_rounds 0 cannot be used: give an integer from 1 to 100,000"),
        ({"attack_starts": 10**9}, "attack_starts 1000000000"),
        ({"episodes": 0}, "episodes 0 cannot be used: give an integer from 1 to 1,000,000,000"),
        ({"episodes": 10**30}, "1,000,000,000"),
        ({"attack_rounds": 1, "attack_seconds": 1.0}, "give one of the two"),
    ],
)
def test_an_impossible_examination_is_refused(options, message):
    with pytest.raises(BadInput, match=message):
        ExamineOptions(**options).budget(Effort(), exact=True)


def test_starts_and_bounds_that_make_no_sense_are_refused(vehicle):
    with pytest.raises(BadInput, match="hides the whole state space"):
        attack(vehicle, {"it": Lock()}, ON_THE_LEFT, 9.0, Budget(rounds=1))
    with pytest.raises(BadInput, match="outside"):
        on(vehicle, Lock(), np.array([[9.0, 0.0]]), rounds=1)


# ---- starts and rules


def test_half_of_the_starts_lie_near_the_critical_set(vehicle):
    points = decisions(vehicle).points
    starts = attack_starts(vehicle, Regions(points), EPS, 100, seed=0)
    near = np.abs(starts[:, 1]) <= 2 * EPS + 1e-9
    assert near[:50].all()
    assert 2 < near[50:].sum() < 25
    assert vehicle.may_start(starts).all()
    np.testing.assert_array_equal(starts, attack_starts(vehicle, Regions(points), EPS, 100, seed=0))
    assert len(attack_starts(vehicle, Regions(np.empty((0, 2))), EPS, 100, seed=0)) == 100
    near = attack_starts(vehicle, Regions(points, near=True), EPS, 100, seed=0)
    assert Regions(points).split(vehicle, EPS, near)["near M*"].all()
    with pytest.raises(BadInput, match="the critical set is empty"):
        attack_starts(vehicle, Regions(np.empty((0, 2)), near=True), EPS, 100, seed=0)


def test_only_starts_are_attacked_all_of_whose_nodes_are_winnable(vehicle):
    grid = Grid.with_cells(vehicle.chart, 60)
    above = grid.nodes[:, 1] > 0.1 + 1e-9  # the lowest of these nodes lie at 0.15
    regions = Regions(np.array([[0.0, 0.0]]), (grid, above))
    starts = attack_starts(vehicle, regions, EPS, 100, seed=0)
    assert starts[:, 1].min() >= 0.15 - 1e-9
    assert starts[:, 1].min() < 0.2
    assert (np.linalg.norm(starts[:50], axis=1) <= 2 * EPS).all()
    parts = regions.split(vehicle, EPS, np.array([[0.0, 0.149], [0.0, 0.151], [0.0, 0.8]]))
    assert parts["not winnable"].tolist() == [True, False, False]
    assert parts["near M*"].tolist() == [False, True, False]


def test_where_hardly_a_start_is_winnable_fewer_are_attacked(vehicle):
    grid = Grid.with_cells(vehicle.chart, 60)
    far = Regions(np.array([[0.0, 0.0]]), (grid, grid.nodes[:, 1] > 0.6))
    starts = attack_starts(vehicle, far, EPS, 100, seed=0)
    assert len(starts) == 100
    assert starts[:, 1].min() > 0.6, "none near M*, where nothing is winnable"
    none = Regions(np.array([[0.0, 0.0]]), (grid, np.zeros(len(grid.nodes), dtype=bool)))
    assert len(attack_starts(vehicle, none, EPS, 100, seed=0)) == 100


def test_the_first_rounds_hold_every_rule(vehicle):
    for loop in (PolicyController(sign_policy(vehicle)), ideal_controller(vehicle)):
        starts = np.array([[0.0, 0.5]])
        search = Search(vehicle, loop, starts, EPS, np.array([0.0, 1.0]), seed=0)
        search.prepare(search.length)
        held = []
        search._try = lambda rows, programmes, held=held: held.append(programmes[0])
        rounds = math.ceil(len(search.rules.common) / search.settings.population)
        for number in range(1, rounds + 1):
            search.round(number)
        constant = {int(row[0]) for row in np.concatenate(held) if (row == row[0]).all()}
        assert {*search.rules.common, *search.rules.own} <= constant
        first = {int(row[0]) for row in held[0]}
        assert {*search.rules.own} <= first, "the rules about modes come on top"
        assert {*search.rules.common[: search.settings.population]} <= first
        assert rounds < Effort().attack_rounds, "some rounds are left to search"


@pytest.mark.parametrize(
    ("shares", "candidates", "ends"),
    [((0.0, 1.0), 9, 1), ((1.0, 0.5), 25, 4), ((1.0,) * 5, 13, 6)],
)
def test_rules_stay_within_the_bound_of_each_column(vehicle, shares, candidates, ends):
    rules, limits = Rules(vehicle, Lock(), EPS, np.array(shares)), EPS * np.array(shares) + 1e-15
    assert rules.candidates.shape == (candidates, len(shares))
    assert not rules.candidates[0].any()
    assert (np.abs(rules.candidates) <= limits).all()
    assert (np.abs(rules.noise) <= limits).all()
    kinds = [rule.kind for rule in rules.all]
    # Each end with both signs, once with an alternating one, and on some columns alone.
    assert kinds.count("constant") == kinds.count("turn") == 2 * ends
    assert kinds.count("alternating") == ends
    assert kinds.count("flip") == 16
    assert rules.all[rules.nothing].kind == "none"
    assert not rules.noise[rules.nothing].any()
    assert np.isin(rules.own, rules.common).sum() == 0


def test_rules_are_held_for_their_segments(vehicle):
    loop = PolicyController(one_way_policy(vehicle))
    rules = Rules(vehicle, loop, EPS, np.array([0.0, 1.0]))
    kinds = [rule.kind for rule in rules.all]
    plus = kinds.index("constant")
    period = next(i for i, rule in enumerate(rules.all) if rule.period == 5)
    flip = kinds.index("flip")
    programmes = np.array([[plus, plus + 1, kinds.index("alternating")], [period] * 3, [flip] * 3])
    given = np.full((4, 3, 2), [0.0, EPS / 2])
    more = np.vstack([programmes, [[GIVEN] * 3]])
    given = np.tile([0.0, EPS / 2], (4, 4, 1))
    signal = Programmes(vehicle, loop, rules, more, segment=3, given=given)
    run = closed_loop(vehicle, loop, np.array([[0.0, 1.0]] * 4), signal)
    assert (run.outcome == Outcome.REACHED).all()
    expected = [EPS] * 3 + [-EPS] * 3 + [EPS, -EPS, EPS, -EPS]
    np.testing.assert_allclose(signal.values[:10, 0, 1], expected)
    signs = [1, 1, 1, -1, -1, 1, 1, 1, -1, -1]  # the sign changes after every 2.5 samples
    np.testing.assert_allclose(signal.values[:10, 1, 1], EPS * np.array(signs))
    at = rules.all[flip].flip
    np.testing.assert_allclose(signal.values[: at + 1, 2, 1], [EPS] * at + [-EPS])
    np.testing.assert_allclose(signal.values[:10, 3, 1], [EPS / 2] * 4 + [0.0] * 6)


def test_levels_and_times_that_evolve_stay_within_the_bound():
    waves = Waves(np.array([0.0, EPS, 2 * EPS]), 40, 60, 4)
    signals = waves(np.random.default_rng(0).normal(0, 2, (200, waves.size)))
    assert signals.shape == (60, 200, 3)
    assert not signals[:, :, 0].any()
    assert (np.abs(signals) <= waves.limits + 1e-15).all()
    at_ends = np.isclose(np.abs(signals[:, :, 1]), EPS).mean()
    assert at_ends > 0.5, "most signals are at the ends of the bound"
    changes = (np.diff(signals[:, :, 1], axis=0) != 0).sum(axis=0)
    assert changes.min() <= 3 < changes.max(), "some swing"


def test_wishes_pick_the_answers_that_they_name(vehicle):
    loop = PolicyController(sign_policy(vehicle))
    rules = Rules(vehicle, loop, EPS, np.array([0.0, 1.0]))
    wishes = [(rule.kind, rule.steer) for rule in rules.all[:5]]
    words = [(word, (0, 0)) for word in ("contrary", "straight", "reverse")]
    assert wishes == [*words, ("steer", (0, 1)), ("steer", (0, -1))]
    starts = np.array([[0.0, 0.05]] * 5 + [[0.0, 0.95]])
    programmes = np.array([[0], [1], [2], [3], [4], [1]])
    signal = Programmes(vehicle, loop, rules, programmes, segment=1)
    plant = vehicle.plant(len(starts))
    plant.set_state(*vehicle.state(starts))
    n = len(starts)
    now = Sample(np.arange(n), np.zeros(n, int), plant.measurement, np.zeros(n, int), plant)
    u, _ = loop.step(now.q, now.measurement + signal.sample(now))
    # Just above the axis the policy steers to the left, and noise can make it steer to the right.
    np.testing.assert_array_equal(u[[0, 3, 4, 5], 0], [-1.0, 1.0, -1.0, 0.0])
    assert Noise("none", 0.1).against(vehicle, loop).shares.tolist() == [0.0, 1.0]


def test_the_rule_that_simulates_ahead_gives_adversarial_noise(puck):
    loop = PolicyController(ChartPolicy(puck, lambda z: np.clip(-3 * z[:, 1:2], -1.0, 1.0)))
    starts = puck.starts(6, np.random.default_rng(0))
    shares = np.array(puck.noisy, dtype=float)
    rules = Rules(puck, loop, EPS, shares)
    signal = Programmes(puck, loop, rules, np.full((6, 1), rules.ahead), segment=1)
    ruled = closed_loop(puck, loop, starts, signal)
    adversarial = closed_loop(puck, loop, starts, Noise("adversarial", EPS))
    np.testing.assert_array_equal(ruled.path, adversarial.path)
    assert np.abs(np.array(signal.values)).max() == EPS


# ---- what one known noise signal breaks is broken by an attack of the default budget

WINDOW, FIRST = 16, 4
STARTS = np.array([[0.0, 1.0], [0.0, 1.01]])
# By so much of its window a signal has to be the known one.
ENOUGH = 13
K = np.arange(WINDOW)
# The known signals, as signs on the columns x and y; the sign of a whole signal does not matter.
SIGNALS = {
    "constant": np.stack([0 * K, np.ones(WINDOW)], axis=1),
    "alternating": np.stack([0 * K, (-1.0) ** K], axis=1),
    "one flip": np.stack([0 * K, np.where(K < 9, 1.0, -1.0)], axis=1),
    "an early flip": np.stack([0 * K, np.where(K < 4, 1.0, -1.0)], axis=1),
    "resonance at period 6": np.stack([0 * K, np.where(2 * (K + FIRST) // 6 % 2, -1.0, 1.0)], axis=1),
    "resonance at period 9": np.stack([0 * K, np.where(2 * (K + FIRST) // 9 % 2, -1.0, 1.0)], axis=1),
    "the second column alone": np.stack([0 * K, np.ones(WINDOW)], axis=1),
}  # fmt: skip


def matches(noise, signal, everywhere):
    """Whether noise (n, ..., 2) has the sign of the known signal (..., 2), and no noise on x."""
    right = np.sign(np.round(noise[..., 1], 6)) == signal[..., 1]
    return right & (np.abs(noise[..., 0]) < EPS / 2) if everywhere else right


@dataclass(frozen=True)
class Watcher:
    """A controller of the vehicle with many modes, which count samples, and those of the known signal.

    It drives straight on, and leaves the arena once the signal was there. So its noise is what it measures
    less where it is by itself.
    """

    signal: np.ndarray
    y: float
    everywhere: bool = False
    modes: tuple[int, ...] = field(default=tuple(range(3 * 61 * (WINDOW + 1))), repr=False)

    def initial_mode(self, measured):
        return np.zeros(len(measured), dtype=int)

    def step(self, q, measured):
        k, count = np.divmod(q, WINDOW + 1)
        noise = measured - np.stack([0.05 * k, np.full(len(k), self.y)], axis=1)
        at = np.clip(k - FIRST, 0, WINDOW - 1)
        inside = (k >= FIRST) & (k < FIRST + WINDOW)
        more = inside & matches(noise, self.signal[at], self.everywhere)
        leaves = (k >= FIRST + WINDOW) & (count >= ENOUGH)
        following = (k + 1) * (WINDOW + 1) + np.minimum(count + more, WINDOW)
        return np.where(leaves, 1.0, 0.0)[:, None], following


@dataclass(frozen=True)
class Rememberer:
    """As `Watcher`, a policy with one mode that remembers what it measured."""

    signal: np.ndarray
    y: float
    everywhere: bool = False

    def start(self, n):
        return np.full((n, 60, 2), np.nan)

    def act(self, measured):
        return np.zeros((len(measured), 1))

    def act_after(self, past, measured):
        k = np.isfinite(past[:, :, 1]).sum(axis=1)
        u = np.zeros((len(measured), 1))
        for row in np.flatnonzero(k >= FIRST + WINDOW):
            seen = past[row, 60 - k[row] :][FIRST : FIRST + WINDOW]
            x = 0.05 * np.arange(FIRST, FIRST + WINDOW)
            noise = seen - np.stack([x, np.full(WINDOW, self.y)], axis=1)
            u[row] = matches(noise, self.signal, self.everywhere).sum() >= ENOUGH
        return u, np.concatenate([past[:, 1:], measured[:, None]], axis=1)


@dataclass(frozen=True)
class Turner:
    """A controller that leaves the arena if the noise is +eps in mode 0, and -eps after its jump."""

    modes = (0, 1, 2, 3)

    def initial_mode(self, measured):
        return np.zeros(len(measured), dtype=int)

    def step(self, q, measured):
        x, y = measured.T
        jumps = np.where((q == 0) & (x > 0.9), np.where(y > 1.05, 1, 3), q)
        following = np.where((q == 1) & (x > 1.5), np.where(y < 0.95, 2, 3), jumps)
        return np.where(following == 2, 1.0, 0.0)[:, None], following


def default(**options):
    return Budget(rounds=Effort().attack_rounds, **options)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "make"), [*zip(SIGNALS, cycle(["one mode", "several modes"]))])
def test_what_one_signal_breaks_is_broken(vehicle, name, make):
    signal, everywhere = SIGNALS[name], name == "the second column alone"
    start = STARTS[:1]
    if make == "one mode":
        loop = PolicyController(Rememberer(signal, start[0, 1], everywhere))
    else:
        loop = Watcher(signal, start[0, 1], everywhere)
    # The known signal alone breaks it, and none does not.
    known = np.zeros((60, 1, 2))
    known[FIRST : FIRST + WINDOW, 0] = EPS * signal
    (arc,) = simulate_batch(vehicle, loop, start, Recorded(known, EPS))
    assert arc.outcome == "out_of_bounds"
    (arc,) = simulate_batch(vehicle, loop, start)
    assert arc.outcome == "reached"
    found = attack(vehicle, {"it": loop}, start, EPS, default(), everywhere)["it"]
    assert found.count.lost == 1, found.count
    assert found.arcs[0].outcome == "out_of_bounds"


def test_a_bias_that_turns_at_the_jump_is_found(vehicle):
    found = attack(vehicle, {"it": Turner()}, STARTS, EPS, default())["it"]
    assert found.count.lost == len(STARTS)


@pytest.mark.slow
def test_all_are_tried_with_the_same_rules_and_several_modes_with_more(vehicle):
    loops = {
        "one": PolicyController(one_way_policy(vehicle, clear=1.004)),
        # Noise of y = 2 is never measured: nothing breaks it.
        "several": Watcher(-5 * SIGNALS["constant"], 1.0),
    }
    found = attack(vehicle, loops, STARTS[:1], EPS, Budget(rounds=6))
    one, several = (found[name].count for name in loops)
    assert one.lost == several.lost == 0
    assert set(several.tried) - set(one.tried) == {"jump", "stay", "turn"}
    assert {kind: several.tried[kind] for kind in one.tried} == one.tried
    assert one.rounds == several.rounds
    assert several.samples > one.samples > 60
