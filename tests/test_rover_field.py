"""The rover among posts: its wheels follow speed and turn rate, and posts are where it measures them."""

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj.fields import Driving
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.simulation.rollout import LoopSettings, closed_loop
from hyrl_mj.tasks import Layouts, Outcome, length

# Far from all posts of the usual layout.
FREE = np.array([[-4.0, 3.0, 0.3]])


@pytest.fixture(scope="module")
def rover():
    return hyrl_mj.get_task("rover_field")


def poses(task, z, inputs, samples):
    """Returns poses x, y, heading (samples + 1, n, 3) under constant inputs (2,)."""
    plant = task.plant(len(z))
    plant.set_state(*task.state(np.asarray(z)))
    path = [plant.measurement[:, :3]]
    for _ in range(samples):
        plant.step(np.tile(inputs, (len(z), 1)))
        path.append(plant.measurement[:, :3])
    return np.array(path)


@pytest.mark.parametrize("speed", [-1.0, -0.5, 0.5, 1.0])
def test_it_reaches_the_speed_that_is_asked_for(rover, speed):
    path = poses(rover, FREE, (speed, 0.0), 30)[:, 0]
    course = np.array([np.cos(path[0, 2]), np.sin(path[0, 2])])
    speeds = np.diff(path[:, :2] @ course) / rover.dt
    np.testing.assert_allclose(speeds[-10:], speed, rtol=0.03)
    # It takes a while: what has inertia does not jump.
    assert abs(speeds[0]) < 0.3 * abs(speed)
    np.testing.assert_allclose(path[:, 2], path[0, 2], atol=1e-3)


@pytest.mark.parametrize("speed", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("rate", [-1.0, 0.5, 1.0])
def test_it_turns_at_the_rate_that_is_asked_for(rover, speed, rate):
    heading = np.unwrap(poses(rover, FREE, (speed, rate), 30)[:, 0, 2])
    assert (heading[-1] - heading[10]) / (20 * rover.dt) == pytest.approx(rate, rel=0.1)
    assert abs(heading[1] - heading[0]) < 0.8 * abs(rate) * rover.dt


def test_no_sequence_of_inputs_tips_it_over(rover):
    n, rng, low, high = 200, np.random.default_rng(0), *rover.input_limits
    plant = rover.plant(n)
    plant.set_state(*rover.state(rover.starts(n, rng)))
    for k in range(100):
        if k % 7 == 0:
            u = np.where(rng.random((n, 2)) < 0.5, low, high)
        plant.step(u)
        upright = 1 - 2 * (plant.qpos[:, 4:6] ** 2).sum(axis=1)
        assert (upright > np.cos(np.radians(6))).all()


def test_its_pose_is_that_of_the_middle_of_its_bumper(rover):
    plant = rover.plant(20)
    plant.set_state(*rover.state(rover.starts(20, np.random.default_rng(0))))
    bumper = plant.model.geom("bumper").id
    for _ in range(5):
        plant.step(np.tile([[1.0, 1.0]], (20, 1)))
    seen = plant.geom_positions([bumper])[:, 0, :2]
    np.testing.assert_allclose(seen, plant.measurement[:, :2], atol=2e-3)


class Ahead:
    """Drives straight ahead."""

    def act(self, measured):
        return np.tile([1.0, 0.0], (len(measured), 1))


def test_it_drives_through_a_field_of_several_posts(rover):
    places = np.array([[-2.0, 2.0], [0.0, -1.0], [2.0, 2.5]])
    tracks = np.stack([places, places - [0.0, 1.0]])[None, :, :]
    layouts = Layouts(tracks, np.array([[0.3, 0.5, 0.9]]), np.array([[4.0, 0.0]]), interval=4.0)
    starts = np.array([[-4.0, 0.0, 0.0], [-4.0, 1.5, 0.0]])
    task = Driving(rover, layouts, starts=starts)
    posts = [f"obstacle{k}" for k in ("", "_1", "_2")]
    assert [task.model.geom(name).size[0] for name in posts] == [0.3, 0.5, 0.9]
    plant = task.plant(2)
    plant.set_state(*task.state(starts))
    np.testing.assert_allclose(plant.measurement[:, :3], starts, atol=1e-12)
    for _ in range(20):
        plant.step(np.tile([[1.0, 0.0]], (2, 1)))
    seen = plant.measurement
    known = seen[:, 5:].reshape(2, 3, 5)
    np.testing.assert_allclose(known[0, :, :2], places - [0.0, 0.25], atol=1e-5)
    ids = [task.model.geom(name).id for name in posts]
    np.testing.assert_allclose(plant.geom_positions(ids)[..., :2], known[..., :2], atol=1e-6)
    away = length(known[..., :2] - seen[:, None, :2])
    np.testing.assert_allclose(task.clearances(seen), away - [0.3, 0.5, 0.9] - 0.16)
    settings = LoopSettings(quiet=True)
    run = closed_loop(task, PolicyController(Ahead()), starts, settings=settings)
    assert run.outcome.tolist() == [Outcome.REACHED, Outcome.CRASHED]
