"""The rover rolls on its wheels as its MJCF says, and decides in time or crashes."""

import mujoco
import numpy as np
import pytest
from experts import Constant, moved

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.tasks.trial import try_control


@pytest.fixture(scope="module")
def rover():
    return hyrl_mj.get_task("rover")


def test_it_stands_on_two_wheels_and_a_caster(rover):
    model, data = rover.model, mujoco.MjData(rover.model)
    qpos, _ = rover.state(np.zeros((1, 3)))
    data.qpos[:] = qpos[0]
    for _ in range(200):
        mujoco.mj_step(model, data)
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    touching = {model.geom(g).name for c in data.contact for g in c.geom if g != floor}
    assert touching == {"left_tyre", "right_tyre", "caster"}
    assert np.abs(data.qvel).max() < 0.02
    weight = model.body_mass.sum() * 9.81
    forces = np.zeros((data.ncon, 6))
    for i, force in enumerate(forces):
        mujoco.mj_contactForce(model, data, i, force)
    assert forces[:, 0].sum() == pytest.approx(weight, rel=0.02)


def test_wheels_that_are_asked_once_a_sample_turn_as_those_that_are_asked_at_every_step(rover):
    once, often = rover.plant(3), rover.plant(3)
    often._steady = False
    for plant in (once, often):
        plant.set_state(
            *rover.state(np.array([[0.0, 0.1, 0.2], [0.5, 0.0, 0.0], [1.0, -0.3, -0.4]]))
        )
        for u in (1.0, -1.0, 0.3):
            plant.step(np.full((3, 1), u))
    np.testing.assert_array_equal(once.measurement, often.measurement)


def test_wheels_that_depend_on_the_state_are_asked_at_every_step(rover):
    class Slipping(type(rover)):
        def control(self, u, qpos, qvel):
            return super().control(u, qpos, qvel) * (1 - 0.1 * qvel[:, :1])

    with pytest.raises(hyrl_mj.BadInput, match=r"steady_control .* other controls"):
        try_control(Slipping())


def test_it_drives_straight_at_its_speed(rover):
    path = moved(rover, Constant(0.0), [[0.0, 1.0, 0.0]], steps=40).path[:, 0]
    assert path[-1, 0] == pytest.approx(2.0, abs=0.1)
    np.testing.assert_allclose(path[:, 1:], [[1.0, 0.0]] * len(path), atol=5e-3)


@pytest.mark.parametrize("u", [-1.2, 0.6])
def test_it_turns_at_the_rate_that_is_asked_for(rover, u):
    heading = moved(rover, Constant(u), [[0.0, 0.0, 0.0]], steps=10).path[:, 0, 2]
    assert (heading[10] - heading[4]) / 0.3 == pytest.approx(u, rel=0.15)
    # It takes a while: what has inertia does not jump.
    assert abs(heading[1]) < 0.8 * abs(u) * 0.05


def test_what_touches_the_pillar_has_crashed(rover):
    rollout = moved(rover, Constant(0.0), [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert rollout.outcome.tolist() == [Outcome.CRASHED, Outcome.REACHED]
    plant = rover.plant(1)
    plant.set_state(*rover.state(np.array([[1.5, 0.0, 0.0]])))
    while rover.ending(plant.measurement) == Outcome.RUNNING:
        plant.step(np.zeros((1, 1)))
    x = plant.measurement[0, 0]
    assert x == pytest.approx(2.3 - 0.45 - 0.16 + 0.035, abs=0.06)


def test_its_start_states_move_at_the_speed_of_its_wheels(rover):
    _, qvel = rover.state(np.array([[0.1, 0.2, 0.3]]), np.random.default_rng(0))
    speed = np.hypot(*qvel[0, :2])
    assert speed == pytest.approx(rover.speed)
    radius, half = rover.wheels.radius, rover.wheels.half
    left, right = qvel[0, 6:]
    assert (left + right) / 2 * radius == pytest.approx(speed)
    assert (right - left) * radius / (2 * half) == pytest.approx(qvel[0, 5])
    assert qvel[0, 5] != 0


def test_a_detour_earns_less_than_the_goal(rover):
    at = rover.set_point[0]
    measured = np.zeros((4, 5))
    measured[:, 0] = at, at - 0.5, at - 0.5, at
    measured[2, 2], measured[3, 1] = 0.8, 0.8
    goal, ahead, turned, off = rover.reward(measured, np.zeros((4, 1)))
    # What to go on for ever is worth to the policies of the modes, whose discount factor is 0.9.
    assert goal >= ahead / (1 - 0.9) - 1e-9 > turned / (1 - 0.9)
    assert off < goal
