"""Noise is bounded, seeded, and refuses bounds that are none."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from planted import decisions, ideal_controller, sign_policy

from hyrl_mj import BadInput, Noise, Outcome, Recorded, Sample, Signal, register_noise, simulate
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.judging.episodes import Regions, noisy_episodes
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.simulation import noise_of
from hyrl_mj.simulation.noise import _KINDS
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


def test_uniform_noise_fills_its_bounds_and_no_more(signal):
    values = signal(Noise("uniform", 0.1))
    assert values.shape == (20, 1000, 2)
    assert 0.0999 < values.max() <= 0.1
    assert -0.1 <= values.min() < -0.0999
    assert abs(values.mean()) < 2e-3
    assert values.std() == pytest.approx(0.1 / np.sqrt(3), rel=0.02)


def test_alternating_noise_goes_by_the_sample_of_each_simulation(circle):
    values = draw(Noise("alternating", 0.3).against(circle, None), np.array([0, 1, 2, 7]), 1)
    np.testing.assert_array_equal(values[:, 0], [0.3, -0.3, 0.3, -0.3])


def test_the_seed_decides_the_signal(signal):
    noise = Noise("uniform", 0.2)
    np.testing.assert_array_equal(signal(noise, 7), signal(noise, 7))
    assert (signal(noise, 7) != signal(noise, 8)).mean() > 0.99
    np.testing.assert_array_equal(signal(Noise("uniform", 0)), 0.0)


@pytest.mark.parametrize("bound", [-0.1, float("nan"), "0.1"])
def test_bad_bounds_are_named(bound):
    with pytest.raises(BadInput, match="finite number >= 0") as caught:
        Noise("uniform", bound)
    assert repr(bound) in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("worst", "found first.*--noise worst"),
        ("attack", "found first.*--noise attack"),
        ("pink", "'pink'.*none, uniform, alternating"),
        ("alternate", r"Did you mean 'alternating'\?"),
    ],
)
def test_what_is_no_kind_is_told(kind, says):
    with pytest.raises(BadInput, match=says):
        Noise(kind, 0.1)


# ---- signals that are given, and noise that looks at the loop


def test_a_recorded_signal_is_played_as_it_is():
    values = np.arange(12.0).reshape(3, 2, 2)
    signal = Recorded(values, 11.0)
    signal.reset(2, np.random.default_rng(0))
    for k in range(3):
        np.testing.assert_array_equal(draw(signal, np.full(2, k)), values[k])


def test_a_recorded_signal_that_ends_says_so_or_goes_on_as_it_is_told(vehicle):
    values = np.zeros((3, 1, 2))
    values[:, 0, 1] = 0.01, 0.02, 0.03
    for after, expected in (("hold", 0.03), ("repeat", 0.02), ("none", 0.0)):
        signal = Recorded(values, 0.03, after=after)
        assert draw(signal, np.array([4]))[0].tolist() == [0.0, expected]
    loop, z0 = PolicyController(sign_policy(vehicle)), np.array([[0.0, 0.5]])
    with pytest.raises(BadInput, match=r'recorded for 3 samples.*after="hold", "repeat" or "none"'):
        closed_loop(vehicle, loop, z0, Recorded(values, 0.03))
    closed_loop(vehicle, loop, z0, Recorded(values, 0.03), settings=LoopSettings(steps=3))
    with pytest.raises(BadInput, match="'loop': choose one of refuse, hold, repeat, none"):
        Recorded(values, 0.03, after="loop")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((3, 2)), r"shape \(3, 2\) cannot be used: give numbers of shape \(samples, sim"),
        (np.zeros((0, 1, 2)), r"shape \(0, 1, 2\) cannot be used"),
        (np.array([[["a"]]]), "type <U1"),
        (np.array([[[0.0, np.nan]]]), "is nan at sample 0 of simulation 0 in column 1"),
        (np.array([[[0.0, 0.1]], [[-0.2, 0.0]]]), r"is -0\.2 at sample 1 .* at most 0\.1 in magn"),
    ],
)
def test_a_record_that_is_no_noise_of_its_bound_is_refused(values, message):
    with pytest.raises(BadInput, match=message):
        Recorded(values, 0.1)


def kind_of(sample, **methods):
    """A class of signals with a method `sample(self, now)`."""
    return type("Given", (Signal,), {"kind": "given", "sample": sample, **methods})


def gaussian(self, now):
    return self.rng.normal(scale=self.bound, size=now.measurement.shape) * self.shares


def moving(self, now):
    now.measurement[:] += 0.05
    return np.zeros_like(now.measurement)


def jumping(self, now):
    now.q[:] = 0
    return np.zeros_like(now.measurement)


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        (gaussian, r"in column 1 of the measurement, where at most 0\.1 in magnitude is allowed"),
        (lambda self, now: np.full(now.measurement.shape, 0.1), "in column 0 .* where none is"),
        (
            lambda self, now: np.full(len(now.rows), 0.1),
            r"float64 of shape \(60,\), where \(60, 2\)",
        ),
        (lambda self, now: None, r"gives a NoneType of shape \(\)"),
        (lambda self, now: np.zeros(now.measurement.shape, int), "gives int64 of shape"),
        (lambda self, now: now.measurement * np.nan, "noise is nan at sample 0 of simulation 0"),
        (lambda self, now: np.where(now.k[:, None] > 9, 1.0, [0, 0.1]), "is 1 at sample 10 of"),
        (lambda self, now: 1 / 0, "it raised ZeroDivisionError"),
        (moving, "writes to an array that it is shown"),
        (jumping, "writes to an array that it is shown"),
    ],
)
def test_each_sample_of_a_noise_is_checked(sample, message, vehicle, monkeypatch):
    monkeypatch.setitem(_KINDS, "given", kind_of(sample))
    loop, z0 = PolicyController(sign_policy(vehicle)), np.tile([0.0, 0.5], (60, 1))
    with pytest.raises(BadInput, match=message) as caught:
        closed_loop(vehicle, loop, z0, Noise("given", 0.1))
    assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(BadInput, match=message.replace("60", "1")):  # also where an agent acts
        _episodes(gym.make(vehicle.env_id, noise=Noise("given", 0.1)))


def _episodes(env):
    for seed in range(5):
        env.reset(seed=seed)
        for _ in range(15):
            env.step(2)


def wider(self, bound, shares):
    Signal.__init__(self, 3 * bound, shares)


@pytest.mark.parametrize(
    ("init", "message"),
    [
        (wider, r"takes \[.* 0\.3\] .* is allowed \[.* 0\.1\]"),
        (lambda self, bound, shares: None, r"has no bound and shares: call super\(\).__init__"),
    ],
)
def test_a_kind_that_does_not_keep_its_bound_is_refused(init, message, vehicle, monkeypatch):
    monkeypatch.setitem(_KINDS, "given", kind_of(gaussian, __init__=init))
    with pytest.raises(BadInput, match=message):
        Noise("given", 0.1).against(vehicle, None)


def remembers_anew(self, now):
    self.made.append(1)
    return np.full(now.measurement.shape, self.bound * np.sin(len(self.made))) * self.shares


def draws_anew(self, now):
    return self.made.uniform(-self.bound, self.bound, now.measurement.shape) * self.shares


@pytest.mark.parametrize(
    ("sample", "made"), [(remembers_anew, list), (draws_anew, np.random.default_rng)]
)
def test_what_reset_does_not_begin_anew_is_refused(sample, made, vehicle, monkeypatch):
    """Else the second loop of a seed would have other noise than the first."""

    def init(self, bound, shares):
        Signal.__init__(self, bound, shares)
        self.made = made()

    kind = kind_of(sample, __init__=init)
    monkeypatch.setitem(_KINDS, "given", kind)
    loop, z0 = PolicyController(sign_policy(vehicle)), np.array([[0.0, 0.5]])
    for noise in (Noise("given", 0.1), kind(0.1, np.array([0.0, 1.0]))):
        with pytest.raises(BadInput, match="other values where it begins anew with the same seed"):
            closed_loop(vehicle, loop, z0, noise)
        with pytest.raises(BadInput, match="other values where it begins anew with the same seed"):
            gym.make(vehicle.env_id, noise=noise)


def test_what_a_signal_lacks_is_a_sentence(vehicle):
    loop, z0 = PolicyController(sign_policy(vehicle)), np.array([[0.0, 0.5]])
    for shares, bound in (([1.0], 0.1), ([0.0, 1.0], np.nan), ([0.0, 1.0], -0.1)):
        signal = kind_of(gaussian)(bound, np.array(shares))
        with pytest.raises(BadInput, match=r"a share for each of the columns .* vehicle has 2"):
            closed_loop(vehicle, loop, z0, signal)
    broken = kind_of(gaussian, reset=lambda self, n, rng: 1 / 0)(0.1, np.array([0.0, 1.0]))
    with pytest.raises(BadInput, match=r"its reset\(\) raised ZeroDivisionError"):
        closed_loop(vehicle, loop, z0, broken)
    for kind in ("two words", "", "a+b", 5, Signal.kind):
        with pytest.raises(BadInput, match="give it a kind of one word"):
            register_noise(type("Given", (Signal,), {"kind": kind}))


def test_a_record_keeps_what_it_was_given():
    values = np.full((2, 1, 2), 0.1)
    record = Recorded(values, 0.1)
    values[:] = -0.1
    assert (record.values == 0.1).all()


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


@pytest.mark.parametrize("noise", ["uniform", 0.1, True, np.nan, [0.1]])
def test_what_is_no_noise_gets_an_example(vehicle, noise):
    loop, z = PolicyController(sign_policy(vehicle)), np.zeros((1, 2))
    for use in (
        lambda: closed_loop(vehicle, loop, z, noise),
        lambda: gym.make(vehicle.env_id, noise=noise),
        lambda: gym.make_vec(vehicle.env_id, 2, "vector_entry_point", noise=noise),
    ):
        with pytest.raises(BadInput, match=r'cannot be used: give a hyrl_mj.Noise\("uniform", 0.1'):
            use()


def test_noise_that_hides_the_whole_chart_is_refused(vehicle):
    with pytest.raises(BadInput, match=r"hides the whole state space of vehicle: .* below 1\.5 m"):
        vehicle.check_noise(1.5)
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


# ---- a new kind of noise is one class: it works wherever noise does, memory and all

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
    records, _ = noisy_episodes(vehicle, Regions(decisions(vehicle).points), loops, noises, 10)
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
