"""Agents that were trained elsewhere act here as they do there, and nothing in their files is executed."""

import base64
import io
import json
import pickle
import sys
import zipfile

import numpy as np
import pytest
import torch
from planted import Payload, random_states
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, MlpPolicy, from_callable, load_agent
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.training import build
from hyrl_mj.policies.external import read_agent
from hyrl_mj.policies.mlp import ACTIVATIONS, TORCH_NAMES, SampledPolicy
from hyrl_mj.tasks.unit_circle import UnitCircle

OFF_POLICY = (DQN, SAC, TD3, DDPG)
DEFAULT = {PPO: "tanh", A2C: "tanh", DQN: "relu", SAC: "relu", TD3: "relu", DDPG: "relu"}


def untrained(algorithm, task, wrap=lambda env: env, **kwargs):
    """An SB3 algorithm on a task, with random weights that use the whole range of its inputs."""
    options = {"buffer_size": 10} if algorithm in OFF_POLICY else {}
    env = wrap(TaskVecEnv(BatchedEnv(task, 1)))
    model = algorithm("MlpPolicy", env, seed=0, device="cpu", policy_kwargs=kwargs, **options)
    for parameter in model.policy.parameters():
        parameter.data = 1.5 * torch.randn(parameter.shape) / parameter.shape[-1] ** 0.5
    return model


def saved(model, folder):
    model.save(folder / "agent.zip")
    return folder / "agent.zip"


def members(path):
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def zipped(file, content, packing=zipfile.ZIP_STORED):
    """Writes a zip of its members by name, but for those that are None."""
    with zipfile.ZipFile(file, "w", packing) as archive:
        for name, data in content.items():
            if data is not None:
                archive.writestr(name, data)
    return file


def rewritten(path, **changes):
    """The zip with some of its members changed, "_" standing for the dot; None takes one away."""
    changed = {name.replace("policy_pth", "policy.pth"): c for name, c in changes.items()}
    return zipped(path, members(path) | changed)


def state_of(path):
    return torch.load(io.BytesIO(members(path)["policy.pth"]), weights_only=True)


def packed(state):
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def with_tensors(path, change):
    """The zip with other tensors: `change` is given their dictionary and returns one."""
    return rewritten(path, policy_pth=packed(change(state_of(path))))


def observations(task, n=3000):
    return np.random.default_rng(0).normal(scale=3, size=(n, len(task.observation_low)))


def assert_it_acts_alike(policy, model, task, observation):
    theirs, _ = model.predict(observation.astype(np.float32), deterministic=True)
    ours = policy.inputs(observation)
    assert ours.shape == (len(observation), len(task.inputs))
    assert len(np.unique(ours)) > 1
    if task.input_levels is not None:
        np.testing.assert_array_equal(ours, task.input_levels[theirs])
    else:
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-5)


@pytest.fixture
def agent(circle, tmp_path):
    """A PPO agent on the unit circle."""
    return saved(untrained(PPO, circle), tmp_path)


# ---- SB3


@pytest.mark.parametrize(
    ("algorithm", "name", "kwargs"),
    [
        (PPO, "unit_circle", {}),
        (PPO, "vehicle", {"net_arch": {"pi": [16], "vf": [8, 8]}, "activation_fn": nn.ReLU}),
        (PPO, "unit_circle", {"net_arch": []}),
        (A2C, "unit_circle", {"net_arch": [24, 12, 6], "activation_fn": nn.ELU}),
        (A2C, "vehicle", {}),
        (DQN, "vehicle", {}),
        (DQN, "vehicle", {"net_arch": [32], "activation_fn": nn.LeakyReLU}),
        (SAC, "unit_circle", {"net_arch": [32, 16]}),
        (SAC, "unit_circle", {"net_arch": [16] * 12, "activation_fn": nn.Tanh}),
        (TD3, "unit_circle", {"net_arch": {"pi": [20, 10], "qf": [8]}, "activation_fn": nn.SiLU}),
        (DDPG, "unit_circle", {"net_arch": [20], "activation_fn": nn.GELU}),
    ],
)
def test_an_agent_acts_as_in_sb3(algorithm, name, kwargs, tmp_path):
    task = hyrl_mj.get_task(name)
    model = untrained(algorithm, task, **kwargs)
    policy = load_agent(saved(model, tmp_path), task)
    assert isinstance(policy, MlpPolicy)
    assert policy.algorithm == algorithm.__name__.lower()
    assert_it_acts_alike(policy, model, task, observations(task))
    measured = random_states(task, 20, np.random.default_rng(1))
    np.testing.assert_array_equal(policy.act(measured), policy.inputs(task.observation(measured)))


class Lopsided(UnitCircle):
    """The unit circle with other limits to one side than to the other."""

    input_limits = np.array([-0.5]), np.array([3.0])


@pytest.mark.parametrize("algorithm", [PPO, SAC, TD3, DDPG])
def test_inputs_are_stretched_to_the_limits_of_the_task(algorithm, tmp_path):
    task = Lopsided()
    model = untrained(algorithm, task, net_arch=[16], activation_fn=nn.Tanh)
    policy = load_agent(saved(model, tmp_path), task)
    assert_it_acts_alike(policy, model, task, observations(task))
    u = policy.inputs(observations(task))
    assert -0.5 <= u.min() < 0 < 1 < u.max() <= 3
    # A policy of SB3 is a module whose forward() draws, or gives numbers between -1 and 1.
    for part in (model, model.policy):
        assert_it_acts_alike(from_callable(part, task), model, task, observations(task))


def test_a_policy_that_takes_observations_by_its_name_is_refused(vehicle):
    class Steers:
        def act(self, observations):
            return np.sign(observations[:, 1:2])

    for use in (read_agent, lambda task, agent: hyrl_mj.simulate(task, agent, [0.0, 0.1])):
        with pytest.raises(
            BadInput, match=r"act\(observations\) .*from_callable\(agent\.act, task\)"
        ):
            use(vehicle, Steers())


class Mirrored(ActorCriticPolicy):
    def get_distribution(self, obs):
        return super().get_distribution(-obs)


class Halved(SACPolicy):
    def _predict(self, observation, deterministic=False):
        return super()._predict(0.5 * observation, deterministic)


@pytest.mark.parametrize(("algorithm", "policy"), [(PPO, Mirrored), (SAC, Halved)])
def test_a_policy_class_of_one_s_own_is_refused(algorithm, policy, circle, tmp_path):
    model = algorithm(policy, TaskVecEnv(BatchedEnv(circle, 1)), device="cpu")
    with pytest.raises(BadInput, match="its policy is of a class of its own"):
        load_agent(saved(model, tmp_path), circle)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_every_activation_is_the_one_of_torch(activation):
    x = np.linspace(-200, 200, 4001, dtype=np.float32)
    theirs = getattr(nn, TORCH_NAMES[activation])()(torch.from_numpy(x)).numpy()
    ours = ACTIVATIONS[activation](x)
    assert ours.dtype == np.float32
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3, DDPG])
def test_a_zip_that_holds_nothing_but_weights_has_the_default_activation(
    algorithm, circle, tmp_path
):
    model = untrained(algorithm, circle, net_arch=[16])
    path = saved(model, tmp_path)
    rewritten(path, **{name: None for name in members(path) if name != "policy.pth"})
    with pytest.raises(BadArtifact, match=r"nothing in it tells whether .*--vecnormalize none if"):
        load_agent(path, circle)
    policy = load_agent(path, circle, vecnormalize="none")
    assert policy.activation == DEFAULT[algorithm]
    assert_it_acts_alike(policy, model, circle, observations(circle))


def test_the_activation_can_be_given_where_the_file_does_not_say(circle, tmp_path):
    model = untrained(PPO, circle, activation_fn=nn.ELU)
    path = rewritten(saved(model, tmp_path), data=None)
    policy = load_agent(path, circle, activation="elu", vecnormalize="none")
    assert_it_acts_alike(policy, model, circle, observations(circle))


def test_a_zip_of_sb3_1_with_shared_layers_acts_as_it_did(vehicle, tmp_path):
    model = untrained(PPO, vehicle, net_arch={"pi": [16, 12, 8], "vf": [16, 12, 4]})
    path = saved(model, tmp_path)

    def share_two_layers(state):
        old = {}
        for name, tensor in state.items():
            for i, new in ((0, "shared_net.0"), (2, "shared_net.2"), (4, "policy_net.0")):
                name = name.replace(f"policy_net.{i}.", f"{new}.")
            if ".value_net.0" not in name and ".value_net.2" not in name:
                old[name.replace("value_net.4", "value_net.0")] = tensor
        return old

    with_tensors(path, share_two_layers)
    assert "mlp_extractor.shared_net.2.weight" in state_of(path)
    policy = load_agent(path, vehicle)
    assert policy.hidden == (16, 12, 8)
    assert_it_acts_alike(policy, model, vehicle, observations(vehicle))


@pytest.mark.slow
def test_training_goes_on_from_an_agent_of_the_same_networks_only(circle, tmp_path):
    settings = preset(circle, "smoke").stage1
    agent = load_agent(saved(untrained(A2C, circle, activation_fn=nn.SiLU), tmp_path), circle)
    assert build(circle, settings, 0, start_from=agent).policy.activation_fn is nn.SiLU
    agent = load_agent(saved(untrained(SAC, circle), tmp_path), circle)
    with pytest.raises(BadInput, match="ppo cannot go on from this sac policy"):
        build(circle, settings, 0, start_from=agent)


# ---- drawing


@pytest.mark.parametrize(
    ("algorithm", "name"), [(PPO, "unit_circle"), (A2C, "vehicle"), (SAC, "unit_circle")]
)
def test_it_draws_from_sb3s_distribution(algorithm, name, tmp_path):
    task = hyrl_mj.get_task(name)
    model = untrained(algorithm, task, net_arch=[16])
    policy = load_agent(saved(model, tmp_path), task, stochastic=True)
    observation = np.repeat(observations(task, 5), 20_000, axis=0)
    torch.manual_seed(0)
    theirs, _ = model.predict(observation.astype(np.float32), deterministic=False)
    theirs = task.input_levels[theirs] if task.input_levels is not None else theirs
    ours = policy.inputs(observation)
    for moment in (np.mean, np.std):
        expected, found = (moment(x.reshape(5, -1), axis=1) for x in (theirs, ours))
        np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.slow
def test_the_same_seed_draws_the_same_inputs_call_by_call(agent, circle):
    first, second, other = (load_agent(agent, circle, stochastic=True, seed=s) for s in (3, 3, 4))
    assert isinstance(first, SampledPolicy)
    measured = random_states(circle, 50, np.random.default_rng(0))
    calls = [first.act(measured) for _ in range(3)]
    np.testing.assert_array_equal(calls, [second.act(measured) for _ in range(3)])
    assert (calls[0] != calls[1]).any()
    assert (calls[0] != other.act(measured)).any()


@pytest.mark.parametrize(
    ("algorithm", "name"), [(DQN, "vehicle"), (TD3, "unit_circle"), (DDPG, "unit_circle")]
)
def test_what_has_no_distribution_is_not_drawn_from(algorithm, name, tmp_path):
    task = hyrl_mj.get_task(name)
    path = saved(untrained(algorithm, task, net_arch=[8]), tmp_path)
    with pytest.raises(
        BadInput, match=f"a {algorithm.__name__.lower()} policy has no distribution"
    ):
        load_agent(path, task, stochastic=True)


# ---- files that are somebody else's


@pytest.fixture
def trap(tmp_path):
    """The file that appears once anything malicious has been unpickled, and a pickle that does it."""
    path = tmp_path / "executed"
    payload = pickle.dumps(Payload(path))
    pickle.loads(payload)
    assert path.exists()  # the trap works
    path.unlink()
    return path, payload


def mined(path, payload):
    """The zip with payloads in everything that SB3 would unpickle, but for policy.pth."""
    about = json.loads(members(path)["data"])
    for entry in about.values():
        if isinstance(entry, dict):
            entry[":serialized:"] = base64.b64encode(payload).decode()
    others = [name for name in members(path) if name.endswith(".pth") and name != "policy.pth"]
    return rewritten(path, data=json.dumps(about), **dict.fromkeys(others, payload))


@pytest.mark.parametrize("algorithm", DEFAULT)
def test_a_malicious_agent_is_read_without_executing_anything(algorithm, tmp_path, trap):
    executed, payload = trap
    task = hyrl_mj.get_task("vehicle" if algorithm is DQN else "unit_circle")
    model = untrained(algorithm, task, net_arch=[8], activation_fn=nn.ELU)
    path = mined(saved(model, tmp_path), payload)
    assert members(path)["pytorch_variables.pth"] == payload
    policy = load_agent(path, task)
    assert_it_acts_alike(policy, model, task, observations(task, 200))
    for weights in (payload, packed({**state_of(path), "more": Payload(executed)})):
        rewritten(path, policy_pth=weights)
        with pytest.raises(BadArtifact, match="damaged or holds more than tensors") as error:
            load_agent(path, task)
        assert "weights_only" not in str(error.value)
        assert len(str(error.value).splitlines()) == 1
    assert not executed.exists()


@pytest.mark.parametrize(
    "weights",
    [b"", b"PK\x03\x04", packed([1, 2]), packed(torch.zeros(3)), packed({"x": 1})],
    ids=["empty", "torn", "list", "tensor", "numbers"],
)
def test_a_damaged_policy_is_refused(agent, circle, weights):
    with pytest.raises(BadArtifact, match=r"agent\.zip"):
        load_agent(rewritten(agent, policy_pth=weights), circle)


def test_a_torn_zip_is_refused(agent, circle):
    content = agent.read_bytes()
    for part in (0.1, 0.5, 0.9, 0.999):
        agent.write_bytes(content[: int(part * len(content))])
        with pytest.raises(BadArtifact, match=r"agent\.zip"):
            load_agent(agent, circle)


@pytest.mark.slow
def test_tensors_that_unpack_to_gigabytes_are_refused(agent, circle):
    endless = torch.zeros(1).as_strided((100_000, 100_000), (0, 0))
    with_tensors(agent, lambda state: {**state, "action_net.weight": endless})
    with pytest.raises(BadArtifact, match="too large"):
        load_agent(agent, circle)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("archive/data.pkl", bytes(2**28 + 1))
    with pytest.raises(BadArtifact, match="is compressed"):
        load_agent(rewritten(agent, policy_pth=buffer.getvalue()), circle)


def test_what_is_no_agent_is_named(agent, circle, tmp_path):
    with pytest.raises(BadArtifact, match=r"there is no file .*none\.zip: give the zip"):
        load_agent(tmp_path / "none.zip", circle)
    (tmp_path / "text.zip").write_text("not a zip")
    with pytest.raises(BadArtifact, match=r"text\.zip: it is not a zip"):
        load_agent(tmp_path / "text.zip", circle)
    with pytest.raises(BadArtifact, match=r"it has no policy\.pth"):
        load_agent(rewritten(agent, policy_pth=None), circle)


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_an_agent_with_state_dependent_exploration_is_refused(algorithm, circle, tmp_path):
    options = {"buffer_size": 10} if algorithm is SAC else {}
    env = TaskVecEnv(BatchedEnv(circle, 1))
    model = algorithm("MlpPolicy", env, device="cpu", use_sde=True, **options)
    with pytest.raises(BadArtifact, match="use_sde"):
        load_agent(saved(model, tmp_path), circle)


def add(name):
    return lambda state: {**state, name: torch.zeros(2, 2)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (add("features_extractor.cnn.0.weight"), "CNN policy"),
        (add("pi_features_extractor.cnn.0.weight"), "CNN policy"),
        (add("features_extractor.extractors.image.cnn.0.weight"), "observations are a dict"),
        (add("features_extractor.layer.weight"), "features extractor of its own"),
        (add("lstm_actor.weight_ih_l0"), "recurrent policy .* give the model itself"),
        (add("mlp_extractor.policy_net.1.weight"), "no linear layer with a bias"),
        (lambda state: {"encoder.weight": torch.zeros(2, 2)}, r"its tensors \(encoder.weight\)"),
        (lambda state: {n: t for n, t in state.items() if n != "action_net.bias"}, "with a bias"),
        (lambda state: {n: t * np.nan for n, t in state.items()}, "not finite"),
        (lambda state: {n: t for n, t in state.items() if n != "log_std"}, "discrete levels"),
    ],
)
def test_networks_that_are_no_plain_mlp_are_refused(agent, circle, change, message):
    with pytest.raises(BadArtifact, match=message):
        load_agent(with_tensors(agent, change), circle)


def about(path, **changes):
    """The zip with other metadata; `changes` are merged into its entries."""
    entries = json.loads(members(path)["data"])
    for key, parts in changes.items():
        entries[key] = {**entries[key], **parts}
    return rewritten(path, data=json.dumps(entries))


@pytest.mark.parametrize(
    ("key", "part", "message"),
    [
        (
            "observation_space",
            {":type:": "<class 'gym.spaces.dict.Dict'>"},
            "observations are a Dict",
        ),
        ("policy_kwargs", {"features_extractor_class": "<class 'mine.Extractor'>"}, r"mine\.Extr"),
        (
            "policy_kwargs",
            {"activation_fn": "<class 'torch.nn.modules.activation.Softplus'>"},
            "Softplus.* is none of relu, tanh, elu",
        ),
    ],
)
def test_metadata_of_what_is_no_plain_mlp_is_heeded(agent, circle, key, part, message):
    with pytest.raises(BadArtifact, match=message):
        load_agent(about(agent, **{key: part}), circle)


def test_metadata_that_cannot_be_read_is_named(agent, circle):
    for data in ("[1]", "{", b"\xff\xfe\x00"):
        with pytest.raises(BadArtifact, match=r"agent\.zip"):
            load_agent(rewritten(agent, data=data), circle)
    # Entries of another shape than SB3's are no entries.
    unusual = '{"policy_kwargs": [], "observation_space": 3, "num_timesteps": 0}'
    load_agent(rewritten(agent, data=unusual), circle)


def test_an_activation_that_cannot_be_is_refused(agent, circle, tmp_path):
    with pytest.raises(BadInput, match=r"unknown activation 'rely'.*Did you mean 'relu'"):
        load_agent(agent, circle, activation="rely")
    path = saved(untrained(PPO, circle, activation_fn=nn.ReLU), tmp_path)
    with pytest.raises(BadArtifact, match="is 'relu', not 'tanh'"):
        load_agent(path, circle, activation="tanh")
    partial = "functools.partial(<class 'torch.nn.modules.activation.{}'>, {}"
    own = {"activation_fn": partial.format("LeakyReLU", "0.3)")}  # another slope
    with pytest.raises(BadArtifact, match=r"0\.3\) is none of relu, .* with torch's defaults"):
        load_agent(rewritten(agent, data=json.dumps({"policy_kwargs": own})), circle, "leaky_relu")
    own = {"activation_fn": partial.format("ReLU", "inplace=True)")}
    about = {"policy_kwargs": own, "num_timesteps": 0}
    assert load_agent(rewritten(agent, data=json.dumps(about)), circle).activation == "relu"
    with pytest.raises(BadInput, match="seed -1"):
        load_agent(agent, circle, stochastic=True, seed=-1)


@pytest.mark.parametrize(
    ("algorithm", "trained_on", "used_on", "message"),
    [
        (PPO, "unit_circle", "vehicle", "continuous inputs, the task vehicle takes one of 5"),
        (SAC, "unit_circle", "vehicle", "continuous inputs, the task vehicle takes one of 5"),
        (A2C, "vehicle", "unit_circle", "discrete levels, the task unit_circle takes continuous"),
        (DQN, "vehicle", "unit_circle", "discrete levels, the task unit_circle takes continuous"),
        (TD3, "unit_circle", "puck", r"takes 2 and gives 1 numbers, the task puck needs \d and \d"),
    ],
)
def test_an_agent_of_another_task_is_refused(
    algorithm, trained_on, used_on, message, puck, tmp_path
):
    tasks = {"puck": puck} | {n: hyrl_mj.get_task(n) for n in ("unit_circle", "vehicle")}
    path = saved(untrained(algorithm, tasks[trained_on], net_arch=[8]), tmp_path)
    with pytest.raises(BadArtifact, match=message):
        load_agent(path, tasks[used_on])


# ---- functions


def test_a_function_is_a_policy(circle, vehicle):
    seen = []

    def clockwise(observation):
        seen.append(observation)
        return -5 * np.ones((len(observation), 1))

    policy = from_callable(clockwise, circle)
    assert isinstance(policy, hyrl_mj.Policy)
    measured = random_states(circle, 7, np.random.default_rng(0))
    np.testing.assert_array_equal(policy.act(measured), -np.ones((7, 1)))  # clipped
    np.testing.assert_array_equal(seen[0], circle.observation(measured).astype(np.float32))
    assert policy.act(measured[:0]).shape == (0, 1)

    for kind in (int, object):
        steer = from_callable(
            lambda o, kind=kind: np.where(o[:, 2] > 0, 4, 0).astype(kind), vehicle
        )
        u = steer.act(np.array([[0.0, 0.3], [0.0, -0.3]]))
        np.testing.assert_array_equal(u, [[1.0], [-1.0]])
    ruled_out = np.array([[-np.inf, 1.0, 2.0, 0.0, -np.inf]])
    assert from_callable(lambda o: ruled_out, vehicle).act(np.zeros((1, 2))).item() == 0.0
    arc = hyrl_mj.simulate(vehicle, steer, [0.0, 0.3], horizon=0.5)
    assert arc.z[-1, 1] > 0.3


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        (
            "unit_circle",
            lambda o: np.zeros(len(o)),
            r"shape \(4,\) for 4 .* inputs of shape \(4, 1\)",
        ),
        ("unit_circle", lambda o: o, r"shape \(4, 2\) for 4 "),
        ("unit_circle", lambda o: o[:1, :1], r"shape \(1, 1\) for 4 "),
        ("unit_circle", lambda o: None, r"gives a NoneType of shape \(\)"),
        ("unit_circle", lambda o: {"action": o}, r"gives a dict of shape \(\)"),
        ("unit_circle", lambda o: o[:, :1].astype(str), "gives np.str_.*: an input is a number"),
        ("unit_circle", lambda o: o[:, :1].astype("m8[s]"), "timedelta.*: an input is a number"),
        ("unit_circle", lambda o: np.ma.array(o[:, :1], mask=True), "masks some of its numbers"),
        ("vehicle", lambda o: np.ma.array(np.eye(5)[:4], mask=np.eye(5)[:4]), "masks some of its"),
        ("vehicle", lambda o: np.full((len(o), 5), -np.inf), "preference is not a finite number"),
        ("unit_circle", lambda o: o[:, :1] * np.nan, "gives nan"),
        ("unit_circle", lambda o: np.full((len(o), 1), "left"), "'left'.*: an input is a number"),
        ("unit_circle", lambda o: 1 / 0, "raised ZeroDivisionError: division by zero"),
        ("vehicle", lambda o: np.full(len(o), 5), "action 5 .* integers from 0 to 4"),
        ("vehicle", lambda o: np.full(len(o), -1), "action -1 .* integers from 0 to 4"),
        ("vehicle", lambda o: np.full(len(o), 0.5), r"action 0\.5 .* integers from 0 to 4"),
        ("vehicle", lambda o: np.full((len(o), 1), 1), r"integers of shape \(4,\)"),
    ],
)
def test_a_function_that_gives_no_inputs_is_named(name, function, message):
    task = hyrl_mj.get_task(name)
    policy = from_callable(function, task)
    with pytest.raises(BadInput, match=message) as error:
        policy.act(random_states(task, 4, np.random.default_rng(0)))
    assert len(str(error.value).splitlines()) == 1


# ---- ONNX


def onnx_file(folder, weight, bias, rows="n", integers=False, dtype=np.float32, squashed=False):
    """An ONNX file of a linear layer, (n, k) -> (n, m); with `integers` the number of the greatest.

    If it is `squashed`, Tanh follows, and then the shape that it has already.
    """
    import onnx

    kind = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    nodes = [onnx.helper.make_node("Gemm", ["o", "w", "b"], ["linear"], transB=1)]
    given = onnx.helper.make_tensor_value_info("o", kind, [rows, weight.shape[1]])
    out = onnx.helper.make_tensor_value_info("linear", kind, [rows, weight.shape[0]])
    if integers:
        nodes.append(onnx.helper.make_node("ArgMax", ["linear"], ["best"], axis=1, keepdims=0))
        out = onnx.helper.make_tensor_value_info("best", onnx.TensorProto.INT64, [rows])
    if squashed:
        nodes.append(onnx.helper.make_node("Tanh", ["linear"], ["tanh"]))
        nodes.append(onnx.helper.make_node("Flatten", ["tanh"], ["flat"]))
        out = onnx.helper.make_tensor_value_info("flat", kind, [rows, weight.shape[0]])
    tensors = [
        onnx.numpy_helper.from_array(value.astype(dtype), name)
        for value, name in ((weight, "w"), (bias, "b"))
    ]
    graph = onnx.helper.make_graph(nodes, "policy", [given], [out], tensors)
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, ir_version=8, opset_imports=opset), folder / "a.onnx")
    return folder / "a.onnx"


@pytest.fixture
def numbers():
    return np.random.default_rng(0)


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "observed"), [("n", ""), (1, ""), ("n", "float64")])
def test_an_onnx_model_acts(rows, observed, circle, numbers, tmp_path, monkeypatch):
    # As of the environments of Gymnasium that MuJoCo simulates.
    monkeypatch.setattr(type(circle), "observation_dtype", observed)
    weight, bias = numbers.normal(size=(1, 2)), numbers.normal(size=1)
    policy = load_agent(onnx_file(tmp_path, weight, bias, rows), circle)
    observation = observations(circle, 200)
    expected = np.clip(observation @ weight.T + bias, *circle.input_limits)
    np.testing.assert_allclose(policy.inputs(observation), expected, atol=1e-5)
    assert policy.act(np.zeros((1, 1))).shape == (1, 1)


@pytest.mark.slow
def test_an_onnx_model_that_ends_in_tanh_has_inputs_between_one_and_minus_one(
    circle, numbers, tmp_path
):
    weight, bias = numbers.normal(size=(1, 2)), numbers.normal(size=1)
    path = onnx_file(tmp_path, weight, bias, squashed=True)
    expected = np.tanh(observations(circle) @ weight.T + bias)
    np.testing.assert_allclose(
        load_agent(path, circle).inputs(observations(circle)), expected, atol=1e-5
    )
    with pytest.raises(
        BadArtifact, match=r"ends in Tanh, .* inputs of unit_circle lie between \[-0"
    ):
        load_agent(path, Lopsided())


@pytest.mark.parametrize("integers", [False, True])
def test_an_onnx_model_of_a_discrete_task_acts(integers, vehicle, numbers, tmp_path):
    weight, bias = numbers.normal(size=(5, 3)), numbers.normal(size=5)
    policy = load_agent(onnx_file(tmp_path, weight, bias, integers=integers), vehicle)
    observation = observations(vehicle, 200)
    expected = vehicle.input_levels[(observation @ weight.T + bias).argmax(axis=1)]
    np.testing.assert_array_equal(policy.inputs(observation), expected)


@pytest.mark.parametrize(
    ("name", "shape", "options", "message"),
    [
        ("unit_circle", (1, 3), {}, "takes 3 numbers, an observation of unit_circle has 2"),
        ("unit_circle", (2, 2), {}, r"shape \(2, 2\) .* inputs of shape \(2, 1\)"),
        ("unit_circle", (5, 2), {"integers": True}, r"inputs of shape \(2, 1\)"),
        ("unit_circle", (1, 2), {"rows": 8}, "takes 8 observations at a time"),
        ("unit_circle", (1, 2), {"dtype": np.float64}, r"double.* observations \(n, 2\) float32"),
        ("vehicle", (4, 3), {}, r"preferences of shape \(n, 5\) .* got float32 of shape \(2, 4\)"),
    ],
)
def test_an_onnx_model_that_does_not_fit_is_refused(
    name, shape, options, message, numbers, tmp_path
):
    path = onnx_file(tmp_path, numbers.normal(size=shape), np.zeros(shape[0]), **options)
    with pytest.raises(BadArtifact, match=message) as error:
        load_agent(path, hyrl_mj.get_task(name))
    assert "a.onnx" in str(error.value)


def test_weights_of_an_onnx_model_that_are_not_finite_are_refused(circle, vehicle, tmp_path):
    with pytest.raises(BadArtifact, match="gives nan"):
        load_agent(onnx_file(tmp_path, np.full((1, 2), np.nan), np.zeros(1)), circle)
    with pytest.raises(BadArtifact, match="preference is not a finite number"):
        load_agent(onnx_file(tmp_path, np.full((5, 3), np.nan), np.zeros(5)), vehicle)


def test_a_damaged_onnx_file_is_refused(circle, tmp_path):
    path = tmp_path / "a.onnx"
    with pytest.raises(BadArtifact, match=r"there is no file .*a\.onnx"):
        load_agent(path, circle)
    for content in (b"", b"not a model"):
        path.write_bytes(content)
        with pytest.raises(BadArtifact, match=r"a\.onnx cannot be read"):
            load_agent(path, circle)
    with pytest.raises(BadInput, match="neither an activation nor stochastic"):
        load_agent(path, circle, stochastic=True)


def test_a_missing_onnxruntime_is_named(circle, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(BadInput, match=r'pip install "hyrl-mj\[onnx\]"'):
        load_agent(tmp_path / "a.onnx", circle)
