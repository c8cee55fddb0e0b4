"""Agents of a Dict of vectors act in a task's own loop as under SB3, also stacked and normalised."""

from collections import OrderedDict

import numpy as np
import pytest
import torch
from environments import Puck, puck_agent
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, Noise, from_callable, load_agent
from hyrl_mj.policies.external import read_agent, reopen_agent
from hyrl_mj.simulation import Recorded

STEPS = 20
WRAPPED = {
    "plain": lambda env: env,
    "normalised": lambda env: VecNormalize(env, clip_obs=1.5),
    "stacked": lambda env: VecFrameStack(env, 3),
    "normalised, stacked": lambda env: VecFrameStack(VecNormalize(env, clip_obs=1.5), 3),
    "stacked, normalised": lambda env: VecNormalize(VecFrameStack(env, 3), clip_obs=1.5),
}


@pytest.fixture(scope="module")
def puck():
    return hyrl_mj.from_gymnasium(Puck, steps=STEPS)


def agent(kind, wrapped, folder):
    """An SB3 agent with random weights, its environment, its zip, and what `load_agent` needs."""
    env = WRAPPED[wrapped](DummyVecEnv([Puck]))
    kwargs = {"net_arch": [16]}
    model = kind("MultiInputPolicy", env, seed=0, device="cpu", policy_kwargs=kwargs)
    for parameter in model.policy.parameters():
        parameter.data = torch.randn(parameter.shape) / parameter.shape[-1] ** 0.5
    needs = {"n_stack": 3 if "stacked" in wrapped else 1}
    if "normalised" in wrapped:
        norm = env if isinstance(env, VecNormalize) else env.venv
        norm.training, rng = False, np.random.default_rng(0)
        for found in norm.obs_rms.values():
            found.mean = rng.normal(size=found.mean.shape)
            found.var = rng.uniform(0.1, 2, found.var.shape)
        keys = sorted(norm.obs_rms)
        np.savez(
            folder / "stats.npz",
            mean=np.concatenate([norm.obs_rms[key].mean for key in keys]),
            var=np.concatenate([norm.obs_rms[key].var for key in keys]),
            clip=norm.clip_obs,
        )
        needs["vecnormalize"] = folder / "stats.npz"
    model.save(folder / "agent.zip")
    return model, env, folder / "agent.zip", needs


@pytest.mark.slow
@pytest.mark.first(4)
@pytest.mark.parametrize("wrapped", WRAPPED)
@pytest.mark.parametrize("kind", [PPO, SAC])
def test_in_a_closed_loop_it_acts_as_under_sb3(kind, wrapped, puck, tmp_path):
    model, env, path, needs = agent(kind, wrapped, tmp_path)
    env.seed(0)
    seen, inner = env.reset(), env.unwrapped.envs[0]
    start, places, actions = inner.data.qpos.copy(), [], []
    for _ in range(STEPS - 1):
        action, _ = model.predict(seen, deterministic=True)
        seen, _, done, _ = env.step(action)
        assert not done.any()
        places.append(inner.data.qpos.copy())
        actions.append(action[0])
    arc = hyrl_mj.simulate(puck, load_agent(path, puck, **needs), start)
    np.testing.assert_allclose(arc.u[: STEPS - 1], actions, atol=1e-4)
    np.testing.assert_allclose(arc.z[1:STEPS], places, atol=1e-4)


@pytest.mark.parametrize("name", ["MultiInputPolicy", "MultiInputLstmPolicy"])
def test_a_model_of_a_dict_acts_itself(name, puck):
    kind = pytest.importorskip("sb3_contrib").RecurrentPPO if "Lstm" in name else SAC
    model = kind(name, Puck(), seed=0, device="cpu", policy_kwargs={"net_arch": [16]})
    seen = np.random.default_rng(0).normal(size=(20, 6)).astype(np.float32)
    ends = np.cumsum([*puck.observation_parts.values()])[:-1]
    parts = dict(zip(puck.observation_parts, np.split(seen, ends, axis=1), strict=True))
    theirs, _ = model.predict(parts, episode_start=np.ones(20, dtype=bool), deterministic=True)
    np.testing.assert_allclose(from_callable(model, puck).inputs(seen), theirs, atol=1e-5)
    with pytest.raises(BadInput, match=r"observes Dict\(.*, and vehicle gives \(3,\)"):
        from_callable(model, hyrl_mj.get_task("vehicle"))


def test_noise_beside_the_chart_of_an_environment_is_refused(puck):
    policy, signal = from_callable(puck_agent, puck), np.zeros((STEPS + 1, 1, 11))
    signal[:, 0, 4] = 0.1
    with pytest.raises(BadInput, match=r"column 4 .* is added to the chart, columns 0 to 1"):
        hyrl_mj.simulate(puck, policy, [-1.5, 0.2], Recorded(signal, 0.1))
    arc = hyrl_mj.simulate(puck, policy, [-1.5, 0.2], Noise("uniform", 0.1, everywhere=True))
    assert (np.abs(arc.measured[:-1, :2] - arc.z[:-1]) > 0).all()


@pytest.mark.slow
def test_a_run_keeps_it_as_it_was(puck, tmp_path):
    _, _, path, needs = agent(PPO, "stacked, normalised", tmp_path)
    external = read_agent(puck, path, **needs)
    external.store(tmp_path)
    again = reopen_agent(tmp_path, external.agent, puck, 0, None)
    start = puck.starts(1, np.random.default_rng(0))[0]
    first, second = (hyrl_mj.simulate(puck, one, start) for one in (external.policy, again))
    np.testing.assert_array_equal(first.u, second.u)


@pytest.mark.slow
def test_what_an_agent_observed_and_what_the_task_gives_are_both_named(
    puck, vehicle, tmp_path, monkeypatch
):
    _, _, path, _ = agent(PPO, "plain", tmp_path)
    theirs = r"Dict\(position \(2,\), to_goal \(2,\), velocity \(2,\)\)"
    with pytest.raises(BadArtifact, match=f"observations are {theirs}, those of vehicle a vector"):
        load_agent(path, vehicle)
    parts = {"achieved_goal": 2, "observation": 4}
    monkeypatch.setitem(vars(puck), "observation_parts", parts)
    with pytest.raises(BadArtifact, match=rf"{theirs}, those of .* Dict\(achieved_goal \(2,\), ob"):
        load_agent(path, puck)


def test_normalised_training_is_noticed_without_its_statistics(puck, tmp_path):
    env = VecNormalize(DummyVecEnv([Puck]))
    model = PPO("MultiInputPolicy", env, n_steps=64, seed=0, device="cpu")
    model.learn(64)
    model.save(tmp_path / "agent.zip")
    with pytest.raises(BadArtifact, match="VecNormalize"):
        load_agent(tmp_path / "agent.zip", puck)


ORDERS = {
    "theirs": ("velocity", "to_goal", "position"),
    "ours": ("to_goal", "position", "velocity"),
}


class Ordered(Puck):
    """A puck whose Dict has an order of its own, which Gymnasium keeps."""

    def __init__(self, order):
        super().__init__()
        parts = Puck.observation_space.spaces
        self.observation_space = spaces.Dict(OrderedDict((key, parts[key]) for key in order))


@pytest.mark.slow
@pytest.mark.parametrize("wrapped", WRAPPED)
def test_parts_of_a_dict_are_joined_in_the_order_of_the_agent(wrapped, puck, tmp_path, monkeypatch):
    """Also where the task has them in another order than the agent."""
    env = WRAPPED[wrapped](DummyVecEnv([lambda: Ordered(ORDERS["theirs"])]))
    model = PPO("MultiInputPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [16]})
    for parameter in model.policy.parameters():
        parameter.data = torch.randn(parameter.shape) / parameter.shape[-1] ** 0.5
    model.save(tmp_path / "agent.zip")
    n, norm, needs = 3 if "stacked" in wrapped else 1, None, {}
    if "normalised" in wrapped:
        norm, rng = env if isinstance(env, VecNormalize) else env.venv, np.random.default_rng(0)
        norm.training = False
        arrays = {"clip": norm.clip_obs}
        for key, found in norm.obs_rms.items():
            found.mean, found.var = (rng.uniform(0.1, 2, found.mean.shape) for _ in range(2))
            arrays |= {f"mean.{key}": found.mean, f"var.{key}": found.var}
        np.savez(tmp_path / "stats.npz", **arrays)
        needs["vecnormalize"] = tmp_path / "stats.npz"
    for order in (sorted(ORDERS["ours"]), ORDERS["ours"]):
        monkeypatch.setitem(vars(puck), "observation_parts", dict.fromkeys(order, 2))
        policy = load_agent(tmp_path / "agent.zip", puck, n_stack=n, **needs)
        frames = {
            key: np.random.default_rng(1).normal(size=(50, n, 2)) + i for i, key in enumerate(order)
        }
        ours = np.concatenate([frames[key] for key in order], axis=2)
        seen = {key: frame.reshape(50, -1).astype(np.float32) for key, frame in frames.items()}
        if wrapped == "normalised, stacked":
            each = [
                norm.normalize_obs({key: f[:, i] for key, f in frames.items()}) for i in range(n)
            ]
            seen = {key: np.hstack([one[key] for one in each]) for key in frames}
        elif norm is not None:
            seen = norm.normalize_obs(seen)
        theirs, _ = model.predict({key: seen[key] for key in ORDERS["theirs"]}, deterministic=True)
        inner, sees = (
            (policy.policy, policy.preprocessing(ours)) if n > 1 or norm else (policy, ours[:, 0])
        )
        np.testing.assert_allclose(inner.inputs(sees), theirs, atol=1e-4)


def test_statistics_in_an_order_that_is_not_known_are_refused(puck, tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: Ordered(ORDERS["theirs"])]))
    PPO("MultiInputPolicy", env, seed=0, device="cpu").save(tmp_path / "agent.zip")
    statistics = {"mean": np.zeros(6), "var": np.ones(6), "clip": 10.0}
    np.savez(tmp_path / "s.npz", **statistics)
    with pytest.raises(
        BadArtifact, match=r"keys velocity, to_goal, position, which are not sorted"
    ):
        load_agent(tmp_path / "agent.zip", puck, vecnormalize=tmp_path / "s.npz")
    np.savez(
        tmp_path / "s.npz", **{"mean.position": np.zeros(2), "var.position": np.ones(2), "clip": 1}
    )
    with pytest.raises(
        BadArtifact, match=r"are not those of the Dict, mean.position, .* only some keys"
    ):
        load_agent(tmp_path / "agent.zip", puck, vecnormalize=tmp_path / "s.npz")


def test_parts_of_other_sizes_are_refused_though_their_sum_fits(puck, tmp_path):
    class Other(Puck):
        observation_space = spaces.Dict(
            {
                key: spaces.Box(-np.inf, np.inf, (size,))
                for key, size in (("position", 1), ("to_goal", 2), ("velocity", 3))
            }
        )

    PPO("MultiInputPolicy", DummyVecEnv([Other]), device="cpu").save(tmp_path / "agent.zip")
    with pytest.raises(
        BadArtifact, match=r"Dict\(position \(1,\), to_goal \(2,\), velocity \(3,\)\)"
    ):
        load_agent(tmp_path / "agent.zip", puck)


class OnAMap(Puck):
    """Observes its place on a map, in float64, of which single precision rounds a quarter of a metre."""

    observation_space = spaces.Box(-np.inf, np.inf, (4,), dtype=np.float64)

    def _get_obs(self):
        return np.concatenate([5e6 + self.data.qpos, self.data.qvel])


@pytest.mark.slow
def test_normalised_numbers_of_float64_are_not_rounded_before(tmp_path):
    env = VecNormalize(DummyVecEnv([OnAMap]), norm_reward=False)
    model = SAC("MlpPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [16]})
    env.obs_rms.mean[:2], env.training = 5e6, False
    model.save(tmp_path / "agent.zip")
    env.save(tmp_path / "statistics.pkl")
    task = hyrl_mj.from_gymnasium(OnAMap, steps=STEPS)
    agent = load_agent(tmp_path / "agent.zip", task, vecnormalize=tmp_path / "statistics.pkl")
    (seen,) = env.unwrapped.envs[0]._get_obs()[None] + [0.123, 0.234, 0.5, 0.1]
    expected, _ = model.predict(env.normalize_obs(seen[None]), deterministic=True)
    np.testing.assert_allclose(agent.inputs(seen[None]), expected, atol=1e-5)
