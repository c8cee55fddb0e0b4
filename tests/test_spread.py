"""The kinks of a spread first layer lie at observations of the chart, and all else stays as it was."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import hyrl_mj
from hyrl_mj.learning import preset, presets, training
from hyrl_mj.learning.training import spread_kinks


@pytest.fixture(scope="module")
def gaps():
    return hyrl_mj.get_task("gaps")


def built(task, algorithm="ppo", **settings):
    """The networks of an untrained policy."""
    chosen = preset(task, "fast", algorithm=algorithm).stage1
    return training.build(task, replace(chosen, **settings), seed=0).policy


def first_layers(policy):
    """The layers that read the observation, by name."""
    layers = {n: m for n, m in policy.named_modules() if isinstance(m, nn.Linear)}
    return {n: layer for n, layer in layers.items() if n.endswith(".0")}


def kinks_among(layer, observations):
    """Of each unit, whether an observation (n, k) is on its kink, to the rounding of the weights."""
    with torch.no_grad():
        before = layer(torch.as_tensor(observations, dtype=layer.weight.dtype))
    return np.abs(before.numpy()).min(axis=0) < 1e-5


def drawn(task, seed):
    """The observations among which the kinks are: those of states that end no episode."""
    z = np.random.default_rng(seed).uniform(task.chart.low, task.chart.high, (4_096, 2))
    return task.observation(z[task.ending(z) == hyrl_mj.Outcome.RUNNING])


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_every_kink_is_at_an_observation_of_the_chart(gaps, algorithm):
    policy = built(gaps, algorithm, symmetric=False, spread=False)
    before = {name: layer.weight.clone() for name, layer in first_layers(policy).items()}
    assert len(before) == 2, "of the policy and its value, or of a network and its target"
    spread_kinks(policy, gaps, seed=3)
    for name, layer in first_layers(policy).items():
        assert torch.equal(layer.weight, before[name])
        assert kinks_among(layer, drawn(gaps, 3)).all()
        assert not kinks_among(layer, drawn(gaps, 4)).all(), "other observations are not on them"


def test_a_target_network_stays_a_copy(gaps):
    policy = built(gaps, "dqn", symmetric=False, spread=True)
    one, other = first_layers(policy).values()
    assert torch.equal(one.bias, other.bias)
    assert one.bias.abs().min() > 0


def test_later_layers_stay_as_they_are(gaps):
    plain, spread = (built(gaps, symmetric=False, spread=on).state_dict() for on in (False, True))
    changed = {name for name in plain if not torch.equal(plain[name], spread[name])}
    assert changed == {f"mlp_extractor.{net}_net.0.bias" for net in ("policy", "value")}


def test_the_seed_fixes_the_kinks(gaps):
    biases = []
    for seed in (0, 0, 1):
        policy = built(gaps, symmetric=False, spread=False)
        spread_kinks(policy, gaps, seed)
        biases.append(first_layers(policy)["mlp_extractor.policy_net.0"].bias.clone())
    assert torch.equal(biases[0], biases[1])
    assert not torch.equal(biases[0], biases[2])


def test_a_spread_network_is_symmetric_too(gaps):
    model = training.build(gaps, preset(gaps).stage1, seed=0)
    policy = training.export(model, gaps)
    z = np.random.default_rng(0).uniform(gaps.chart.low, gaps.chart.high, (200, 2))
    seen = gaps.observation(z)
    image = seen * np.array(gaps.mirror.observation)
    np.testing.assert_allclose(policy.inputs(image), -policy.inputs(seen), atol=1e-9)
    for layer in first_layers(model.policy).values():
        assert layer.bias.abs().max() > 0


def test_ppo_is_spread_by_default_and_a_task_can_say_otherwise(gaps, monkeypatch):
    assert preset(gaps).stage1.spread
    assert preset(gaps).stage1.hidden == (128, 128)
    assert not preset(hyrl_mj.get_task("vehicle")).stage1.spread
    assert preset(hyrl_mj.get_task("unit_circle")).stage1.hidden == (64, 64)
    own = replace(gaps.learning, training={"spread": False, "samples": 1_000})
    monkeypatch.setattr(gaps, "learning", own)
    assert not preset(gaps).stage1.spread
    assert preset(gaps).stage1.samples == 1_000
    smoke = preset(gaps, "smoke").stage1
    assert not smoke.spread, "the same network, and fewer samples"
    assert smoke.samples == presets._SMOKE["ppo"]
    assert preset(gaps, "paper").stage1.samples == 1_000_000
    assert preset(gaps, algorithm="a2c").stage1.samples != 1_000, "another algorithm has its own"


def test_a_task_can_change_the_training_of_its_modes(gaps, monkeypatch):
    usual = preset(gaps)
    assert usual.stage6.gamma != 0.97
    monkeypatch.setattr(gaps, "learning", replace(gaps.learning, modes={"gamma": 0.97}))
    assert preset(gaps).stage6 == replace(usual.stage6, gamma=0.97)
    assert preset(gaps).stage1 == usual.stage1
    assert preset(gaps, "paper").stage6.gamma != 0.97, "the paper's training is the paper's"
