"""A new kind of noise is one class: defined here, it works wherever noise does, memory and all."""

import gymnasium as gym
import numpy as np
import pytest
from planted import decisions, ideal_controller, sign_policy

from hyrl_mj import BadInput, Noise, Signal, register_noise, simulate
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.judging.episodes import Regions, noisy_episodes
from hyrl_mj.simulation import noise_of
from hyrl_mj.simulation.noise import _KINDS

PACE = 0.1


@pytest.fixture(scope="module", autouse=True)
def drift():
    """A sensor that drifts: from sample to sample a tenth of the bound more, up to the bound."""

    @register_noise
    class Drift(Signal):
        kind = "climb"

        def reset(self, n, rng):
            super().reset(n, rng)
            self.offset = np.zeros((n, len(self.shares)))

        def sample(self, now):
            begins = (now.k == 0)[:, None]
            offset = np.where(begins, 0.0, self.offset[now.rows] + PACE * self.bound)
            self.offset[now.rows] = np.minimum(offset, self.bound)
            return self.offset[now.rows] * self.shares

    yield Drift
    del _KINDS["climb"]


def drifted(k, bound=0.1):
    """The offset of sample k since the run began."""
    return bound * np.minimum(PACE * np.asarray(k), 1.0)


def test_it_works_in_simulate(vehicle):
    z0 = np.array([[0.0, 0.5], [0.3, -0.5]])
    for arc in simulate(vehicle, sign_policy(vehicle), z0, Noise("climb", 0.1)):
        assert (arc.noise, arc.bound) == ("climb", 0.1)
        off = (arc.measured - arc.z)[:-1]
        np.testing.assert_allclose(off[:, 0], 0.0, atol=1e-9)
        np.testing.assert_allclose(off[:, 1], drifted(np.arange(len(off))), atol=1e-9)
    assert len(off) > 20


def test_it_acts_everywhere_if_asked_to(vehicle):
    arc = simulate(vehicle, sign_policy(vehicle), [0.0, 0.5], Noise("climb", 0.1, everywhere=True))
    np.testing.assert_allclose((arc.measured - arc.z)[15], [0.1, 0.1], atol=1e-9)


def test_loops_do_not_share_its_memory(vehicle, drift):
    signal = drift(0.1, np.array([0.0, 1.0]))
    one, other = signal.against(vehicle, None), signal.against(vehicle, None)
    one.reset(2, np.random.default_rng(0))
    other.reset(3, np.random.default_rng(0))
    assert (len(one.offset), len(other.offset)) == (2, 3)
    # A signal that has no name is noise, too.
    assert simulate(vehicle, sign_policy(vehicle), [0.0, 0.5], signal).noise == "climb"


def test_it_works_in_noisy_episodes(vehicle):
    loops = {"ideal": ideal_controller(vehicle, 0.154, clear=1.004)}
    noises = (Noise("climb", 0.1), Noise("uniform", 0.1))
    records = noisy_episodes(vehicle, Regions(decisions(vehicle).points), loops, noises, 10).counts
    assert {r.noise for r in records} == {"climb", "uniform"}
    assert sum(r.episodes for r in records if r.noise == "climb") == 10


def test_episodes_that_reset_at_different_times_restart_their_rows(vehicle):
    env = BatchedEnv(vehicle, 3, noise=Noise("climb", 0.1))
    env.seed(0)
    still, age = np.zeros((3, 1)), np.zeros(3, dtype=int)

    def off(observation):
        return observation[:, 2] - env.z[:, 1]

    env.reset(z=np.full((3, 2), [0.0, 0.5]))
    resets = {4: [1], 7: [0, 2], 9: [2]}
    for k in range(15):
        result, age = env.step(still), age + 1
        np.testing.assert_allclose(off(result.observation), drifted(age), atol=1e-6)
        if k in resets:
            ids = np.array(resets[k])
            age[ids] = 0
            first = env.reset(ids, z=np.full((len(ids), 2), [0.0, 0.5]))
            np.testing.assert_allclose(first[:, 2], 0.5, atol=1e-6)
    assert age.tolist() == [7, 10, 5]


def test_it_works_in_gymnasium(vehicle):
    noise = Noise("climb", 0.1)
    env = gym.make(vehicle.env_id, noise=noise)
    for _ in range(2):  # a new episode starts over
        observation, info = env.reset(seed=0, options={"z": [0.0, 0.5]})
        for k in range(12):
            assert observation[2] - info["z"][1] == pytest.approx(drifted(k), abs=1e-6)
            observation, *_, info = env.step(2)
    many = gym.make_vec(
        vehicle.env_id, num_envs=8, noise=noise, vectorization_mode="vector_entry_point"
    )
    many.reset(seed=0)
    ages, age = set(), np.zeros(8, dtype=int)
    for _ in range(150):
        observation, _, terminated, truncated, info = many.step(many.action_space.sample())
        age = np.where(terminated | truncated, 0, age + 1)
        ages.add(len(set(age)))
        np.testing.assert_allclose(observation[:, 2] - info["z"][:, 1], drifted(age), atol=1e-6)
    assert max(ages) > 2, "episodes began at different times"


def test_its_name_works_where_noise_is_named(vehicle):
    assert noise_of(vehicle, "climb", 0.1) == Noise("climb", 0.1)
    with pytest.raises(BadInput, match="Did you mean 'drift'"):
        noise_of(vehicle, "drifting", 0.1)


def test_a_kind_is_registered_once(drift):
    assert register_noise(drift) is drift, "again is no mistake: a file may be run twice"
    with pytest.raises(BadInput, match=r"'climb' is already .*Drift, so choose another kind"):

        @register_noise
        class Other(Signal):
            kind = "climb"

            def sample(self, now):
                return np.zeros_like(now.measurement)
