"""The tests that every task must pass: import them into a test file with a fixture `task`, and run pytest."""

import numpy as np
import pytest

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_export import observation_space
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.tasks import Outcome, Task, check_task


def test_it_can_be_trained(task: Task) -> None:
    assert check_task(task) is task


def test_its_starts_lie_in_the_chart_and_repeat(task: Task) -> None:
    z = task.starts(2000, np.random.default_rng(0))
    assert z.shape == (2000, task.chart.dimension)
    np.testing.assert_array_equal(task.chart.check(z, task.name), z)
    np.testing.assert_array_equal(task.starts(2000, np.random.default_rng(0)), z)


def test_an_episode_stays_finite_and_its_observations_in_their_space(task: Task) -> None:
    rng, space = np.random.default_rng(0), observation_space(task)
    plant = task.placed(task.starts(32, rng), rng)
    for _ in range(task.max_steps):
        u = task.draw_inputs(32, rng)
        plant.step(u)
        outcome = task.outcome(plant.measurement, plant.unstable)
        running = outcome == Outcome.RUNNING
        observation = task.observation(plant.measurement[running])
        assert all(space.contains(o) for o in observation.astype(np.float32))
        reward = task.reward(plant.measurement, u)
        assert np.isfinite(reward).all()
        assert (reward[running] >= task.worst_reward).all(), "worse than worst_reward"


@pytest.mark.parametrize("threads", [1, 2])
def test_episodes_repeat_bit_for_bit_at_any_number_of_threads(task: Task, threads: int) -> None:
    def episode(threads: int) -> np.ndarray:
        rng, plant = np.random.default_rng(5), task.plant(8, threads)
        plant.set_state(*task.state(task.starts(8, rng), rng))
        for _ in range(min(task.max_steps, 20)):
            plant.step(task.draw_inputs(8, rng))
        return plant.state

    np.testing.assert_array_equal(episode(threads), episode(1))


def test_what_the_plant_returns_is_not_its_memory(task: Task) -> None:
    plant = task.placed(task.starts(2, np.random.default_rng(0)))
    returned = [plant.measurement, plant.qpos, plant.state, task.z(plant.measurement)]
    kept = [values.copy() for values in returned]
    plant.step(np.tile(task.input_limits[1], (2, 1)))
    for values, copy in zip(returned, kept, strict=True):
        np.testing.assert_array_equal(values, copy)
    after = plant.state
    for values in (plant.measurement, plant.qpos, plant.state):
        values[:] = 7.0
    np.testing.assert_array_equal(plant.state, after)


def test_chart_and_state_belong_together(task: Task) -> None:
    rng = np.random.default_rng(0)
    z, other = (task.chart.draw(100, rng) for _ in range(2))
    plant = task.placed(z)
    np.testing.assert_allclose(task.z(plant.measurement), z, atol=1e-9)
    np.testing.assert_allclose(task.z(task.with_z(plant.measurement, other)), other, atol=1e-9)


def test_an_observation_leads_back_to_its_measurement(task: Task) -> None:
    if type(task).measured is Task.measured:  # an error names the missing method
        with pytest.raises(BadInput, match="measured"):
            task.measured(np.zeros((1, len(task.observation_low))))
        return
    rng = np.random.default_rng(0)
    plant = task.placed(task.chart.draw(500, rng), rng)
    seen = task.observation(plant.measurement).astype(np.float32).astype(float)
    measured = task.measured(seen)
    off = task.chart.difference(task.z(measured), task.z(plant.measurement))
    assert (np.abs(off) <= 1e-5 * task.chart.sides).all(), "at another chart point"
    np.testing.assert_allclose(task.observation(measured), seen, rtol=1e-5, atol=1e-5)


def test_the_ways_that_runs_go_are_its_modes(task: Task) -> None:
    class Straight:
        def act(self, measured: np.ndarray) -> np.ndarray:
            return np.tile(np.mean(task.input_limits, axis=0), (len(measured), 1))

    z = task.starts(200, np.random.default_rng(0))
    loop, settings = PolicyController(Straight()), LoopSettings(quiet=True)
    way = task.direction(closed_loop(task, loop, z, settings=settings).path)
    assert way.shape == (200,)
    if task.gives_direction:
        assert set(way) <= {-1, *range(len(task.scene.mode_names))}
    else:
        assert all(task.mode_name(q) for q in set(way) - {-1})


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_refused(task: Task, value: float) -> None:
    z = np.array(task.scene.starts, dtype=float)
    z[-1, -1] = value
    with pytest.raises(BadInput, match=f"state {len(z) - 1}"):
        task.chart.check(z, task.name)
    measured = np.full((2, task.measurement_columns), value)
    with pytest.raises(BadInput, match=r"measurement\[0, 0\]"):
        task.check_measurement(measured)


@pytest.mark.parametrize(
    "z", [np.zeros((2, 9)), np.zeros((2, 2, 2)), [], "here", [[0.0], [0.0, 1.0]]]
)
def test_a_state_of_the_wrong_shape_names_the_task(task: Task, z: object) -> None:
    with pytest.raises(BadInput, match=task.name):
        task.chart.check(z, task.name)  # type: ignore[arg-type]
