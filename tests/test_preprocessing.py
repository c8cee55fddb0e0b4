"""Agents that were trained under `VecNormalize` or `VecFrameStack` see here what they saw there."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch
from planted import Payload, random_states
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations
from test_agents import Lopsided, onnx_file, saved, untrained

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, Noise, load_agent, simulate
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.gym_export.sb3_policy import Sb3Policy
from hyrl_mj.policies import (
    MlpPolicy,
    PolicyController,
    PreprocessedPolicy,
    SampledPolicy,
    answer,
    as_function,
    is_memory,
    memory_at_start,
)
from hyrl_mj.policies.external import read_agent, reopen_agent
from hyrl_mj.policies.preprocessing import Normalization

WRAPPED = {
    "normalised": lambda env: VecNormalize(env, clip_obs=1.5),
    "stacked": lambda env: VecFrameStack(env, 3),
    "normalised, stacked": lambda env: VecFrameStack(VecNormalize(env, clip_obs=1.5), 3),
    "stacked, normalised": lambda env: VecNormalize(VecFrameStack(env, 3), clip_obs=1.5),
}


def normalizer(env):
    """The `VecNormalize` among the wrappers of an environment."""
    while env is not None and not isinstance(env, VecNormalize):
        env = getattr(env, "venv", None)
    return env


def agent(algorithm, task, folder, wrap):
    """An SB3 agent with random weights in a wrapped environment, its zip, and what `load_agent` needs."""
    model = untrained(algorithm, task, wrap, net_arch=[16])
    env = model.get_env()
    needs = {"n_stack": 3 if env.observation_space.shape[0] > len(task.observation_low) else 1}
    if (found := normalizer(env)) is not None:
        rng = np.random.default_rng(0)
        shape = found.obs_rms.mean.shape
        found.obs_rms.mean, found.obs_rms.var = rng.normal(size=shape), rng.uniform(0.1, 2, shape)
        statistics = {"mean": found.obs_rms.mean, "var": found.obs_rms.var, "clip": found.clip_obs}
        np.savez(folder / "stats.npz", **statistics)
        needs["vecnormalize"] = folder / "stats.npz"
    return model, saved(model, folder), needs


class OwnNormalize(VecNormalize):
    """A user's class, which may normalise otherwise."""


def pickled_statistics(tmp_path, kind=VecNormalize, **options):
    """What `VecNormalize.save` writes after some samples, and the object."""
    env = kind(TaskVecEnv(BatchedEnv(hyrl_mj.get_task("unit_circle"), 1)), **options)
    env.reset()
    for _ in range(20):
        env.step(np.array([env.action_space.sample()]))
    env.save(tmp_path / "stats.pkl")
    return tmp_path / "stats.pkl", env


def test_statistics_are_read_as_sb3_saves_them(tmp_path):
    path, env = pickled_statistics(tmp_path, clip_obs=np.float64(3.0), epsilon=1e-4)
    found, seen = Normalization.load(path), np.random.default_rng(0).normal(size=(50, 2))
    np.testing.assert_array_equal(found(seen).astype(np.float32), env.normalize_obs(seen))
    assert (found.clip, found.epsilon) == (3.0, 1e-4)


def test_statistics_of_a_dict_are_read_by_its_keys(tmp_path):
    box = gym.spaces.Box(-1, 1, (2,))

    class Both(gym.Env):
        observation_space, action_space = gym.spaces.Dict(b=box, a=box), box

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 0.0, False, False, {}

    env = VecNormalize(DummyVecEnv([Both]))
    env.reset()
    env.save(tmp_path / "stats.pkl")
    found = Normalization.load(tmp_path / "stats.pkl", {"b": 2, "a": 2})
    means = [env.obs_rms[key].mean for key in ("b", "a")]
    np.testing.assert_array_equal(found.mean, np.concatenate(means))


@pytest.mark.parametrize("what", ["no statistics", "code", "nested", "cut off", "plain", "own"])
def test_pickles_that_are_no_statistics_are_refused(what, tmp_path):
    path, _ = pickled_statistics(tmp_path, norm_obs=what != "plain")
    if what == "cut off":
        path.write_bytes(path.read_bytes()[:-40])
    if what == "code":
        mean = Payload(tmp_path / "executed")
        path.write_bytes(pickle.dumps({"obs_rms": mean, "clip_obs": 1.0, "epsilon": 1.0}))
    if what == "no statistics":
        path.write_bytes(pickle.dumps({"obs_rms": 3}))
    if what == "nested":  # keys that double
        path.write_bytes(b"\x80\x04}(" + b")" + b"2\x86" * 5_000 + b"K\x01u.")
    if what == "own":
        path, _ = pickled_statistics(tmp_path, OwnNormalize)
    told = {
        "plain": "did not normalise",
        "own": r"is a \S+\.OwnNormalize, which may normalise otherwise",
    }.get(what, "no VecNormalize that SB3 has saved")
    with pytest.raises(BadArtifact, match=told):
        Normalization.load(path)
    assert not (tmp_path / "executed").exists()


def as_there(model, wrapped, task, measured):
    """What an SB3 agent answers to the measurements (K, p) of an episode, one after the other."""
    space = TaskVecEnv(BatchedEnv(task, 1, threads=1)).observation_space
    stack, norm = StackedObservations(1, 3, space), normalizer(model.get_env())
    inside = "normalised, stacked" in wrapped
    answers = []
    for k, row in enumerate(measured):
        seen = task.observation(row[None]).astype(np.float32)
        if inside:
            seen = norm.normalize_obs(seen)
        if "stacked" in wrapped:
            done = np.array([False])
            seen = stack.update(seen, done, [{}])[0] if k else stack.reset(seen)
        if norm is not None and not inside:
            seen = norm.normalize_obs(seen)
        action, _ = model.predict(seen, deterministic=True)
        answers.append(action[0] if task.input_levels is None else task.input_levels[action[0]])
    return np.array(answers)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "name", "wrapped"),
    [
        *((DQN, "vehicle", wrapped) for wrapped in WRAPPED),
        (PPO, "unit_circle", "normalised, stacked"),
        (SAC, "unit_circle", "stacked, normalised"),
    ],
)
def test_in_a_closed_loop_it_acts_as_under_sb3(algorithm, name, wrapped, tmp_path):
    task = hyrl_mj.get_task(name)
    model, path, needs = agent(algorithm, task, tmp_path, WRAPPED[wrapped])
    policy = load_agent(path, task, **needs)
    for kind in ("none", "uniform"):
        starts = task.starts(3, np.random.default_rng(0))
        for arc in simulate(task, policy, starts, Noise(kind, 0.05), horizon=0.5):
            measured = arc.measured[:-1]
            theirs = as_there(model, wrapped, task, measured)
            np.testing.assert_allclose(arc.u[:-1], theirs, atol=2e-5)


@pytest.mark.slow
def test_statistics_of_what_a_wrapper_made_are_refused(circle, tmp_path):
    inside = gym.wrappers.NormalizeObservation(gym.make(circle.env_id))
    for inner in (TaskVecEnv(BatchedEnv(circle, 1)), DummyVecEnv([lambda: inside])):
        env = VecNormalize(inner)
        model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu", seed=0).learn(8)
        model.save(tmp_path / "agent.zip")
        env.save(tmp_path / "stats.pkl")
        needs = {"vecnormalize": tmp_path / "stats.pkl"}
        if isinstance(inner, TaskVecEnv):
            load_agent(tmp_path / "agent.zip", circle, **needs)
    with pytest.raises(
        BadArtifact, match=r"under a wrapper .* before the given statistics come in"
    ):
        load_agent(tmp_path / "agent.zip", circle, **needs)


def test_its_steady_answer_is_that_to_an_unchanged_measurement(vehicle, tmp_path):
    _, path, needs = agent(DQN, vehicle, tmp_path, WRAPPED["normalised, stacked"])
    policy = load_agent(path, vehicle, **needs)
    measured = random_states(vehicle, 50, np.random.default_rng(0))
    held = np.repeat(vehicle.observation(measured)[:, None], 2, axis=1)
    np.testing.assert_array_equal(policy.act_after(held, measured)[0], policy.act(measured))
    loop, modes = PolicyController(policy), np.zeros(50, int)
    fresh = memory_at_start(loop, 50)
    assert fresh.shape == (50, 2, 3)
    assert (answer(loop, modes, measured, fresh)[0] != policy.act(measured)).any()
    np.testing.assert_array_equal(loop.step(modes, measured)[0], policy.act(measured))
    steady = as_function(policy)
    assert not is_memory(memory_at_start(PolicyController(steady), 50))
    np.testing.assert_array_equal(steady.act(measured), policy.act(measured))


@pytest.mark.slow
def test_a_sampled_agent_is_normalised_too(circle, tmp_path):
    _, path, needs = agent(PPO, circle, tmp_path, WRAPPED["normalised"])
    drawn = load_agent(path, circle, stochastic=True, **needs)
    assert isinstance(drawn, PreprocessedPolicy)
    assert isinstance(drawn.policy, SampledPolicy)
    measured = random_states(circle, 20, np.random.default_rng(0))
    assert (drawn.act(measured) != drawn.act(measured)).any()
    mean = load_agent(path, circle, **needs)
    np.testing.assert_array_equal(as_function(drawn).act(measured), mean.act(measured))


@pytest.mark.slow
def test_onnx_models_are_normalised_and_stacked(circle, tmp_path):
    weight = np.random.default_rng(0).normal(size=(1, 6))
    path = onnx_file(tmp_path, weight, np.zeros(1))
    statistics = Normalization(np.array([0.5, -0.5]), np.array([0.25, 1.0]), 2.0, 0.0)
    statistics.save(tmp_path / "s.npz")
    policy = load_agent(path, circle, vecnormalize=tmp_path / "s.npz", n_stack=3)
    observation = np.array([[1.0, 0.0], [0.0, 1.0]])
    seen = np.tile([[1.0, 0.5], [-1.0, 1.5]], 3)
    expected = np.clip(seen @ weight.T, -1, 1)
    np.testing.assert_allclose(policy.inputs(observation), expected, atol=1e-6)
    with pytest.raises(BadArtifact, match="takes 6 numbers"):
        load_agent(path, circle)


# ---- in a run


@pytest.mark.parametrize("wrapped", ["normalised", "normalised, stacked"])
def test_it_comes_back_from_a_run_directory(wrapped, circle, tmp_path):
    _, path, needs = agent(PPO, circle, tmp_path, WRAPPED[wrapped])
    given = read_agent(circle, path, **needs)
    (tmp_path / "run").mkdir()
    given.store(tmp_path / "run")
    back = reopen_agent(tmp_path / "run", given.agent, circle, 0, None)
    measured = random_states(circle, 50, np.random.default_rng(0))
    np.testing.assert_array_equal(back.act(measured), given.policy.act(measured))
    assert isinstance(back, PreprocessedPolicy)
    assert back.start(1).shape == given.policy.start(1).shape
    # The same weights that see something else are another agent; where its files lie does not count.
    assert read_agent(circle, given.policy).agent == given.agent
    with np.load(tmp_path / "stats.npz") as old:
        np.savez(tmp_path / "stats.npz", **{**old, "clip": 3.0})
    assert read_agent(circle, path, **needs).agent != given.agent


@pytest.mark.long
@pytest.mark.slow
def test_a_run_on_such_an_agent_says_so_and_goes_on(small_runs, circle, tmp_path):
    _, path, needs = agent(PPO, circle, tmp_path, WRAPPED["normalised, stacked"])
    said, out = [], tmp_path / "run"
    run = hyrl_mj.diagnose("unit_circle", path, preset="smoke", out=out, say=said.append, **needs)
    assert any(
        "it sees its last 3 observations: noisy episodes stand in for the worst case" in line
        for line in said
    )
    assert not run.exact
    assert "a function of the measurement, which this policy is not" in run.why_no_game
    page = (out / "diagnosis.html").read_text()
    assert "--n-stack 3" in page
    assert f"--vecnormalize {tmp_path / 'stats.npz'}" in page
    assert "it sees its last 3 observations" in page
    for name in ("agent.zip", "stats.npz"):
        (tmp_path / name).unlink()
    again = hyrl_mj.load_run(out)
    assert "agent.zip (PPO, normalised, 3 observations)" in str(again.agent)
    measured = random_states(circle, 10, np.random.default_rng(0))
    np.testing.assert_array_equal(again.policy.act(measured), run.policy.act(measured))
    (out / "vecnormalize.npz").write_bytes(b"changed")
    with pytest.raises(BadArtifact, match=r"vecnormalize\.npz was changed"):
        _ = hyrl_mj.load_run(out).policy


def test_a_normalised_agent_is_a_function_of_the_measurement(circle, tmp_path):
    _, path, needs = agent(PPO, circle, tmp_path, WRAPPED["normalised"])
    given = read_agent(circle, path, **needs).agent
    assert given.statistics
    assert not given.why_no_function


# ---- what cannot be used


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"mean": np.zeros(2), "var": np.ones(2)}, "it has no array clip: give what env.save"),
        ({}, "it has no array mean and no var and no clip"),
        (
            {"mean": np.zeros(3), "var": np.ones(3), "clip": 10},
            "observations of 3 numbers, .* have 2",
        ),
        ({"mean": np.zeros(2), "var": np.ones(3), "clip": 10}, "two rows of numbers"),
        ({"mean": np.zeros((1, 2)), "var": np.ones((1, 2)), "clip": 10}, "two rows of numbers"),
        ({"mean": np.zeros(2), "var": np.ones(2), "clip": [1, 2]}, "clip is one number"),
        ({"mean": np.zeros(2), "var": -np.ones(2), "clip": 10}, "cannot be statistics"),
        ({"mean": np.full(2, np.nan), "var": np.ones(2), "clip": 10}, "cannot be statistics"),
        (
            {"mean": np.zeros(2), "var": np.zeros(2), "clip": 10, "epsilon": 0},
            "cannot be statistics",
        ),
        ({"mean": np.zeros(2), "var": np.ones(2), "clip": 0}, "cannot be statistics"),
        ({"mean": np.array(["a", "b"]), "var": np.ones(2), "clip": 1}, "holds no numbers"),
        ({"mean": np.array([None, 1]), "var": np.ones(2), "clip": 1}, "cannot be read"),
        ({"mean": np.zeros(2**18), "var": np.ones(2), "clip": 1}, "unpacks to more than 1 MiB"),
    ],
)
def test_statistics_that_cannot_be_are_refused(arrays, message, circle, tmp_path):
    _, path, _ = agent(PPO, circle, tmp_path, WRAPPED["normalised"])
    np.savez(tmp_path / "s.npz", **arrays)
    with pytest.raises(BadArtifact, match=message) as error:
        load_agent(path, circle, vecnormalize=tmp_path / "s.npz")
    assert str(tmp_path / "s.npz") in str(error.value)


def test_what_is_no_file_of_statistics_is_refused(circle, tmp_path):
    _, path, _ = agent(PPO, circle, tmp_path, WRAPPED["normalised"])
    with pytest.raises(BadArtifact, match=r"there is no file .*none\.npz: give what env.save"):
        load_agent(path, circle, vecnormalize=tmp_path / "none.npz")
    (tmp_path / "s.npz").write_bytes(b"not an npz")
    with pytest.raises(BadArtifact, match=r"s\.npz cannot be read"):
        load_agent(path, circle, vecnormalize=tmp_path / "s.npz")


@pytest.mark.parametrize("n_stack", [0, -1, 1001, 2.0, True, "3"])
def test_a_number_of_observations_that_cannot_be_is_refused(n_stack, circle, tmp_path):
    with pytest.raises(
        BadInput, match=r"n_stack .* cannot be used: give the number of observations"
    ):
        load_agent(tmp_path / "a.zip", circle, n_stack=n_stack)


def test_a_stacked_agent_without_its_option_is_told(circle, tmp_path):
    _, path, _ = agent(PPO, circle, tmp_path, WRAPPED["stacked"])
    with pytest.raises(
        BadArtifact, match=r"takes 6 .* needs 2 and 1: give --n-stack 3 if Vec.*FrameSt"
    ):
        load_agent(path, circle)
    with pytest.raises(BadArtifact, match=r"takes 6 .* needs 4 and 1"):
        load_agent(path, circle, n_stack=2)


def test_options_of_files_are_not_taken_for_functions(circle):
    for options in ({"n_stack": 2}, {"vecnormalize": "s.npz"}):
        with pytest.raises(BadInput, match="n_stack are about the file of an agent"):
            read_agent(circle, lambda o: o[:, :1], **options)


@pytest.mark.slow
def test_its_network_is_not_taken_for_one_on_plain_observations(circle, tmp_path):
    _, path, needs = agent(PPO, circle, tmp_path, WRAPPED["normalised"])
    loaded = load_agent(path, circle, **needs)
    assert not isinstance(loaded, MlpPolicy)
    read_agent(circle, path, **needs).store(tmp_path)
    stored, statistics = tmp_path / "policy.safetensors", tmp_path / "vecnormalize.npz"
    with pytest.raises(BadInput, match=f"saw normalised .* give --vecnormalize {statistics}"):
        load_agent(stored, circle)
    again = load_agent(stored, circle, vecnormalize=statistics)
    seen = np.random.default_rng(0).normal(size=(30, 2))
    np.testing.assert_array_equal(again.inputs(seen), loaded.inputs(seen))


def test_a_stack_that_begins_with_copies_is_not_taken_for_one_of_zeros(vehicle, tmp_path):
    env = gym.wrappers.FrameStackObservation(gym.make(vehicle.env_id), 3)
    path = saved(PPO("MlpPolicy", env, n_steps=64, device="cpu"), tmp_path)
    with pytest.raises(BadArtifact, match=r"shape \[3, 3\], as FrameStackObservation gives"):
        load_agent(path, vehicle, n_stack=3)


# ---- modules of torch


def module(k, outputs):
    return torch.nn.Sequential(
        torch.nn.Linear(k, 8), torch.nn.Dropout(0.5), torch.nn.Tanh(), torch.nn.Linear(8, outputs)
    )


def test_a_module_of_torch_is_a_function(circle, vehicle):
    for task, outputs in ((circle, 1), (vehicle, 5)):
        k = len(task.observation_low)
        network = module(k, outputs).train()
        observation = np.random.default_rng(0).normal(size=(30, k))
        ours = hyrl_mj.from_callable(network, task).inputs(observation)
        with torch.no_grad():
            theirs = network.eval()(torch.from_numpy(observation.astype(np.float32))).numpy()
        if task is vehicle:
            np.testing.assert_array_equal(ours, task.input_levels[theirs.argmax(axis=1)])
        else:
            np.testing.assert_allclose(ours, np.clip(theirs, -1, 1), atol=1e-6)
        assert read_agent(task, network).agent.algorithm == "function"
        assert all(p.grad is None for p in network.parameters())


def test_a_module_that_ends_in_tanh_is_refused_where_inputs_have_other_limits(circle):
    network = torch.nn.Sequential(torch.nn.Linear(2, 1), torch.nn.Sequential(torch.nn.Tanh()))
    assert hyrl_mj.from_callable(network, circle).act(np.ones((2, 1))).shape == (2, 1)
    with pytest.raises(BadInput, match=r"ends in Tanh, .* let it scale them"):
        hyrl_mj.from_callable(network, Lopsided())
    for other in (torch.jit.trace(network, torch.zeros(1, 2)), torch.jit.script(network)):
        with pytest.raises(BadInput, match=r"ends in Tanh, .* let it scale them"):
            hyrl_mj.from_callable(other, Lopsided())
    network.append(torch.nn.Hardtanh(-3, 3))
    hyrl_mj.from_callable(network, Lopsided())
    half = network.to(torch.bfloat16)  # which NumPy does not have
    assert hyrl_mj.from_callable(half, circle).act(np.ones((2, 1))).shape == (2, 1)


def test_a_part_of_a_module_that_is_called_act_is_none_of_its_methods(circle):
    network = torch.nn.Linear(2, 1)
    network.act = torch.nn.ReLU()
    assert hyrl_mj.from_callable(network, circle).act(np.ones((2, 1))).shape == (2, 1)


class Pair(torch.nn.Module):
    def forward(self, o):
        return o, o


def test_a_module_that_does_not_fit_is_named(circle, vehicle):
    measured = random_states(circle, 4, np.random.default_rng(0))
    for network, message in (
        (Pair(), "the module cannot be used: it gives tuple, not a tensor"),
        (module(2, 3), r"the module gives shape \(4, 3\) for 4 observations"),
        (module(5, 1), "the module cannot be used: it raised RuntimeError"),
    ):
        with pytest.raises(BadInput, match=message):
            hyrl_mj.from_callable(network, circle).act(measured)
    with pytest.raises(BadInput, match=r"preferences of shape \(n, 5\)"):
        hyrl_mj.from_callable(module(3, 4), vehicle).act(np.zeros((4, 2)))


def test_sb3s_evaluation_refuses_a_policy_with_memory(circle, tmp_path):
    _, path, needs = agent(PPO, circle, tmp_path, WRAPPED["stacked"])
    policy = load_agent(path, circle, **needs)
    with pytest.raises(BadInput, match="the policy has a memory"):
        Sb3Policy(circle, policy)
    Sb3Policy(circle, as_function(policy))
