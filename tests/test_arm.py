"""The arm folds as its joints are told, and its post leaves two ways."""

import mujoco
import numpy as np
import pytest
from experts import distances, moved
from planted import ChartPolicy

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.gym_export import BatchedEnv, Domain
from hyrl_mj.judging.game import Lattice, lattice_grid
from hyrl_mj.stages.critical_set import find_critical_set

# Angle of the shoulder from which the elbow may turn all the way round beside the post [rad].
CLEAR = 1.6


@pytest.fixture(scope="module")
def arm():
    return hyrl_mj.get_task("arm")


def folding(task, side=None):
    """Turns the shoulder away from the post, then the elbow: the short way, or by the sign `side`."""

    def rule(z):
        goal = task.chart.difference(task.set_point, z)
        elbow = np.where(np.abs(goal[:, 1]) < 0.05, 0.0, np.sign(goal[:, 1]))
        if side is not None:
            elbow = np.where(np.abs(goal[:, 1]) > 0.3, side, elbow)
        # Beside the post, the shoulder goes first.
        elbow = np.where(np.pi - np.abs(goal[:, 0]) > CLEAR, elbow, 0.0)
        shoulder = np.where(np.abs(goal[:, 0]) < 0.05, 0.0, np.sign(goal[:, 0]))
        return np.stack([shoulder, elbow], axis=1) * task.input_limits[1]

    return ChartPolicy(task, rule)


def test_its_clearance_is_that_of_mujoco(arm):
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (300, 2))
    q[:100, 0] *= 0.3
    expected = distances(arm.model, ("upper_link", "fore_link"), "obstacle", q)
    assert 20 < (expected < 0).sum() < 280
    apart = expected > 0
    np.testing.assert_allclose(arm.clearance(q)[apart], expected[apart], atol=1e-4)
    assert (arm.clearance(q)[expected < -1e-3] < 0).all()


def test_its_goal_is_the_posture_that_is_shown(arm):
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.set_point
    mujoco.mj_forward(arm.model, data)
    shown = data.body("goal_fore").xpos, data.body("goal_fore").xmat
    np.testing.assert_allclose(data.body("fore").xpos, shown[0], atol=1e-9)
    np.testing.assert_allclose(data.body("fore").xmat, shown[1], atol=1e-9)


def test_its_joints_follow_their_inputs(arm):
    assert arm.kinematic
    plant, z = arm.plant(50), arm.starts(50, np.random.default_rng(0))
    u = np.random.default_rng(1).uniform(*arm.input_limits, (50, 2))
    plant.set_state(*arm.state(z))
    plant.step(u)
    np.testing.assert_allclose(plant.measurement, z + u * arm.dt, atol=1e-5)
    assert not plant.warnings.any()


@pytest.mark.slow
def test_the_lattice_of_its_game_is_exact(arm):
    """A sample moves a joint by whole cells: what is proved on the nodes holds for the arm.

    The usual lattice has three of them for each of these.
    """
    coarse = Lattice.tabulate(arm, lattice_grid(arm, 160))
    assert coarse.exact
    assert (np.array(lattice_grid(arm).counts) == 3 * np.array(coarse.grid.counts)).all()


def test_link_1_cannot_pass_the_post(arm):
    elbow = np.linspace(-np.pi, np.pi, 500)
    for shoulder in (-0.4, 0.0, 0.4):
        q = np.stack([np.full(500, shoulder), elbow], axis=1)
        assert (arm.ending(q) == Outcome.CRASHED).all()
    # Away from the post, link 2 turns all the way round.
    q = np.stack([np.full(500, CLEAR), elbow], axis=1)
    assert (arm.clearance(q) > 0).all()


def test_its_starts_lie_nearly_everywhere(arm):
    z = arm.starts(4000, np.random.default_rng(0))
    assert arm.may_start(z).all()
    free = np.random.default_rng(1).uniform(-np.pi, np.pi, (4000, 2))
    free = free[arm.ending(free) == Outcome.RUNNING]
    assert arm.may_start(free).mean() > 0.95


def test_either_way_leads_to_the_goal_from_every_start(arm):
    z = arm.starts(500, np.random.default_rng(0))
    far = np.abs(arm.chart.difference(z, arm.set_point)[:, 1]) > 1.0
    for mode, side in enumerate((-1, 1)):
        rollout = moved(arm, folding(arm, side), z)
        assert (rollout.outcome == Outcome.REACHED).all()
        assert (arm.direction(rollout.path)[far] == mode).all()


def test_runs_with_nothing_left_to_decide_have_no_way(arm):
    z = np.add(arm.set_point, [[1.5, 0.1], [-1.5, -0.1]])
    assert arm.direction(moved(arm, folding(arm), z).path).tolist() == [-1, -1]


def test_in_the_training_of_a_mode_a_crash_costs_as_much_as_leaving(arm):
    z = np.array([[0.44, 0.0], [2.0, 0.0], [np.pi, np.pi - 0.4]])
    domain = Domain(lambda n, rng: z, lambda z: z[:, 0] < 2.05, exit_reward=-10.0)
    env = BatchedEnv(arm, 3, domain=domain)
    env.reset(z=z)
    fast = arm.input_limits[1][0]
    result = env.step(fast * np.array([[-1, 0], [1, 0], [0, 1]]))
    assert result.outcome.tolist() == [Outcome.CRASHED, Outcome.OUT_OF_BOUNDS, Outcome.REACHED]
    assert result.reward[:2].tolist() == [-10.0, -10.0]
    assert -0.1 < result.reward[2] < 0


@pytest.mark.slow
def test_the_critical_set_of_an_expert_is_one_curve_round_the_torus(arm):
    critical = find_critical_set(arm, folding(arm), 60, 1 / 16, "outcome")
    assert critical.pieces == 1
    assert np.abs(critical.points[:, 1]).max() < 0.01
    shoulder = np.sort(critical.points[:, 0])
    gaps = np.diff(shoulder)
    assert np.sort(gaps)[-2] < 0.2 < gaps.max() < 1.1  # open only at the post
    assert abs(shoulder[gaps.argmax()] + shoulder[gaps.argmax() + 1]) < 0.2
