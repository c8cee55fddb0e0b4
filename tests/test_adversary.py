"""Noise that looks ahead: against plants with inertia it looks farther, and misses nothing on the way."""

import numpy as np
import pytest
from planted import sign_policy

from hyrl_mj import Noise, Outcome, Sample
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.simulation import lookahead as adversary
from hyrl_mj.simulation.noise import NOT_STARTED
from hyrl_mj.simulation.rollout import LoopSettings, closed_loop

EPS = 0.1


@pytest.fixture(scope="module")
def loop(puck):
    return PolicyController(sign_policy(puck))


def choose(task, loop, plant, mode):
    """The adversary's first choice (n, p) against all simulations of a plant, in one mode."""
    signal, rng = Noise("adversarial", EPS).against(task, loop), np.random.default_rng(0)
    signal.reset(plant.n, rng)
    k, modes = np.zeros(plant.n, dtype=int), np.full(plant.n, mode)
    return signal.sample(Sample(np.arange(plant.n), k, plant.measurement, modes, plant))


def danger_ahead(task, policy, z, noise):
    """The greatest danger of one run that meets a noise (p,) once and then none: sample by sample."""
    plant, worst = task.plant(1), -np.inf
    plant.set_state(*task.state(z[None]))
    for k in range(adversary.AHEAD):
        measured = plant.measurement + (noise if k == 0 else 0.0)
        plant.step(policy.act(measured))
        after = plant.measurement
        if task.failed(after)[0]:
            return np.inf
        worst = max(worst, task.danger(after)[0])
        if task.ending(after)[0] != Outcome.RUNNING:
            break
    return worst


def test_it_chooses_what_leads_to_the_greatest_danger_ahead(puck, loop):
    z = np.random.default_rng(0).uniform([0.0, -0.15], [1.1, 0.15], (12, 2))
    plant = puck.plant(len(z))
    plant.set_state(*puck.state(z))
    chosen = choose(puck, loop, plant, NOT_STARTED)
    tried = [np.array([0.0, share * EPS, 0.0, 0.0]) for share in (0.0, -1.0, 1.0, -0.5, 0.5)]
    matters = 0
    for start, choice in zip(z, chosen, strict=True):
        dangers = [danger_ahead(puck, loop.policy, start, n) for n in tried]
        assert danger_ahead(puck, loop.policy, start, choice) == max(dangers)
        matters += max(dangers) > dangers[0]
    assert matters >= 3


def test_where_every_answer_is_the_same_there_is_no_noise(puck, loop):
    plant = puck.plant(2)
    plant.set_state(*puck.state(np.array([[0.2, 0.5], [0.2, -0.5]])))
    assert not choose(puck, loop, plant, 0).any()


def test_a_run_that_is_over_is_left_alone(puck, loop):
    crashed = np.array([[1.6, 0.0], [0.2, 0.0]])
    plant = puck.plant(2)
    plant.set_state(*puck.state(crashed))
    chosen = choose(puck, loop, plant, 0)
    assert not chosen[0].any()


@pytest.mark.slow
def test_no_signal_that_does_not_look_is_worse(puck, loop):
    z = np.random.default_rng(0).uniform([0.0, -EPS], [0.2, EPS], (200, 2))
    failed = {}
    for kind in ("uniform", "alternating", "adversarial"):
        run = closed_loop(
            puck, loop, z, Noise(kind, EPS), settings=LoopSettings(vary=True, quiet=True)
        )
        failed[kind] = (run.outcome != Outcome.REACHED).mean()
    assert failed["adversarial"] >= max(failed.values())
    assert failed["adversarial"] > 0.9


def test_a_kinematic_plant_is_looked_at_one_sample_later(vehicle, puck, loop):
    noise = Noise("adversarial", EPS)
    assert noise.against(vehicle, loop).samples == 1
    assert noise.against(puck, loop).samples == adversary.AHEAD > 1
