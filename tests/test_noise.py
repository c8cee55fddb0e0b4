"""Noise is bounded, seeded, and refuses bounds that are none."""

import numpy as np
import pytest

from hyrl_mj import BadInput, Noise


def signal(noise, seed=0, n=1000, columns=2):
    rng = np.random.default_rng(seed)
    return np.stack([noise.sample(np.full(n, k), columns, rng) for k in range(20)])


def test_no_noise_is_zero():
    np.testing.assert_array_equal(signal(Noise()), 0.0)


def test_uniform_noise_fills_its_bounds_and_no_more():
    values = signal(Noise("uniform", 0.1))
    assert values.shape == (20, 1000, 2)
    assert 0.0999 < values.max() <= 0.1
    assert -0.1 <= values.min() < -0.0999
    assert abs(values.mean()) < 2e-3
    assert values.std() == pytest.approx(0.1 / np.sqrt(3), rel=0.02)


def test_alternating_noise_starts_positive_and_changes_sign_at_every_sample():
    values = signal(Noise("alternating", 0.1))
    np.testing.assert_array_equal(values[::2], 0.1)
    np.testing.assert_array_equal(values[1::2], -0.1)


def test_alternating_noise_goes_by_the_sample_of_each_simulation():
    values = Noise("alternating", 0.3).sample(np.array([0, 1, 2, 7]), 1, np.random.default_rng())
    np.testing.assert_array_equal(values[:, 0], [0.3, -0.3, 0.3, -0.3])


@pytest.mark.parametrize("kind", ["uniform", "alternating"])
def test_the_seed_fixes_the_signal(kind):
    noise = Noise(kind, 0.2)
    np.testing.assert_array_equal(signal(noise, 7), signal(noise, 7))


def test_another_seed_gives_another_signal():
    noise = Noise("uniform", 0.2)
    assert (signal(noise, 7) != signal(noise, 8)).mean() > 0.99


@pytest.mark.parametrize("bound", [0, 0.0, 1, 0.25, np.float64(0.25)])
def test_bounds_that_can_be_used(bound):
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
