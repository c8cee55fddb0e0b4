"""Every registered task is whole and consistent; the paper's two have the paper's numbers."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj import BadInput, Outcome, Scene
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.tasks.unit_circle import UnitCircle

PI = np.pi


# ---- every task


def test_a_task_can_be_noisy_on_all_coordinates(vehicle, puck):
    for task in (vehicle, puck):
        before = task.noisy
        everywhere = task.noisy_everywhere()
        again = pickle.loads(pickle.dumps(everywhere))  # as a process of a pool gets it
        for noisy in (everywhere, again):
            assert noisy.noisy == (True,) * len(before)
            np.testing.assert_array_equal(
                noisy.noise_in_chart(0.1), task.noise_in_chart(0.1, everywhere=True)
            )
        assert task.noisy == before != everywhere.noisy
        assert pickle.loads(pickle.dumps(task)).noisy == before


def test_an_unknown_task_lists_the_known():
    with pytest.raises(BadInput, match=r"'vehicel'.*unit_circle, vehicle.*Did you mean 'vehicle'"):
        hyrl_mj.get_task("vehicel")


def test_a_task_says_what_it_is_in_one_line(circle, vehicle):
    assert repr(circle) == "<Task unit_circle: chart (theta), inputs (turn_rate)>"
    assert repr(vehicle) == "<Task vehicle: chart (x, y), inputs (lateral_velocity)>"


# ---- what a replay shows, and what trains a task


def test_a_scene_fills_in_what_is_left_out():
    scene = Scene(starts=((0.0,), (1.0,)), time=2.0, mode_names=("up", "down"))
    assert scene.policy_starts == scene.starts
    assert (scene.camera, scene.tracked) == ("overhead", "tracked")
    assert [scene.mode_name(q) for q in (0, 1, 2, -1)] == ["0 (up)", "1 (down)", "2", "-1"]
    assert replace(scene, policy_starts=((0.5,),)).policy_starts == ((0.5,),)


# ---- a reward that sees the input


class Thrifty(UnitCircle):
    """The unit circle, where turning costs."""

    def reward(self, measurement, u):
        return super().reward(measurement, u) - 0.1 * u[:, 0] ** 2


def test_the_reward_sees_the_input_of_the_step():
    task, u = Thrifty(), np.array([[-1.0], [0.0], [0.5]])
    env = BatchedEnv(task, 3)
    env.reset(z=np.full((3, 1), 2.0))
    result = env.step(u)
    expected = -np.abs(task.error(env.z)) / PI - 0.1 * u[:, 0] ** 2
    np.testing.assert_allclose(result.reward, expected, atol=1e-12)


def test_danger_is_by_default_the_reward_of_inputs_in_the_middle():
    theta = np.array([[0.0], [1.0], [PI]])
    np.testing.assert_allclose(Thrifty().danger(theta), [0.0, 1 / PI, 1.0], atol=1e-12)


# ---- unit circle


@pytest.mark.parametrize(
    ("theta", "reward"),
    [
        (0.0, 0.0),
        (PI, -1.0),
        (PI / 2, -0.5),
        (-PI / 2, -0.5),
        (2 * PI - 0.3, -0.3 / PI),
        (5 * PI, -1.0),
    ],
)
def test_circle_reward(circle, theta, reward):
    assert circle.reward(np.array([[theta]]), np.zeros((1, 1))) == pytest.approx(reward, abs=1e-12)


def test_circle_observation_is_the_point_on_the_circle(circle):
    expected = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]
    observation = circle.observation(np.array([[0.0], [PI / 2], [3 * PI]]))
    np.testing.assert_allclose(observation, expected, atol=1e-12)


def test_circle_verdict(circle):
    theta = np.array([[0.0], [0.3], [-0.3], [0.301], [PI], [2 * PI + 0.2]])
    labels = [Outcome(k).label for k in circle.verdict(theta)]
    assert labels == ["reached", "reached", "reached", "stalled", "stalled", "reached"]
    assert (circle.ending(theta) == Outcome.RUNNING).all()


def test_circle_direction(circle):
    path = np.array([[[3.0], [3.0], [0.2]], [[1.0], [5.0], [0.1]]])
    np.testing.assert_array_equal(circle.direction(path), [0, 1, -1])


# ---- vehicle


@pytest.mark.parametrize(
    ("z", "reward"),
    [
        ((0.0, 0.0), 0.4149818),
        ((3.0, 0.0), 3.4149818),
        ((1.5, 1.0), 1.4023447),
        ((0.0, 1.4), 0.2118604),
        ((1.5, 0.0), 0.3934490),
        ((0.75, 0.0), 0.0),
    ],
)
def test_vehicle_reward(vehicle, z, reward):
    assert vehicle.reward(np.array([z]), np.zeros((1, 1))) == pytest.approx(reward, abs=1e-6)


def test_vehicle_observation(vehicle):
    observation = vehicle.observation(np.array([[0.0, 0.0], [1.5, -1.0], [1.5, 0.2]]))
    far = np.hypot(1.5, 1.0), np.hypot(1.5, 0.2)
    expected = [[0.75, 3.0, 0.0], [0.25, far[0], -1.0], [0.0, far[1], 0.2]]
    np.testing.assert_allclose(observation, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("z", "outcome"),
    [
        ((0.0, 0.0), "running"),
        ((1.5, 0.752), "running"),
        ((1.5, 0.7505), "crashed"),
        ((1.5, 0.0), "crashed"),
        ((1.0, 1.5), "out_of_bounds"),
        ((1.0, -1.6), "out_of_bounds"),
        ((1.0, 1.4999), "running"),
        ((3.0, 0.0), "running"),
        ((3.001, 0.3), "reached"),
    ],
)
def test_vehicle_ending(vehicle, z, outcome):
    assert Outcome(vehicle.ending(np.array([z]))[0]).label == outcome


def test_vehicle_verdict_at_the_line(vehicle):
    labels = [Outcome(k).label for k in vehicle.verdict(np.array([[3.0, 0.1], [2.95, 0.1]]))]
    assert labels == ["reached", "running"]


def test_vehicle_levels(vehicle):
    np.testing.assert_array_equal(vehicle.input_levels[:, 0], [-1.0, -0.5, 0.0, 0.5, 1.0])


def test_vehicle_direction(vehicle):
    start = [[0.0, 0.1], [0.0, 0.1], [0.0, 0.0], [2.0, 1.0]]
    end = [[1.5, 0.9], [1.6, -0.9], [0.7, -0.1], [2.1, 1.0]]
    np.testing.assert_array_equal(vehicle.direction(np.array([start, end])), [0, 1, 1, -1])


@pytest.mark.parametrize(
    "z", [np.zeros((2, 9)), np.zeros((2, 2, 2)), [], "here", [[0.0], [0.0, 1.0]], [[0.0, np.nan]]]
)
def test_what_is_no_state_of_a_task_is_refused_by_its_name(vehicle, z):
    with pytest.raises(BadInput, match="vehicle"):
        vehicle.chart.check(z, vehicle.name)


@pytest.mark.parametrize("z", [(-0.1, 0.0), (3.1, 0.0), (0.0, 1.6), (1.0, -9.0)])
def test_vehicle_state_outside_the_arena(vehicle, z):
    with pytest.raises(BadInput, match=r"outside .*0 <= x <= 3 m, -1.5 <= y <= 1.5 m") as caught:
        vehicle.chart.check([(0.0, 0.0), z], vehicle.name)
    assert f"x = {z[0]:g} m, y = {z[1]:g} m" in str(caught.value)
    assert "state 1" in str(caught.value)


def test_the_unit_of_a_noise_bound_is_that_of_the_coordinates_it_acts_on_as_a_whole(vehicle):
    turned = vehicle.with_noise((57.3, 1.0))
    turned.chart = replace(vehicle.chart, units=("deg", "m"))
    assert turned.noise_on() == ("x and y", "m")
    assert turned.noise_text(0.1) == "5.73 deg on x, 0.1 m on y"
