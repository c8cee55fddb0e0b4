"""A planted policy is copied into a network that answers as it does, and that training can go on from."""

from dataclasses import replace

import numpy as np
import pytest
from planted import homing_policy, one_way_policy

from hyrl_mj.learning import distillation
from hyrl_mj.learning.distillation import distil, fits
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.training import build, export


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Fewer states and steps than in a run: the planted policies are simple."""
    monkeypatch.setattr(distillation, "STATES", 2_048)
    monkeypatch.setattr(distillation, "STEPS", 400)


def settings_of(task, algorithm="ppo"):
    """Settings of stage 6 that a network is distilled for."""
    return replace(preset(task, "smoke").stage6, algorithm=algorithm, options={}, hidden=(32, 32))


@pytest.mark.slow
def test_a_copy_gives_the_continuous_inputs_of_the_original(circle):
    policy = homing_policy(circle)
    copy = distil(circle, policy, circle.starts, settings_of(circle, "a2c"), seed=0)
    assert copy.algorithm == "a2c"
    z = np.r_[np.linspace(0.3, 2.8, 40), np.linspace(3.5, 6.0, 40)][:, None]
    np.testing.assert_allclose(copy.act(z), policy.act(z), atol=0.3)


@pytest.mark.slow
def test_a_copy_chooses_the_levels_of_the_original(vehicle):
    policy = one_way_policy(vehicle, side=1.0, clear=0.3)
    copy = distil(vehicle, policy, vehicle.starts, settings_of(vehicle), seed=0)
    z = vehicle.starts(500, np.random.default_rng(1))
    clear = np.abs(z[:, 1] - 0.3) > 0.1
    assert (copy.act(z) == policy.act(z))[clear].mean() > 0.97
    assert set(np.unique(copy.act(z))) <= set(vehicle.input_levels[:, 0])


@pytest.mark.slow
def test_it_is_copied_at_the_starts_that_it_is_given(circle):
    """Where no state was seen nothing is known: a copy of one half is right on that half."""

    def upper_half(n, rng):
        return rng.uniform(0.3, 2.8, (n, 1))

    copy = distil(circle, homing_policy(circle), upper_half, settings_of(circle), seed=0)
    assert (copy.act(np.linspace(0.3, 2.8, 40)[:, None]) < -0.5).all()


def test_the_seed_fixes_the_copy(circle, monkeypatch):
    monkeypatch.setattr(distillation, "STEPS", 20)
    copies = [
        distil(circle, homing_policy(circle), circle.starts, settings_of(circle), seed)
        for seed in (0, 0, 1)
    ]
    for name, weight in copies[0].weights.items():
        np.testing.assert_array_equal(copies[1].weights[name], weight)
    assert any((copies[2].weights[name] != w).any() for name, w in copies[0].weights.items())


def test_training_goes_on_from_weights_of_its_own_algorithm_only(vehicle):
    settings = settings_of(vehicle)
    policy = export(build(vehicle, settings, seed=0), vehicle)
    assert fits(vehicle, settings, policy)
    assert fits(vehicle, replace(settings, hidden=(16, 16)), policy), "its own layers are kept"
    assert not fits(vehicle, replace(settings, algorithm="dqn", options={}), policy)
