"""The quadrotor passes the end of a beam on four sides, and decides in time or crashes."""

import numpy as np
import pytest
from experts import Constant, distances, moved
from planted import ChartPolicy

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.learning.presets import preset
from hyrl_mj.stages import extend, find_critical_set, make_partition

# Distance from the axis at which the beam is passed [m].
CLEAR = 0.85
# Sides as directions (y, z): left, above, right, below.
SIDES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


@pytest.fixture(scope="module")
def beam():
    return hyrl_mj.get_task("beam")


def passing(task, side=None):
    """Flies past the beam on the nearest side, or on side number `side`, then back to the middle."""
    centre, gate = task.beam[0], task.set_point

    def rule(z):
        off = z[:, 1:] - centre[1:]
        chosen = SIDES[(off @ SIDES.T).argmax(axis=1) if side is None else np.full(len(z), side)]
        # Only the coordinate across that side changes.
        out = np.where(chosen != 0, CLEAR * chosen - off, 0.0)
        before = z[:, :1] < centre[0] + 0.3
        return np.clip(4 * np.where(before, out, gate[1:] - z[:, 1:]), *task.input_limits)

    return ChartPolicy(task, rule)


def test_its_clearance_is_that_of_mujoco(beam):
    z = np.random.default_rng(0).uniform(beam.chart.low, beam.chart.high, (300, 3))
    distance = distances(beam.model, ["hull"], "obstacle", beam.state(z)[0])
    apart = distance > 0
    assert 150 < apart.sum() < 300
    np.testing.assert_allclose(beam.clearance(z)[apart], distance[apart], atol=1e-6)
    assert (beam.clearance(z)[~apart] <= 0).all()


def test_it_keeps_its_course(beam):
    path = moved(beam, Constant(0, 0), [[0.0, 1.0, 2.2]], steps=40).path[:, 0]
    assert path[-1, 0] == pytest.approx(2 * beam.speed, abs=0.02)
    np.testing.assert_allclose(path[:, 1:], [[1.0, 2.2]] * len(path), atol=2e-3)


@pytest.mark.parametrize("u", [(1.2, 0.0), (0.0, 1.2), (0.0, -1.2), (-0.6, 0.6)])
def test_its_velocity_follows_after_a_while(beam, u):
    path = moved(beam, Constant(*u), [[0.0, 0.0, 1.6]], steps=18).path[:, 0]
    velocity = np.diff(path, axis=0) / beam.dt
    np.testing.assert_allclose(velocity[-1, 1:], u, atol=0.15)
    assert np.abs(velocity[0, 1:]).max() < 0.4 * np.abs(u).max()  # what has inertia does not jump


def test_every_side_can_be_passed_and_has_its_number(beam):
    for side in range(4):
        rollout = moved(beam, passing(beam, side), [[0.0, 0.05, 1.58], [0.2, -0.1, 1.7]])
        assert (rollout.outcome == Outcome.REACHED).all()
        assert beam.direction(rollout.path).tolist() == [side, side]
    assert tuple(beam.scene.mode_names) == ("left", "above", "right", "below")


def test_beside_the_beam_and_behind_it_nothing_is_left_to_decide(beam):
    z = [[2.2, 0.8, 1.6], [2.5, 0.0, 2.5], [3.5, -0.2, 1.3]]
    rollout = moved(beam, Constant(0, 0), z)
    assert beam.direction(rollout.path).tolist() == [-1, -1, -1]


def test_who_clears_a_corner_of_the_beam_has_nothing_to_decide(beam):
    z = [[0.5, 0.7, 2.3], [0.5, 0.7, 2.2], [0.5, -0.6, 0.9], [0.5, -0.7, 0.9]]
    rollout = moved(beam, Constant(0, 0), z)
    assert (rollout.outcome == Outcome.REACHED).all()
    assert beam.direction(rollout.path).tolist() == [-1, 0, 3, -1]


def test_who_does_not_decide_crashes_and_who_misses_the_gate_does_not_arrive(beam):
    z = [[0.0, 0.0, 1.6], [0.0, 1.25, 1.6], [3.2, 0.3, 1.6]]
    outcome = moved(beam, Constant(0, 0), z).outcome
    assert outcome.tolist() == [Outcome.CRASHED, Outcome.OUT_OF_BOUNDS, Outcome.REACHED]


def test_its_starts_have_time_to_pass_the_beam(beam):
    z = beam.starts(400, np.random.default_rng(0))
    assert beam.may_start(z).all()
    assert (moved(beam, passing(beam), z).outcome == Outcome.REACHED).all()
    assert not beam.may_start(np.array([[1.7, 0.0, 1.6]])).any()


def test_arriving_pays_more_than_missing_the_gate(beam):
    gate, off = np.zeros((1, 6)), np.zeros((1, 6))
    gate[0, :3], off[0, :3] = beam.set_point, np.add(beam.set_point, [0, 1.25, 0])
    still = np.zeros((1, 2))
    assert beam.reward(gate, still)[0] >= 10 > beam.reward(off, still)[0] == beam.worst_reward


@pytest.mark.slow
def test_the_critical_set_of_an_expert_lies_on_the_diagonals(beam):
    critical = find_critical_set(beam, passing(beam), 16, 1 / 32, "outcome")
    y, z = np.abs(critical.points[:, 1:] - beam.beam[0][1:]).T
    assert len(critical.points) > 100
    assert np.median(np.abs(y - z)) <= 0.01
    assert critical.pieces == 1  # four sheets meet in the axis
    at = np.sign(critical.points[:, 1:] - beam.beam[0][1:])[(y > 0.1) & (z > 0.1)]
    assert len(np.unique(at, axis=0)) == 4


@pytest.mark.slow
def test_each_part_s_policy_wins_on_its_side_of_the_beam_from_beyond_its_edges(beam):
    policy, eps = passing(beam), 0.1
    usual = preset(beam)
    points = find_critical_set(beam, policy, 16, 1 / 8, "outcome").points
    sets = extend(
        beam, policy, points, make_partition(beam, policy, points, usual.cells // 3, eps), eps
    )
    assert sets.modes == (0, 1, 2, 3)
    early = sets.points[:, 0] < 0.5
    assert early.sum() >= 20
    # All that the noise needs, as far as the cells of the grid tell.
    assert np.mean(sets.room[early] > 2 * eps - sets.sets[0].grid.cell) >= 0.85
    assert np.median(sets.room[early]) == pytest.approx(2 * eps)


def test_the_edge_of_the_arena_is_a_danger_where_it_is_near(beam):
    def danger(y):
        return beam.danger(np.array([[1.0, y, 1.6, 0.0, 0.0, 0.0]]))[0]

    # Far from it the beam counts alone; it is as far from there.
    assert danger(0.1) == danger(0.0) == pytest.approx(-0.99)
    assert danger(0.0) < danger(1.15) < danger(1.25) < 0.0
