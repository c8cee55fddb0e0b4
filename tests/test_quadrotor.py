"""The quadrotor flies as its rotors let it, and decides in time or crashes."""

import numpy as np
import pytest
from experts import Constant, moved

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.sets import Grid
from hyrl_mj.stages.partition import longest_hop
from hyrl_mj.tasks.flight import rotation


@pytest.fixture(scope="module")
def quadrotor():
    return hyrl_mj.get_task("quadrotor")


def test_a_rotation_is_that_of_mujoco(quadrotor):
    import mujoco

    quaternions = np.random.default_rng(0).normal(size=(20, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    for quaternion, matrix in zip(quaternions, rotation(quaternions), strict=True):
        expected = np.empty(9)
        mujoco.mju_quat2Mat(expected, quaternion)
        np.testing.assert_allclose(matrix, expected.reshape(3, 3), atol=1e-12)


def test_it_keeps_speed_and_height(quadrotor):
    plant = quadrotor.plant(1)
    plant.set_state(*quadrotor.state(np.array([[0.0, 1.2, 0.0]])))
    for _ in range(40):
        plant.step(np.zeros((1, 1)))
    speed, height = quadrotor.cruise
    assert plant.qpos[0, 2] == pytest.approx(height, abs=0.02)
    assert plant.qvel[0, 0] == pytest.approx(speed, abs=0.02)
    assert plant.measurement[0, 1] == pytest.approx(1.2, abs=1e-3)


@pytest.mark.parametrize("u", [-1.0, -0.5, 1.0])
def test_its_lateral_velocity_follows_after_a_while(quadrotor, u):
    path = moved(quadrotor, Constant(u), [[0.0, -u / 2, 0.0]], steps=20).path[:, 0, 1]
    velocity = np.diff(path) / 0.05
    assert abs(velocity[0]) < 0.2 * abs(u)
    assert velocity[-1] == pytest.approx(u, rel=0.15)


def test_its_start_states_drift_as_the_chart_says(quadrotor):
    z = quadrotor.starts(30, np.random.default_rng(0))
    plant = quadrotor.plant(len(z))
    plant.set_state(*quadrotor.state(z, np.random.default_rng(1)))
    np.testing.assert_allclose(plant.measurement[:, :3], z, atol=1e-12)
    tilt = plant.measurement[:, 3]
    assert 0.02 < np.abs(tilt).max() <= 0.051


def test_its_thrust_has_limits(quadrotor):
    low, high = quadrotor.model.actuator_ctrlrange.T
    rng = np.random.default_rng(0)
    thrust, torque = rng.uniform(0, 12, 500), rng.normal(size=(500, 3)) * [0.3, 0.3, 0.02]
    shared = quadrotor.rotors.share_out(thrust, torque)
    assert (shared >= low - 1e-9).all()
    assert (shared <= high + 1e-9).all()
    wanted = np.column_stack([thrust, torque]) @ quadrotor.rotors.mixer.T
    within = ((wanted >= low) & (wanted <= high)).all(axis=1)
    assert 20 < within.sum() < 480
    np.testing.assert_allclose(shared[within], wanted[within])
    # In flight they are met: full thrust on one side while it rolls.
    plant = quadrotor.plant(1)
    plant.set_state(*quadrotor.state(np.zeros((1, 3))))
    plant.step(np.array([[1.0]]))
    asked = [quadrotor.control(np.array([[u]]), plant.qpos, plant.qvel) for u in (1.0, -1.0)]
    assert max(a.max() for a in asked) == pytest.approx(high[0])


def test_its_mixer_gives_the_torques_that_are_asked_for(quadrotor):
    wanted = np.array([8.0, 0.1, -0.2, 0.03])
    thrust = quadrotor.rotors.mixer @ wanted
    arms = [
        quadrotor.model.site(n).pos
        for n in ("front_left", "back_left", "back_right", "front_right")
    ]
    torque = sum(np.cross(arm, [0, 0, f]) for arm, f in zip(arms, thrust, strict=True))
    twist = thrust @ quadrotor.model.actuator_gear[:, 5]
    np.testing.assert_allclose([thrust.sum(), *torque[:2], twist], wanted, atol=1e-12)


@pytest.fixture(scope="module")
def around_the_pillar(quadrotor):
    """One sample from starts all around the pillar, that touch it or do not."""
    x, y = np.meshgrid(np.linspace(2.2, 3.8, 33), np.linspace(-0.8, 0.8, 33))
    drift = np.resize([-1.2, -0.4, 0.4, 1.2], x.size)
    z0 = np.stack([x.ravel(), y.ravel(), drift], axis=1)
    begun = quadrotor.clearance(quadrotor.with_z(np.zeros((len(z0), 5)), z0)) <= 0
    return moved(quadrotor, Constant(0.0), z0[~begun], steps=1)


def test_a_collision_is_seen_at_the_next_sample(around_the_pillar):
    runs = around_the_pillar
    hit = np.abs(runs.path[1, :, 2] - runs.path[0, :, 2]) > 0.1
    assert hit.sum() > 20
    assert (runs.outcome[hit] == Outcome.CRASHED).all()


def test_a_collision_is_no_hop_of_the_closed_loop(quadrotor, around_the_pillar):
    runs = around_the_pillar
    assert np.abs(runs.path[1, :, 2] - runs.path[0, :, 2]).max() > 0.4
    grid = Grid(quadrotor.chart, (41, 41, 9))
    hop = longest_hop(quadrotor, Constant(1.2), grid)
    assert hop[2] < 0.1
    assert hop[:2] == pytest.approx([0.1, 0.06], abs=0.005)
