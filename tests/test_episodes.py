"""Noisy episodes in bulk: counts, regions and intervals, with controllers whose worst case is known."""

from collections import Counter

import numpy as np
import pytest
from planted import decisions

from hyrl_mj import BadInput, Noise
from hyrl_mj.judging import episodes as bulk
from hyrl_mj.judging.episodes import Regions, noisy_episodes
from hyrl_mj.judging.game import Ends, compare


def record(records, controller, region, noise=None):
    found = [
        r
        for r in records
        if r.controller == controller and r.region == region and noise in (None, r.noise)
    ]
    assert len(found) == 1
    return found[0]


@pytest.fixture(scope="module")
def records(vehicle, game_on_vehicle):
    """Episodes of the sign rule and of the ideal one, under every kind of noise."""
    game = game_on_vehicle
    noises = tuple(Noise(k, 0.1) for k in ("uniform", "alternating", "adversarial"))
    regions = Regions(decisions(vehicle).points, (game.lattice.grid, game.winnable(0.1)))
    loops = {name: game.controllers[name] for name in ("sign", "ideal")}
    return noisy_episodes(vehicle, regions, loops, noises, 300)[0]


@pytest.mark.slow
def test_the_counts_add_up(records):
    for noise in ("uniform", "alternating", "adversarial"):
        for name in ("sign", "ideal"):
            mine = [r for r in records if (r.noise, r.controller) == (noise, name)]
            assert {r.region for r in mine} == {"near M*", "elsewhere", "not winnable"}
            assert sum(r.episodes for r in mine) == 300
            for r in mine:
                assert sum(r.outcomes.values()) == r.episodes
                assert r.reached == r.outcomes.get("reached", 0) / r.episodes
                assert 0 <= r.interval[0] <= r.reached <= r.interval[1] <= 1
    for region in ("near M*", "elsewhere", "not winnable"):
        assert len({r.episodes for r in records if r.region == region}) == 1, "the same starts"


def test_starts_near_the_critical_set_are_those_within_twice_the_noise(vehicle):
    # Starts are uniform in 0 <= x <= 0.5, |y| <= 1, and M* runs along the axis up to x = 0.45.
    z0, regions = (
        vehicle.starts(2_000, np.random.default_rng(0)),
        Regions(decisions(vehicle).points),
    )
    for eps in (0.05, 0.1):
        parts = regions.split(vehicle, eps, z0)
        assert [*parts] == ["near M*", "elsewhere"]
        assert parts["near M*"].mean() == pytest.approx(2 * eps, abs=0.03)


def test_the_ideal_rule_reaches_the_set_point_from_all_winnable_starts(records):
    for r in records:
        if r.controller == "ideal" and r.region != "not winnable":
            assert set(r.outcomes) == {"reached"}
            assert r.interval[1] == 1.0


def test_adversarial_noise_is_worse_than_chance(records):
    for region in ("near M*", "elsewhere"):
        adversarial, uniform = (
            record(records, "sign", region, k) for k in ("adversarial", "uniform")
        )
        assert adversarial.reached <= uniform.reached
    near = record(records, "sign", "near M*", "adversarial")
    assert near.interval[1] < record(records, "sign", "near M*", "uniform").interval[0]


def test_no_noise_is_worse_than_the_worst(records, game_on_vehicle):
    # The share of starts in the band that the game calls lost bounds what episodes lose near M*.
    won = game_on_vehicle.score("sign", 0.1).won
    for kind in ("uniform", "alternating", "adversarial"):
        mine = [record(records, "sign", region, kind) for region in ("near M*", "elsewhere")]
        lost = sum(r.episodes - r.outcomes["reached"] for r in mine)
        assert lost / sum(r.episodes for r in mine) <= 1 - won + 0.02


@pytest.mark.slow
def test_the_same_seed_gives_the_same_counts(vehicle, game_on_vehicle):
    sign = {"sign": game_on_vehicle.controllers["sign"]}

    def counts(seed):
        noises = (Noise("uniform", 0.2),)
        return noisy_episodes(
            vehicle, Regions(decisions(vehicle).points), sign, noises, 60, seed=seed
        )

    assert counts(3) == counts(3)
    assert counts(3) != counts(4)


def test_batches_add_up_and_none_is_the_same(vehicle, game_on_vehicle, monkeypatch):
    monkeypatch.setattr(bulk, "BATCH", 50)
    sign, noises = {"sign": game_on_vehicle.controllers["sign"]}, (Noise("uniform", 0.1),)

    def near(count):
        regions = Regions(decisions(vehicle).points)
        records, _ = noisy_episodes(vehicle, regions, sign, noises, count)
        assert sum(r.episodes for r in records) == count
        return record(records, "sign", "near M*").episodes

    one, two, more = (near(count) for count in (50, 100, 125))
    assert one < two < more
    assert two != 2 * one


def test_noise_that_hides_everything_is_refused(vehicle, game_on_vehicle):
    sign, noises = {"sign": game_on_vehicle.controllers["sign"]}, (Noise("uniform", 1.5),)
    with pytest.raises(BadInput, match=r"noise bound 1\.5 hides the whole state space of vehicle"):
        noisy_episodes(vehicle, Regions(decisions(vehicle).points), sign, noises, 10)


@pytest.mark.slow
def test_controllers_are_compared_from_starts_that_all_win_without_noise(vehicle, game_on_vehicle):
    loops = {name: game_on_vehicle.controllers[name] for name in ("sign", "left")}
    noises = (Noise("none", 0.1), Noise("adversarial", 0.1))
    counts, (compared,) = noisy_episodes(
        vehicle, Regions(decisions(vehicle).points), loops, noises, 60
    )
    counted = Counter()
    for count in counts:
        counted[count.noise, count.controller] += count.lost
    assert compared.unaided == {name: counted["none", name] for name in loops}
    assert compared.starts == 60
    assert compared.compared >= 60 - sum(compared.unaided.values())
    assert 0 < compared.lost["sign"] <= counted["adversarial", "sign"] - compared.unaided["sign"]
    assert compared.lost["left"] == 0
    assert compared.alone["sign"] <= compared.lost["sign"]
    low, high = compared.interval
    assert low <= compared.difference <= high
    assert (
        compared.difference == (compared.lost["sign"] - compared.lost["left"]) / compared.compared
    )
    _, comparisons = noisy_episodes(vehicle, Regions(np.empty((0, 2))), loops, (noises[1],), 8)
    assert comparisons == (), "without noise nothing was played"


def test_a_comparison_counts_what_it_says():
    no, yes, one = np.zeros(6, dtype=bool), np.ones(6, dtype=bool), np.ones(6)
    quiet = {
        "policy": Ends(np.array([1, 0, 0, 0, 0, 0], dtype=bool), one, one),
        "hyrl": Ends(no, one, 2 * one),
    }
    noisy = {
        "policy": Ends(
            np.array([1, 1, 1, 0, 0, 0], dtype=bool), np.array([9, 9, 9, 1, 2, 3.0]), one
        ),
        "hyrl": Ends(
            np.array([0, 1, 0, 0, 0, 0], dtype=bool), np.array([9, 9, 1, 1, 1, 1.0]), 3 * one
        ),
    }
    compared = compare("uniform", quiet, noisy)
    assert (compared.starts, compared.compared) == (6, 5)
    assert compared.unaided == {"policy": 1, "hyrl": 0}
    assert compared.lost == {"policy": 2, "hyrl": 1}
    assert compared.alone == {"policy": 1, "hyrl": 0}
    assert compared.difference == 1 / 5
    assert compared.late == {"policy": 1, "hyrl": 0}, "three times as long, and twice is not late"
    assert compared.time["policy"][0] == 2
    assert compared.way["hyrl"] == (1.5, 1.5)
    assert compare("uniform", quiet, dict.fromkeys(quiet, Ends(yes, one, one))).late["hyrl"] == 0


def test_the_interval_of_a_paired_difference_covers_it():
    # Both controllers lose together more often than apart; 95% of the intervals hold the difference.
    rng, both, first, last, n = np.random.default_rng(0), 0.1, 0.08, 0.02, 200
    held = []
    for _ in range(1_000):
        kind = rng.choice(4, n, p=(both, first, last, 1 - both - first - last))
        ends = {
            "policy": Ends(np.isin(kind, (0, 1)), np.ones(n), np.ones(n)),
            "hyrl": Ends(np.isin(kind, (0, 2)), np.ones(n), np.ones(n)),
        }
        won = dict.fromkeys(ends, Ends(np.zeros(n, dtype=bool), np.ones(n), np.ones(n)))
        low, high = compare("uniform", won, ends).interval
        held.append(low <= first - last <= high)
    assert 0.94 <= np.mean(held) <= 0.98
