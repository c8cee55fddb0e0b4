"""The tests that every task must pass: import them into a test file with a fixture `task`, and run pytest."""

import numpy as np
import pytest

from hyrl_mj.errors import BadInput
from hyrl_mj.tasks import Task, check_task


def test_it_can_be_trained(task: Task) -> None:
    assert check_task(task) is task


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
    for values, before in zip(returned, kept, strict=True):
        np.testing.assert_array_equal(values, before)
    after = plant.state
    for values in (plant.measurement, plant.qpos, plant.state):
        values[:] = 7.0
    np.testing.assert_array_equal(plant.state, after)


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
