"""An MLP in NumPy gives what SB3 gives, survives the disk, and refuses what is not a policy."""

import json
from dataclasses import replace

import numpy as np
import pytest
from planted import random_states
from threadpoolctl import threadpool_limits

from hyrl_mj import BadArtifact, BadInput, MlpPolicy
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.training import build, export


@pytest.fixture(scope="module", params=[True, False], ids=["mirrored", "plain"])
def model(task, request):
    """An SB3 algorithm on the task, its weights far from the cautious ones it starts from."""
    settings = replace(preset(task, "smoke").stage1, symmetric=request.param)
    model = build(task, settings, seed=0)
    for parameter in model.policy.parameters():
        parameter.data *= 3.0
    return model


@pytest.fixture
def policy(task):
    return export(build(task, preset(task, "smoke").stage1, seed=0), task)


def test_it_gives_what_sb3_gives(task, model):
    measured = random_states(task, 5000, np.random.default_rng(0))
    observation = task.observation(measured).astype(np.float32)
    theirs, _ = model.predict(observation, deterministic=True)
    ours = export(model, task).act(measured)
    assert ours.shape == (5000, 1)
    assert len(np.unique(ours)) > 1
    if task.learning.algorithm == "dqn":
        np.testing.assert_array_equal(ours, task.input_levels[theirs])
    else:
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)


def test_a_batch_gives_what_its_rows_give(task, policy):
    measured = random_states(task, 9000, np.random.default_rng(0))
    batch = policy.act(measured)
    singles = np.concatenate([policy.act(measured[i : i + 1]) for i in range(0, 9000, 500)])
    np.testing.assert_allclose(singles, batch[::500], atol=1e-6)
    assert policy.act(measured[:0]).shape == (0, 1)


@pytest.mark.parametrize("rows", [1, 60, 2501, 9000])
def test_threads_change_no_bit(task, model, rows):
    policy = export(model, task)
    observation = task.observation(random_states(task, rows, np.random.default_rng(0)))
    outputs = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            outputs.append(policy.outputs(observation))
    np.testing.assert_array_equal(*outputs)


def test_it_comes_back_from_disk(task, policy, tmp_path):
    path = tmp_path / "p.safetensors"
    policy.save(path)
    back = MlpPolicy.load(path)
    assert (back.task.name, back.algorithm, back.activation) == (
        task.name,
        task.learning.algorithm,
        policy.activation,
    )
    assert back.hidden == policy.hidden == (128, 128)
    assert back.weights.keys() == policy.weights.keys()
    for name, weight in policy.weights.items():
        np.testing.assert_array_equal(back.weights[name], weight)
    measured = random_states(task, 100, np.random.default_rng(0))
    np.testing.assert_array_equal(back.act(measured), policy.act(measured))


def test_bad_measurements_are_refused(task, policy):
    with pytest.raises(BadInput, match=r"measurement\[0, 0\] is nan"):
        policy.act(np.full((1, task.measurement_columns), np.nan))
    with pytest.raises(BadInput, match=task.name):
        policy.act(np.zeros((3, 7)))


# ---- files that are no policies


@pytest.mark.parametrize("ending", ["safetensors", "json"])
def test_a_truncated_policy_is_named(policy, tmp_path, ending):
    path = tmp_path / "p.safetensors"
    policy.save(path)
    broken = path.with_suffix(f".{ending}")
    broken.write_bytes(broken.read_bytes()[:-20])
    with pytest.raises(BadArtifact, match=f"p.{ending}"):
        MlpPolicy.load(path)
    broken.unlink()
    with pytest.raises(BadArtifact, match=f"there is no file .*p.{ending}"):
        MlpPolicy.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 1}, "version 1"),
        ({"kind": "critical set"}, "'critical set', not 'policy'"),
        ({"task": "humanoid"}, "unknown task 'humanoid'"),
        ({"algorithm": "trpo"}, "'trpo'"),
        ({"activation": "softplus"}, "'softplus'"),
        ({"task": ...}, "'task'"),
    ],
)
def test_a_description_that_does_not_fit_is_named(policy, tmp_path, change, message):
    path = tmp_path / "p.safetensors"
    policy.save(path)
    description = json.loads(path.with_suffix(".json").read_text()) | change
    left = {name: value for name, value in description.items() if value is not ...}
    path.with_suffix(".json").write_text(json.dumps(left))
    with pytest.raises(BadArtifact, match=message):
        MlpPolicy.load(path)


def test_the_network_of_another_task_is_refused(circle, vehicle, tmp_path):
    policy = export(build(circle, preset(circle, "smoke").stage1, seed=0), circle)
    with pytest.raises(BadArtifact, match=r"continuous inputs.* vehicle takes one of 5 discrete"):
        MlpPolicy(vehicle, "ppo", "tanh", policy.weights)
    plain = {name: weight for name, weight in policy.weights.items() if name != "log_std"}
    with pytest.raises(BadArtifact, match=r"takes 2 and gives 1 numbers.* vehicle needs 3 and 5"):
        MlpPolicy(vehicle, "ppo", "tanh", plain)
    with pytest.raises(BadArtifact, match="holds no network of a dqn policy"):
        MlpPolicy(vehicle, "dqn", "relu", policy.weights)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (".2.weight", lambda w: w[:, :-1], "a layer gives 128 numbers and the next takes 127"),
        (".2.bias", lambda b: b * np.nan, "weights that are not finite"),
    ],
)
def test_layers_that_cannot_be_are_refused(task, policy, name, change, message):
    name = next(n for n in policy.weights if n.endswith(name))
    weights = dict(policy.weights) | {name: change(policy.weights[name])}
    with pytest.raises(BadArtifact, match=message):
        MlpPolicy(task, policy.algorithm, policy.activation, weights)
