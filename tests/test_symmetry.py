"""A mirrored network obeys u(S o) = S u(o), before, while and after it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from hyrl_mj.learning import symmetry
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.training import build, export, threads


@pytest.fixture
def model(task):
    return build(task, preset(task, "smoke").stage1, seed=1)


def observations(task, n=500):
    low, high = np.array(task.observation_low), np.array(task.observation_high)
    return torch.as_tensor(np.random.default_rng(0).uniform(low, high, (n, len(low)))).float()


def networks(task, policy):
    """The networks of an SB3 policy, and what the mirror does to the output of each."""
    turn = torch.tensor(task.mirror.inputs).float()
    if task.learning.algorithm == "dqn":
        return [(policy.q_net.q_net, swap_levels), (policy.q_net_target.q_net, swap_levels)]
    extract = policy.mlp_extractor
    actor = nn.Sequential(*extract.policy_net, policy.action_net)
    critic = nn.Sequential(*extract.value_net, policy.value_net)
    return [(actor, lambda out: out * turn), (critic, lambda out: out)]


def swap_levels(out):
    return out.flip(1)


def assert_mirrored(task, policy):
    o, signs = observations(task), torch.tensor(task.mirror.observation).float()
    for network, turned in networks(task, policy):
        out = network(o)
        assert out.std() > 1e-4, "a network that gives the same everywhere proves nothing"
        torch.testing.assert_close(network(o * signs), turned(out), rtol=1e-5, atol=1e-5)


def test_it_is_mirrored_from_the_start(task, model):
    assert_mirrored(task, model.policy)


@pytest.mark.slow
def test_it_stays_mirrored_while_it_learns(task, model):
    before = {name: w.clone() for name, w in symmetry.plain_state(model.policy, task).items()}
    with threads(1):
        model.learn(4_000 if task.learning.algorithm == "dqn" else 3 * 4_096)
    after = symmetry.plain_state(model.policy, task)
    actor = {"dqn": "q_net.q_net", "ppo": "mlp_extractor.policy_net"}[task.learning.algorithm]
    actor += ".2.weight"
    assert (after[actor] - before[actor]).abs().max() > 1e-3, "it has learned nothing"
    assert_mirrored(task, model.policy)


def test_every_weight_learns(task, model):
    o, target = observations(task), torch.randn(500, 1)
    for network, _ in networks(task, model.policy)[:1]:
        (network(o) * target).mean().backward()
    trained = {id(p) for group in model.policy.optimizer.param_groups for p in group["params"]}
    for parameter in networks(task, model.policy)[0][0].parameters():
        assert id(parameter) in trained
        # The bias of an output that changes its sign in the mirror is zero, and stays so.
        assert parameter.ndim == 1 or parameter.grad.abs().sum() > 0


def test_the_target_network_of_dqn_starts_equal_and_tied(vehicle):
    policy = build(vehicle, preset(vehicle, "smoke").stage1, seed=1).policy
    state = symmetry.plain_state(policy, vehicle)
    for name in ("0.weight", "2.bias", "4.weight"):
        target, trained = state[f"q_net_target.q_net.{name}"], state[f"q_net.q_net.{name}"]
        torch.testing.assert_close(target, trained)


def test_the_exported_policy_is_mirrored_too(task, model):
    z = task.starts(500, np.random.default_rng(0))
    image = z * [1, -1] if task.name == "vehicle" else -z
    policy = export(model, task)
    assert policy.hidden == (128, 128), "twice the width of the settings"
    np.testing.assert_allclose(policy.act(image), -policy.act(z), atol=1e-6)


def test_a_plain_network_is_not_mirrored(task):
    settings = replace(preset(task, "smoke").stage1, symmetric=False)
    policy = build(task, settings, seed=1).policy
    with pytest.raises(AssertionError, match="not close"):
        assert_mirrored(task, policy)


def test_a_policy_in_the_mirror_does_the_mirrored_thing(task):
    settings = replace(preset(task, "smoke").stage1, symmetric=False)
    for algorithm in ("ppo", "dqn") if task.learning.levels else ("ppo",):
        options = settings.options if algorithm == settings.algorithm else {}
        built = build(task, replace(settings, algorithm=algorithm, options=options), seed=1)
        policy = export(built, task)
        image = symmetry.mirrored(policy)
        o = observations(task).numpy()
        turned = policy.inputs(o * task.mirror.observation) * task.mirror.inputs
        assert np.abs(turned - policy.inputs(o)).max() > 1e-3, "it is symmetric anyway"
        np.testing.assert_allclose(image.inputs(o), turned, atol=1e-6)
        for name, weight in symmetry.mirrored(image).weights.items():
            np.testing.assert_array_equal(weight, policy.weights[name], err_msg=name)
