"""The chart is split at the planted critical set, and each part's policy has made up its mind."""

import numpy as np
import pytest
from planted import ChartPolicy, circle_policy, one_way_policy, sign_policy

from hyrl_mj import Partition, find_critical_set, make_partition
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.partition import PartPolicy

PI = np.pi


@pytest.fixture(scope="module")
def circle_parts(circle):
    policy = circle_policy(circle)
    points = find_critical_set(circle, policy, 121, 1 / 32).points
    return make_partition(circle, policy, points, 720)


@pytest.fixture(scope="module")
def vehicle_parts(vehicle):
    policy = sign_policy(vehicle)
    points = find_critical_set(vehicle, policy, 60, 1 / 32).points
    return make_partition(vehicle, policy, points, 60)


def part_policies(task, policy, partition, near):
    """pi_i of each mode, with a neighbourhood of M* of some width."""
    return [PartPolicy(task, policy, part.eroded(near), near) for part in partition.parts]


def inside(part, *z):
    return part.contains(np.array(z, dtype=float).reshape(len(z), -1)).tolist()


def test_the_circle_is_split_at_its_critical_angle(circle_parts):
    assert circle_parts.modes == (0, 1)
    clockwise, counter = circle_parts.parts
    theta = (0.5, PI - 0.02, PI + 0.02, 2 * PI - 0.5)
    assert inside(clockwise, *theta) == [True, True, False, False]
    assert inside(counter, *theta) == [False, False, True, True]
    assert circle_parts.succeeds.all()


def test_the_set_point_belongs_to_both_halves(circle_parts):
    for part in circle_parts.parts:
        assert inside(part, 0.0, 0.28, 2 * PI - 0.28) == [True] * 3


def test_the_vehicle_s_arena_is_split_before_the_obstacle_and_shared_behind_it(vehicle_parts):
    assert vehicle_parts.modes == (0, 1)
    left, right = vehicle_parts.parts
    z = ((0.2, 0.1), (0.2, -0.1), (1.2, 1.2), (1.2, -1.2), (2.5, 0.3), (2.5, -0.3))
    assert inside(left, *z) == [True, False, True, False, True, True]
    assert inside(right, *z) == [False, True, False, True, True, True]


def test_the_parts_cover_the_chart(circle_parts, vehicle_parts):
    for partition in (circle_parts, vehicle_parts):
        first, second = partition.parts
        assert (first | second).mask.all()


def test_succeeds_are_the_nodes_from_which_the_policy_gets_there(vehicle, vehicle_parts):
    nodes = vehicle_parts.grid.nodes
    done = vehicle_parts.succeeds
    axis = np.abs(nodes[:, 1]) < 1e-9
    assert done[axis & (nodes[:, 0] < 0.42)].all()
    assert not done[axis & (nodes[:, 0] > 0.46) & (nodes[:, 0] < 2.24)].any()
    assert done[nodes[:, 0] > 2.3].sum() > 0.9 * (nodes[:, 0] > 2.3).sum()


@pytest.mark.parametrize("name", ["circle", "vehicle"])
def test_without_a_critical_set_there_is_one_part_that_holds_everything(name, request):
    task = request.getfixturevalue(name)
    if name == "circle":
        policy = ChartPolicy(task, lambda z: np.full((len(z), 1), -1.0))
    else:
        policy = one_way_policy(task)
    critical = find_critical_set(task, policy, 30, 1 / 4)
    partition = make_partition(task, policy, critical.points, 30)
    assert partition.modes == (0,)
    assert partition.parts[0].mask.all()


def test_the_sentence_gives_the_shares(circle, circle_parts):
    sentence = circle_parts.sentence(circle)
    assert "0 (clockwise) 55%" in sentence
    assert "1 (counter-clockwise) 55%" in sentence


def test_a_part_policy_does_elsewhere_what_it_does_at_the_nearest_point(circle, circle_parts):
    first, second = part_policies(circle, circle_policy(circle), circle_parts, 0.1)
    theta = np.array([[PI - 0.5], [PI - 0.05], [PI + 0.05], [PI + 0.5]])
    np.testing.assert_array_equal(first.act(theta), [[-1.0]] * 4)
    np.testing.assert_array_equal(second.act(theta), [[1.0]] * 4)


def test_an_undivided_part_policy_is_the_policy_also_when_it_is_read_again(
    circle, circle_parts, tmp_path
):
    policy = circle_policy(circle)
    first, _ = part_policies(circle, policy, circle_parts, 0.1)
    first.undivided.save(tmp_path / "mode_0.safetensors")
    again = PartPolicy.load(tmp_path / "mode_0_part.json", circle, policy, circle_parts, 0)
    theta = np.linspace(0, 2 * PI, 50)[:, None]
    for undivided in (first.undivided, again):
        np.testing.assert_array_equal(undivided.act(theta), policy.act(theta))
    assert (first.act(theta) != policy.act(theta)).any()


def test_a_part_policy_of_a_hesitant_policy_is_decided_at_the_critical_set(circle):
    policy = ChartPolicy(circle, lambda z: np.clip(5 * circle.chart.difference(z, PI), -1, 1))
    critical = find_critical_set(circle, policy, 121, 1 / 32)
    partition = make_partition(circle, policy, critical.points, 720)
    first, second = part_policies(circle, policy, partition, 0.2)
    at = np.array([[PI]])
    assert first.act(at)[0, 0] == pytest.approx(-1.0, abs=0.06)
    assert second.act(at)[0, 0] == pytest.approx(1.0, abs=0.06)


def test_a_run_goes_astray_that_comes_into_a_part_where_it_shares_it_with_the_start_s_own(circle):
    """Of three parts the second holds the start, and the third overlaps with the first, too."""
    grid = Grid.from_counts(circle.chart, np.array([8]))
    start, with_second, with_third, alone, outside = range(5)
    parts = tuple(
        GridSet.from_mask(grid, np.isin(np.arange(grid.size), nodes))
        for nodes in ([with_second, with_third, alone], [start, with_second], [with_third, outside])
    )
    partition = Partition((0, 1, 2), parts, parts[0].mask)
    ends = np.array([with_second, with_third, alone, outside])
    gone = partition.astray(parts[0], np.full(4, start), ends)
    assert gone.tolist() == [True, False, False, False]
