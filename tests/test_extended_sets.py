"""Extended sets reach over the critical set as far as backward motion, room and noise say."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from environments import Puck, puck_agent
from planted import ChartPolicy, circle_policy, one_way_policy, pass_on, sign_policy

from hyrl_mj import BadInput, extend, find_critical_set, from_gymnasium, make_partition
from hyrl_mj.learning.presets import preset
from hyrl_mj.pipeline.steps import extended_sets_stage
from hyrl_mj.sets import distance_to
from hyrl_mj.stages import ExtendedSets, Partition
from hyrl_mj.stages.extended_sets import _Entering
from hyrl_mj.stages.partition import PartPolicy

PI = np.pi
# From the axis an obstacle of radius 0.75 at x = 1.5 can be passed only if x <= this.
LAST_CHANCE = 1.5 - 0.75 * np.sqrt(2)


class Case:
    """A task with a planted policy, its critical set and its partition."""

    def __init__(self, task, policy, rods, cells):
        self.task, self.policy = task, policy
        self.critical = find_critical_set(task, policy, rods, 1 / 32)
        self.partition = make_partition(task, policy, self.critical.points, cells)

    def extend(self, horizon, noise):
        points = self.critical.points
        return extend(self.task, self.policy, points, self.partition, noise, horizon)


@pytest.fixture(scope="module")
def on_circle(circle):
    return Case(circle, circle_policy(circle), 121, 720)


@pytest.fixture(scope="module")
def on_vehicle(vehicle):
    return Case(vehicle, sign_policy(vehicle), 60, 120)


@pytest.fixture(scope="module")
def vehicle_sets(on_vehicle):
    return {noise: on_vehicle.extend(0.3, noise) for noise in (0.0, 0.1)}


def overlap(sets, x):
    """Half the distance between the far edges of the two sets at a given x [m]."""
    y = np.linspace(-1.4, 1.4, 2801)
    z = np.stack([np.full_like(y, x), y], axis=-1)
    left, right = (y[s.contains(z)] for s in sets.sets)
    return (right.max() - left.min()) / 2


def test_what_has_entered_its_part_goes_on_as_the_stage_1_policy(vehicle):
    """pi_i would go on as at the nearest point inside of M_i, which with inertia may be far."""
    policy = ChartPolicy(vehicle, lambda z: z[:, 1:])
    left = make_partition(vehicle, sign_policy(vehicle), np.zeros((1, 2)), 60).parts[0]
    pi, near = PartPolicy(vehicle, policy, left.eroded(0.5), 0.5), left.eroded(left.grid.cell)
    z = np.array([[1.0, -0.3], [1.0, 0.01], [1.0, 0.3], [1.0, 0.9]])
    assert pi.act(z)[2, 0] > 0.4
    assert np.ravel(_Entering(pi, near, np.array([7.0])).act(z)).tolist() == [7.0, 7.0, 0.3, 0.9]


# ---- unit circle


@pytest.mark.parametrize(("horizon", "noise"), [(0.2, 0.1), (0.5, 0.1), (0.5, 0.01), (0.5, 0.0)])
def test_the_circle_s_sets_reach_the_horizon_over_the_critical_angle(on_circle, horizon, noise):
    sets = on_circle.extend(horizon, noise)
    assert sets.modes == (0, 1)
    theta = np.linspace(0.5, 2 * PI - 0.5, 20_000)
    clockwise, counter = (theta[s.contains(theta[:, None])] for s in sets.sets)
    cell = sets.sets[0].grid.cell
    assert clockwise.max() == pytest.approx(PI + horizon, abs=2 * cell)
    assert counter.min() == pytest.approx(PI - horizon, abs=2 * cell)
    assert clockwise.min() == 0.5
    assert np.diff(clockwise).max() < 1e-3, "a hole"


def test_both_sets_hold_the_set_point_with_room_for_the_noise(on_circle):
    sets = on_circle.extend(0.5, 0.1)
    around = np.linspace(-0.38, 0.38, 50)[:, None]
    assert all(s.contains(around).all() for s in sets.sets)


# ---- vehicle


@pytest.mark.slow
@pytest.mark.first(2)
@pytest.mark.parametrize("x", [0.0, 0.1, 0.2, 0.3, 0.4])
def test_without_noise_the_overlap_is_what_can_still_be_won(vehicle_sets, on_vehicle, x):
    cell = on_vehicle.partition.grid.cell
    assert overlap(vehicle_sets[0.0], x) == pytest.approx(min(0.3, LAST_CHANCE - x), abs=cell)


@pytest.mark.slow
@pytest.mark.parametrize("x", [0.0, 0.05, 0.1, 0.15, 0.2])
def test_with_noise_there_is_room_for_it(vehicle_sets, on_vehicle, x):
    # The noise acts across; the room is measured at right angles to the edge, or across.
    cell = on_vehicle.partition.grid.cell
    width = overlap(vehicle_sets[0.1], x)
    assert width <= max(0.1, min(0.3, LAST_CHANCE - x - 0.1)) + cell
    assert width >= max(0.1, min(0.3, LAST_CHANCE - x - 0.1 * np.sqrt(2))) - cell


@pytest.mark.slow
@pytest.mark.parametrize("x", [0.0, 0.2, 0.4, 0.5, 0.7])
def test_the_overlap_is_never_narrower_than_the_noise(vehicle_sets, x):
    assert overlap(vehicle_sets[0.1], x) >= 0.1 - 2e-3


@pytest.mark.slow
def test_noise_on_all_coordinates_asks_for_room_along_each(vehicle, vehicle_sets):
    case = Case(vehicle.noisy_everywhere(), sign_policy(vehicle), 60, 120)
    sets, usual, eps = case.extend(0.3, 0.1), vehicle_sets[0.1], 0.1
    for members, ordinary, part, wins in zip(
        sets.sets, usual.sets, case.partition.parts, sets.winning, strict=True
    ):
        off = part.dilated_by_box(np.array([eps, eps]))
        assert members.mask[part.mask].all()
        assert members.mask[off.mask].all()
        # Elsewhere no error within the bound, along x and y, leads out of where the mode wins.
        errors = eps * np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        near = members.grid.nodes[members.mask & ~off.mask][:, None] + errors
        assert wins[members.grid.nearest(near.reshape(-1, 2))].all()
        assert np.count_nonzero(members.mask & ~ordinary.mask & ~off.mask) == 0


@pytest.mark.slow
def test_the_set_point_and_what_lies_behind_the_obstacle_is_in_every_set(vehicle_sets):
    z = np.array([[3.0, 0.0], [2.9, 0.1], [2.4, -0.5], [2.0, 1.0]])
    for sets in vehicle_sets.values():
        assert all(s.contains(z).all() for s in sets.sets)


@pytest.mark.slow
def test_the_winning_nodes_do_win(vehicle_sets):
    sets = vehicle_sets[0.1]
    nodes = sets.sets[0].grid.nodes
    at = np.argmin(np.abs(nodes - [0.0, -0.2]).sum(axis=1))
    late = np.argmin(np.abs(nodes - [0.4, -0.2]).sum(axis=1))
    assert sets.winning[0][at]
    assert sets.winning[1][at]
    assert not sets.winning[0][late]


def test_a_single_mode_keeps_everything(vehicle):
    case = Case(vehicle, one_way_policy(vehicle), 20, 30)
    sets = case.extend(0.3, 0.1)
    assert sets.modes == (0,)
    assert sets.sets[0].mask.all()
    assert sets.sentence(vehicle) == "one mode, whose set is the whole chart"
    far = distance_to(vehicle.chart, case.critical.points, np.zeros((3, 2)))
    np.testing.assert_array_equal(far, [np.inf] * 3)
    late = sets.sets[0].grid.nodes[:, 0] > 1  # all starts lie before
    said = replace(sets, winning=(late,)).sentence(vehicle)
    assert "no start of the task is known to arrive in mode 0 (left): stage 6 trains" in said


# ---- sized to the noise


@pytest.fixture(scope="module")
def sized(on_vehicle):
    return {noise: on_vehicle.extend(None, noise) for noise in (0.0, 0.1, 0.2)}


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2])
@pytest.mark.parametrize("x", [0.0, 0.1, 0.2, 0.3])
def test_the_overlap_is_twice_the_noise_and_a_sample_where_there_is_room(
    sized, on_vehicle, noise, x
):
    cell = on_vehicle.partition.grid.cell
    ideal = max(noise, min(2 * noise + 0.05, LAST_CHANCE - x - noise))
    assert overlap(sized[noise], x) == pytest.approx(ideal, abs=cell)


@pytest.mark.slow
def test_the_horizon_is_as_long_as_it_takes(sized, on_circle):
    assert sized[0.1].horizon == pytest.approx(0.25)
    assert on_circle.extend(None, 0.1).horizon == pytest.approx(0.25)
    assert on_circle.extend(None, 0.2).horizon == pytest.approx(0.45)


@pytest.mark.slow
def test_where_the_overlap_cannot_be_wide_enough_the_run_says_so(sized, vehicle):
    narrow = sized[0.1].points[sized[0.1].narrow]
    room = sized[0.1].room[sized[0.1].narrow]
    cell = sized[0.1].sets[0].grid.cell
    # From the axis there is room for 2 eps up to here, and none from the last chance on.
    assert narrow[:, 0].min() == pytest.approx(LAST_CHANCE - 0.2, abs=3 * cell)
    assert narrow[:, 0].max() == pytest.approx(LAST_CHANCE, abs=2 * cell)
    np.testing.assert_allclose(room, LAST_CHANCE - narrow[:, 0], atol=2 * cell)
    sentence = sized[0.1].sentence(vehicle)
    assert "between 0 (left) and 1 (right), from x = 0.3 m on, the room in which both" in sentence
    assert "switching safely needs 0.2 m" in sentence
    assert "switching" not in sized[0.0].sentence(vehicle)


# ---- plants that cannot be run backward


@pytest.mark.first(1)
@pytest.mark.parametrize(("noise", "horizon"), [(0.1, None), (0.0, 0.2)])
@pytest.mark.slow
def test_forward_runs_give_the_sets_that_backward_ones_give(
    on_circle, on_vehicle, monkeypatch, noise, horizon
):
    for case in (on_circle, on_vehicle):
        backward = case.extend(horizon, noise)
        with monkeypatch.context() as patch:
            patch.setattr(case.task, "kinematic", False)
            forward = case.extend(horizon, noise)
        assert forward.horizon == pytest.approx(backward.horizon, abs=0.05)
        grid, hop = case.partition.grid, 0.05 * np.sqrt(2)
        for a, b, part in zip(forward.sets, backward.sets, case.partition.parts, strict=True):
            assert (a.mask & ~part.dilated_by_box(case.task.noise_in_chart(noise)).mask).any()
            # An edge is known to a sample and the cells that close the gaps.
            slack = hop + 2 * grid.cell
            assert a.dilated(slack).mask[b.mask].all()
            assert b.dilated(slack).mask[a.mask].all()


def test_points_of_the_critical_set_that_cannot_be_used_are_refused(on_circle):
    case = on_circle
    for points, message in (
        (case.critical, "give its points"),
        (np.zeros(3), r"points of shape \(3,\)"),
        (np.zeros((3, 2)), r"give \(N, 1\)"),
    ):
        with pytest.raises(BadInput, match=message):
            extend(case.task, case.policy, points, case.partition, 0.1)
        with pytest.raises(BadInput, match=message):
            make_partition(case.task, case.policy, points, 30)


@pytest.mark.long
@pytest.mark.slow
def test_sets_reach_walls_that_only_stop_the_robot_and_hold_their_inside(few_trials, monkeypatch):
    puck, noise = from_gymnasium(Puck, steps=120), 0.3
    policy = SimpleNamespace(act=lambda m: np.clip(puck_agent(puck.observation(m)), -4, 4))
    points = find_critical_set(puck, policy, 24, 1 / 8).points
    partition = make_partition(puck, policy, points, 36, noise)
    nodes = partition.grid.nodes
    walls = ~puck.goes_on(nodes)
    off = np.linalg.norm(nodes[walls][:, None] - nodes[~walls], axis=2)
    stopped = extend(puck, policy, points, partition, noise).sets
    for own in stopped:
        for held, distance in zip(own.mask[walls], off, strict=True):
            assert held in own.mask[~walls][distance < distance.min() + 1e-9]
    monkeypatch.setattr(puck, "abilities", replace(puck.abilities, stopped_by_walls=False))
    crashed = extend(puck, policy, points, partition, noise).sets
    for own, other in zip(stopped, crashed, strict=True):
        assert (other.mask <= own.mask)[~walls].all()
        gained = nodes[~walls & own.mask & ~other.mask]
        assert len(gained)
        from_walls = np.linalg.norm(nodes[walls][:, None] - gained, axis=2).min(axis=0)
        assert from_walls.max() < noise * np.sqrt(2) + 2 * partition.grid.cell


@pytest.mark.slow
def test_a_late_decision_of_a_robot_with_inertia_is_taken_from_its_policy(puck, tmp_path):
    """It goes right from wherever that just succeeds; held inputs show that left has room there."""

    def late(z):
        side = np.where(z[:, 1] < 0.5 - 0.9 * z[:, 0], -1.0, 1.0)
        return pass_on(np.where(z[:, 0] < 1.1, side, np.sign(z[:, 1])), z[:, 1], 0.9)

    policy, eps = ChartPolicy(puck, late), 0.1
    x = np.linspace(0.0, 0.9, 30)
    points = np.column_stack([x, 0.5 - 0.9 * x])
    settings = replace(preset(puck, "fast"), eps=eps, cells=60)
    partition = make_partition(puck, policy, points, 60, eps, settings.ways)
    run = SimpleNamespace(
        settings=settings, task=puck, steady=policy, agent=None, path=tmp_path,
        critical_set=SimpleNamespace(points=points), partition=partition,
    )  # fmt: skip
    extended_sets_stage(run, str)
    split = Partition.load(tmp_path / "split.npz", puck)
    assert split.parts[0].contains(np.array([[0.0, 0.45], [0.3, 0.2]])).all()
    usual = extend(puck, policy, points, partition, eps)
    before = partition.grid.nodes[:, 0] < 0.7
    doomed = [
        sum(
            (own.mask & ~wins & before).sum()
            for own, wins in zip(s.sets, usual.winning, strict=True)
        )
        for s in (usual, ExtendedSets.load(tmp_path / "extended_sets.npz", puck))
    ]
    assert doomed[1] < 0.85 * doomed[0], "from fewer states of the sets their modes lose"
