"""Noise is bounded, seeded, and refuses bounds that are none."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from planted import sign_policy

from hyrl_mj import BadInput, Noise, Outcome, Recorded, Sample
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.simulation.rollout import LoopSettings, closed_loop


def draw(signal, k, columns=2):
    """The noise (n, p) of a signal on samples k (n,) of as many simulations."""
    n = len(k)
    return signal.sample(Sample(np.arange(n), k, np.zeros((n, columns)), np.zeros(n, int), None))


@pytest.fixture
def signal(vehicle):
    """Makes 20 samples of noise on every column of 1000 simulations: (20, 1000, 2)."""

    def samples(noise, seed=0, n=1000):
        found = replace(noise, everywhere=True).against(vehicle, None)
        found.reset(n, np.random.default_rng(seed))
        return np.stack([draw(found, np.full(n, k)) for k in range(20)])

    return samples


def test_no_noise_is_zero(signal):
    np.testing.assert_array_equal(signal(Noise()), 0.0)


def test_uniform_noise_fills_its_bounds_and_no_more(signal):
    values = signal(Noise("uniform", 0.1))
    assert values.shape == (20, 1000, 2)
    assert 0.0999 < values.max() <= 0.1
    assert -0.1 <= values.min() < -0.0999
    assert abs(values.mean()) < 2e-3
    assert values.std() == pytest.approx(0.1 / np.sqrt(3), rel=0.02)


def test_alternating_noise_starts_positive_and_changes_sign_at_every_sample(signal):
    values = signal(Noise("alternating", 0.1))
    np.testing.assert_array_equal(values[::2], 0.1)
    np.testing.assert_array_equal(values[1::2], -0.1)


def test_alternating_noise_goes_by_the_sample_of_each_simulation(circle):
    values = draw(Noise("alternating", 0.3).against(circle, None), np.array([0, 1, 2, 7]), 1)
    np.testing.assert_array_equal(values[:, 0], [0.3, -0.3, 0.3, -0.3])


@pytest.mark.parametrize("kind", ["uniform", "alternating"])
def test_the_seed_fixes_the_signal(kind, signal):
    noise = Noise(kind, 0.2)
    np.testing.assert_array_equal(signal(noise, 7), signal(noise, 7))


def test_another_seed_gives_another_signal(signal):
    noise = Noise("uniform", 0.2)
    assert (signal(noise, 7) != signal(noise, 8)).mean() > 0.99


@pytest.mark.parametrize("bound", [0, 0.0, 1, 0.25, np.float64(0.25)])
def test_bounds_that_can_be_used(bound, signal):
    assert np.abs(signal(Noise("uniform", bound))).max() <= bound


@pytest.mark.parametrize("bound", [-0.1, float("nan"), float("inf"), "0.1", None])
def test_bad_bounds_are_named(bound):
    with pytest.raises(BadInput, match="finite number >= 0") as caught:
        Noise("uniform", bound)
    assert repr(bound) in str(caught.value)


def test_an_unknown_kind_lists_the_known():
    with pytest.raises(BadInput, match=r"'gaussian'.*none, uniform, alternating"):
        Noise("gaussian", 0.1)


def test_a_misspelt_kind_gets_a_hint():
    with pytest.raises(BadInput, match=r"Did you mean 'alternating'\?"):
        Noise("alternate", 0.1)


# ---- signals that are given, and noise that looks at the loop


def test_a_recorded_signal_is_repeated_and_then_over():
    values = np.arange(12.0).reshape(3, 2, 2)
    signal = Recorded(values, 11.0)
    signal.reset(2, np.random.default_rng(0))
    for k in range(3):
        np.testing.assert_array_equal(draw(signal, np.full(2, k)), values[k])
    np.testing.assert_array_equal(draw(signal, np.full(2, 3)), np.zeros((2, 2)))


def test_a_recorded_signal_of_other_runs_is_refused():
    signal = Recorded(np.zeros((3, 2, 2)), 0.0)
    with pytest.raises(BadInput, match="does not fit 3 simulations"):
        signal.reset(3, np.random.default_rng(0))
    with pytest.raises(BadInput, match="does not fit 1 columns"):
        draw(signal, np.zeros(2, dtype=int), columns=1)


def test_noise_against_a_controller_makes_no_sense_in_an_environment(vehicle):
    refused = "adversarial noise needs a controller"
    with pytest.raises(BadInput, match=refused):
        Noise("adversarial", 0.1).against(vehicle, None)
    with pytest.raises(BadInput, match=refused) as caught:
        gym.make(vehicle.env_id, noise=Noise("adversarial", 0.1))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("noise", ["uniform", 0.1])
def test_what_is_no_noise_gets_an_example(vehicle, noise):
    with pytest.raises(BadInput, match=r'cannot be used: give a hyrl_mj.Noise\("uniform", 0.1\)'):
        closed_loop(vehicle, PolicyController(sign_policy(vehicle)), np.zeros((1, 2)), noise)
    with pytest.raises(BadInput, match="cannot be used: give a"):
        gym.make(vehicle.env_id, noise=noise)


@pytest.mark.parametrize("bound", [1.5, 100.0])
def test_noise_that_hides_the_whole_chart_is_refused(vehicle, bound):
    with pytest.raises(BadInput, match=r"hides the whole state space of vehicle: .* below 1\.5 m"):
        vehicle.check_noise(bound)
    assert vehicle.check_noise(1.4) == 1.4


def test_adversarial_noise_leads_to_the_greater_danger(vehicle):
    """Just off the axis the sign rule would steer away; noise towards the axis keeps it there."""
    policy, z0 = sign_policy(vehicle), np.array([[0.0, 0.02], [0.0, -0.02], [0.0, 0.9]])
    loop = PolicyController(policy)
    rollout = closed_loop(vehicle, loop, z0, noise=Noise("adversarial", 0.1))
    assert [Outcome(o).label for o in rollout.outcome] == ["crashed", "crashed", "reached"]
    quiet = closed_loop(vehicle, loop, z0)
    assert (quiet.outcome == Outcome.REACHED).all()


def test_adversarial_noise_keeps_to_its_bound_and_columns(vehicle):
    z0 = np.random.default_rng(0).uniform([0, -1], [0.5, 1], (50, 2))
    # A side that depends on both coordinates.
    loop = PolicyController(sign_policy(vehicle, line=lambda x: x - 0.25))
    for everywhere in (False, True):
        noise = Noise("adversarial", 0.1, everywhere)
        rollout = closed_loop(vehicle, loop, z0, noise, settings=LoopSettings(steps=5, record=True))
        added = rollout.measured - rollout.path[:-1]
        assert np.abs(added).max() == pytest.approx(0.1)
        assert (np.abs(added[..., 0]).max() > 0) == everywhere
