"""HyRL against the policy over the runs of a sweep."""

import numpy as np
import pytest

from hyrl_mj.runs.improvement import improvements, profile
from hyrl_mj.runs.sweeps import Common, Row, Setting, Sweep
from hyrl_mj.viz.sweep_page import draw_profiles
from hyrl_mj.viz.sweep_tables import improvement_table

CIRCLE, VEHICLE = Setting("unit_circle", "", 0.1), Setting("vehicle", "", 0.1)


def row(setting, seed, policy, hyrl, figure="proved"):
    figures = {f"policy_{figure}": policy, f"hyrl_{figure}": hyrl}
    return Row(setting, seed, "done", "all is well", "WON", 10.0, figures)


def test_means_differences_and_the_probability_of_improvement():
    rows = [row(CIRCLE, i, p, h) for i, (p, h) in enumerate([(0.5, 1), (0.9, 1), (1, 1)])]
    rows += [row(VEHICLE, i, 0.0, 0.9) for i in range(3)]
    rows += [Row(VEHICLE, 3), row(VEHICLE, 4, None, None)]
    (found,) = improvements(rows)
    assert (found.figure, found.runs) == ("proved", 6)
    assert found.policy.value == pytest.approx(0.4)
    assert found.hyrl.value == pytest.approx(0.95)
    assert found.difference.value == pytest.approx(0.55)
    low, high = found.difference.interval
    # The vehicle's runs are alike: only the circle's seeds vary.
    assert low == pytest.approx((0.0 + 0.9) / 2, abs=0.01)
    assert high == pytest.approx((0.5 + 0.9) / 2, abs=0.01)
    # On the circle one seed of three ties with all; on the vehicle HyRL is always better.
    assert found.better == pytest.approx((5 / 6 + 1) / 2)
    assert improvements(rows) == [found], "the same numbers again"


@pytest.mark.parametrize("figure", ["proved", "not_broken", "margin"])
def test_a_run_that_has_no_figure_of_one_controller_is_not_left_out(figure):
    rows = [row(CIRCLE, 0, 0.1, 0.3, figure), row(CIRCLE, 1, 0.1, None, figure)]
    if figure == "proved":  # that it could not be bounded is no loss
        assert improvements(rows)[0].runs == 1
        rows[1].figures["hyrl_not_broken"] = None  # a replay refuted the game
    (found,) = improvements(rows)
    assert (found.runs, found.policy.value, found.hyrl.value) == (2, 0.1, 0.15)
    shares = profile(rows, figure, np.array([0.05, 0.2]))
    assert {who: list(share) for who, share in shares.items()} == {
        "policy": [1, 0],
        "hyrl": [0.5, 0.5],
    }
    assert improvements([row(CIRCLE, 0, None, 0.3, "late")]) == []


def test_less_is_better_where_it_is():
    rows = [row(CIRCLE, i, 0.2, 0.1, "late") for i in range(3)]
    (found,) = improvements(rows)
    assert found.better == 1
    assert found.difference.value == pytest.approx(-0.1)
    assert found.difference.interval == pytest.approx((-0.1, -0.1))


def test_an_interval_takes_three_seeds_of_each_setting():
    rows = [*(row(CIRCLE, i, 0.5, i / 4) for i in range(4)), row(VEHICLE, 0, 0.5, 1.0)]
    assert improvements(rows)[0].hyrl.interval is None
    low, high = improvements(rows[:4])[0].hyrl.interval
    assert 0 <= low < 0.375 < high <= 0.75


def test_an_interval_tells_of_the_starts_that_were_tried():
    def tried(starts):
        rows = [row(CIRCLE, i, 0.5, 0.8, "withstood_attack") for i in range(4)]
        for one in rows:
            one.figures["attacked"] = starts
        (found,) = improvements(rows)
        return found

    assert tried(0).hyrl.interval == pytest.approx((0.8, 0.8))
    found = tried(100)
    # Of four runs with 100 starts each; the variances of both controllers add up.
    off = 1.96 * (0.8 * 0.2 / 400) ** 0.5
    assert found.hyrl.interval == pytest.approx((0.8 - off, 0.8 + off), abs=0.01)
    off = 1.96 * ((0.8 * 0.2 + 0.5 * 0.5) / 400) ** 0.5
    assert found.difference.interval == pytest.approx((0.3 - off, 0.3 + off), abs=0.01)
    assert found == tried(100), "the same numbers again"


def test_profiles_are_shares_of_runs_that_reach_a_threshold():
    rows = [row(CIRCLE, i, p, 1.0) for i, p in enumerate((0.5, 0.9, 1.0))]
    shares = profile(rows, "proved", np.array([0.0, 0.6, 0.95, 1.0]))
    np.testing.assert_allclose(shares["policy"], [1, 2 / 3, 1 / 3, 1 / 3])
    np.testing.assert_allclose(shares["hyrl"], 1)
    assert profile(rows, "late", np.array([0.0])) == {}
    sweep = Sweep(Common("fast", None, {}), tuple(rows))
    assert [panel.get_xlabel() for panel in draw_profiles(sweep).axes] == ["proved, own q0 [%]"]
    assert draw_profiles(Sweep(sweep.common, tuple(rows[:2]))) is None


def test_the_table_reads_with_intervals():
    rows = tuple(row(CIRCLE, i, 0.5, 1.0) for i in range(3))
    table = improvement_table(Sweep(Common("fast", None, {}), rows))
    assert table.rows == [
        [
            "proved, own q0", "3", "50.00% (50.00% to 50.00%)", "100% (100% to 100%)",
            "+50.00% (+50.00% to +50.00%)", "1.00",
        ]
    ]  # fmt: skip
    assert improvement_table(Sweep(Common("fast", None, {}), (Row(CIRCLE, 0),))) is None
