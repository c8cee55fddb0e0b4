"""Zips from strangers are data: bombs end in a sentence, and what cannot be right is refused by name."""

import base64
import io
import json
import pickle
import struct
import sys
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch
from environments import Flat
from sentences import refused
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_agents import (
    Payload,
    members,
    packed,
    rewritten,
    saved,
    state_of,
    untrained,
    with_tensors,
    zipped,
)

import hyrl_mj
from hyrl_mj import BadArtifact, load_agent
from hyrl_mj.files import artifacts
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.policies import pickled, sb3_zip, torch_file


@pytest.fixture
def agent(circle, tmp_path):
    """A PPO agent on the unit circle."""
    return saved(untrained(PPO, circle, net_arch=[8]), tmp_path)


def with_metadata(path, **entries):
    return rewritten(path, data=json.dumps(json.loads(members(path)["data"]) | entries))


def compressed(path, **changes):
    """The zip with some members changed and all of them compressed."""
    changed = {n.replace("_pth", ".pth"): c for n, c in changes.items()}
    return zipped(path, members(path) | changed, zipfile.ZIP_DEFLATED)


# ---- sizes


@pytest.mark.parametrize(("member", "limit"), [("policy_pth", 32), ("data", 4)])
def test_a_member_that_unpacks_to_gigabytes_is_read_no_farther_than_its_limit(
    member, limit, agent, circle
):
    compressed(agent, **{member: bytes(2**26)})
    refused(agent, circle, f"unpacks to more than {limit} MiB")


def test_what_the_directory_says_of_sizes_is_not_believed(agent, circle):
    size = 2**26 + 0x12345
    content = compressed(agent, policy_pth=bytes(size)).read_bytes()
    assert content.count(struct.pack("<I", size)) == 2
    for lie in (1000, 2**24):
        agent.write_bytes(content.replace(struct.pack("<I", size), struct.pack("<I", lie)))
        refused(agent, circle, "policy.pth|cannot be read")


def test_a_directory_of_countless_members_is_refused(agent, circle):
    with zipfile.ZipFile(agent, "a") as file:
        for i in range(10_000):
            file.writestr(zipfile.ZipInfo(str(i)), b"")
    refused(agent, circle, "it has more than 10,000 members")


@pytest.mark.parametrize(
    "data", ["[" * 10**6, '{"a":' * 10**5, "1" * 10**6, '{"a": ' + "[" * 3000 + "]" * 3000 + "}"]
)
def test_metadata_of_absurd_depth_are_refused(data, agent, circle):
    refused(rewritten(agent, data=data), circle, "cannot be read")


@pytest.mark.slow
def test_texts_from_the_file_are_cut_in_messages(agent, circle):
    long = "x" * 10**6
    with_metadata(agent, policy_kwargs={"features_extractor_class": long})
    refused(agent, circle, "features extractor of its own, xxx")
    with_metadata(agent, policy_kwargs={}, action_space={"low": "1 " * 10**6, "high": "2 " * 10**6})
    refused(agent, circle, r"its inputs lie in \[1, 2\] x .*\.\.\.")


def with_pickle(path, weights, change):
    """The zip with these weights, in whose pickle something is changed."""
    parts = members(io.BytesIO(weights))
    name = next(name for name in parts if name.endswith("data.pkl"))
    changed = zipped(io.BytesIO(), parts | {name: change(parts[name])})
    return rewritten(path, policy_pth=changed.getvalue())


# (x, x) of (x, x) of ...: each tuple is twice the one that was memoised before.
DOUBLING = b")" + b"".join(b"q%ch%c\x86" % (i, i) for i in range(100))


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02" + DOUBLING + b".",
        b"\x80\x02}" + DOUBLING + b"K\x01s.",  # as a key, whose hash would take for ever
        b"\x80\x02}X\x01\x00\x00\x00a" + DOUBLING + b"s.",
        b"\x80\x04" + DOUBLING + b"\x8c\x01a\x93.",  # as the name of a function
        b"\x80\x02" + b"]" * 10**5 + b".",
        b"\x80\x02" + b"(" * 10**5 + b".",
        b"\x80\x02)" + b"\x85" * 10**5 + b".",
        b"\x80\x02}(X\x01\x00\x00\x00a\x8b" + struct.pack("<i", 10**5) + b"\x7f" * 10**5 + b"u.",
        b"\x80\x02.",
        b"\x80\x02u.",
        b"\x80\x02h\x05.",
        b"cos\nsystem\nX\x04\x00\x00\x00true\x85R.",
        b"(S'true'\nios\nsystem\n.",
    ],
)
def test_a_pickle_that_would_grow_or_call_is_refused(content, agent, circle):
    weights = members(agent)["policy.pth"]
    refused(with_pickle(agent, weights, lambda _: content), circle, "policy.pth")


def test_pickles_are_read_without_unpickling(monkeypatch):
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, None)
    call = pickled.read(b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.")
    assert (call.function, call.arguments) == ("os.system", ("true",))


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize(
    "array",
    [
        np.arange(6, dtype=np.float32).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(6, dtype=">f4").reshape(3, 2),
        np.array([True, False]),
    ],
)
def test_arrays_in_pickles_are_those_of_numpy(array, protocol):
    (found,) = pickled.arrays(pickle.dumps(array, protocol)).values()
    np.testing.assert_array_equal(found, array)
    named = pickled.arrays(pickle.dumps({"a": array, "b": "no array"}, protocol))
    assert named.keys() == {"a"}
    np.testing.assert_array_equal(named["a"], array)


def test_what_is_no_array_of_numbers_is_none(tmp_path):
    for thing in ({"a": 1}, [1.0], np.array([{}, None]), np.array(["text"]), tmp_path):
        assert pickled.arrays(pickle.dumps(thing)) == {}
    assert pickled.arrays(b"") == {}


@pytest.mark.parametrize(
    "dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int64, torch.bool]
)
def test_tensors_are_those_of_torch(dtype):
    whole = (4 * torch.randn(6, 8)).to(dtype)
    state = {"a": whole, "b": whole.T, "c": whole[1:3, ::2], "d": torch.zeros((), dtype=dtype)}
    state["e"] = torch.zeros(0, 3, dtype=dtype)
    found = torch_file.read_tensors(packed(state))
    assert list(found) == list(state)
    for name, tensor in state.items():
        theirs = tensor.float() if tensor.is_floating_point() else tensor
        np.testing.assert_array_equal(found[name], theirs.numpy())
        assert found[name].shape == tensor.shape


def test_tensors_are_read_without_torch(agent, circle, monkeypatch):
    theirs = {name: tensor.numpy() for name, tensor in state_of(agent).items()}
    monkeypatch.setitem(sys.modules, "torch", None)
    ours = load_agent(agent, circle).weights
    assert list(ours) == list(theirs)
    for name, tensor in theirs.items():
        np.testing.assert_array_equal(ours[name], tensor)


@pytest.mark.parametrize("shape", [(2**30, 2**30), (2**60,), (1,) * 60, (-1, 5), (3, 3)], ids=str)
def test_absurd_shapes_are_refused(shape, agent, circle):
    """The shape of a tensor of 8 numbers is written over by hand."""
    number = b"".join(pickle.dumps(n, 2)[2:-1] for n in shape)

    def reshaped(content):
        assert content.count(b"K\x08\x85") == 1, pickle.dumps((8,), 2)[2:-1]
        return content.replace(b"K\x08\x85", b"(" + number + b"t", 1)

    weights = packed({"x": torch.arange(8.0)})
    refused(with_pickle(agent, weights, reshaped), circle, "policy.pth")


# ---- what cannot be right


class Renorm(torch.nn.Module):
    """Has the tensors of the batch renormalisation in sb3_contrib's CrossQ."""

    def __init__(self, n):
        super().__init__()
        for name in ("ra_mean", "ra_var"):
            self.register_buffer(name, torch.ones(n))
        self.register_buffer("steps", torch.tensor(0))
        self.scale, self.bias = (torch.nn.Parameter(torch.ones(n)) for _ in range(2))


def test_crossq_is_not_taken_for_sac(circle, tmp_path):
    path = saved(untrained(SAC, circle, net_arch=[8, 8]), tmp_path)

    def normalised(state):
        layers = {0: Renorm(2), 3: Renorm(8)}
        more = {
            f"actor.latent_pi.{i}.{name}": tensor
            for i, layer in layers.items()
            for name, tensor in layer.state_dict().items()
        }
        moved = {n.replace("pi.2.", "pi.4.").replace("pi.0.", "pi.1."): t for n, t in state.items()}
        return moved | more

    refused(
        with_tensors(path, normalised), circle, r"batch renormalisation .*\(ra_mean\).*CrossQ.*onnx"
    )


@pytest.mark.parametrize(
    ("algorithm", "name"),
    [
        (PPO, "mlp_extractor.policy_net.1.running_mean"),
        (PPO, "mlp_extractor.policy_net.0.scale"),
        (PPO, "action_net.gain"),
        (PPO, "encoder.weight"),
        (SAC, "actor.latent_pi.1.gain"),
        (SAC, "actor.memory.weight"),
        (SAC, "log_std"),
        (DQN, "q_net.dueling.weight"),
    ],
)
def test_a_tensor_that_the_policy_does_not_use_is_named(algorithm, name, tmp_path):
    task = hyrl_mj.get_task("vehicle" if algorithm is DQN else "unit_circle")
    path = saved(untrained(algorithm, task, net_arch=[8]), tmp_path)
    load_agent(path, task)
    for tensor in (torch.ones(8), torch.tensor(3)):
        with_tensors(path, lambda state, tensor=tensor: {**state, name: tensor})
        refused(path, task, f"no {algorithm.__name__.lower()} policy of SB3 has its tensors {name}")


@pytest.mark.parametrize(
    ("algorithm", "low", "high"),
    [
        (PPO, "[-2.]", "[2.]"),
        (SAC, "[-0.5]", "[0.5]"),
        (PPO, "[-inf]", "[inf]"),
        (PPO, "[0.]", "[1.]"),
    ],
)
def test_an_agent_of_other_inputs_is_refused_with_both_ranges(
    algorithm, low, high, circle, tmp_path
):
    path = saved(untrained(algorithm, circle, net_arch=[8]), tmp_path)
    space = json.loads(members(path)["data"])["action_space"]
    assert (space["low"], space["high"]) == ("[-1.]", "[1.]")
    with_metadata(path, action_space=space | {"low": low, "high": high})
    theirs = rf"\[{low[1:-1].rstrip('.')}, {high[1:-1].rstrip('.')}\]"
    refused(path, circle, rf"{theirs}, those of unit_circle in \[-1, 1\]: .*RescaleAction")


def test_an_agent_of_another_number_of_levels_is_refused(vehicle, tmp_path):
    path = saved(untrained(DQN, vehicle, net_arch=[8]), tmp_path)
    space = json.loads(members(path)["data"])["action_space"]
    with_metadata(path, action_space=space | {"n": "7"})
    refused(path, vehicle, "chooses among 7 levels, vehicle has 5")


@pytest.mark.parametrize(
    ("key", "part", "value", "message"),
    [
        ("action_space", ":type:", "<class 'a.MultiDiscrete'>", "not numbers of 5 levels.*MultiD"),
        ("action_space", ":type:", "<class 'a.MultiBinary'>", "not numbers of 5 levels.*MultiB"),
        ("policy_class", "__module__", "sb3_contrib.common.maskable.policies", "a mask allows"),
    ],
)
def test_what_levels_do_not_mean_is_refused(key, part, value, message, vehicle, tmp_path):
    path = saved(untrained(PPO, vehicle, net_arch=[8]), tmp_path)
    found = json.loads(members(path)["data"])[key]
    with_metadata(path, **{key: found | {part: value}})
    refused(path, vehicle, message)


def test_sbx_is_named(agent, circle):
    about = json.loads(members(agent)["data"])
    about["policy_class"] = {":type:": "<class 'abc.ABCMeta'>", "__module__": "sbx.ppo.policies"}
    rewritten(agent, policy_pth=None, data=json.dumps(about))
    refused(agent, circle, r"an agent of SBX.*JAX.*\.onnx.*function that calls model\.predict")


# ---- VecNormalize


def trained(task, algorithm, folder, n, seed, **options):
    """A zip of an agent that was trained for a moment, under `VecNormalize(**options)` if there are any."""
    env = TaskVecEnv(BatchedEnv(task, n, threads=1))
    env.seed(seed)
    if options:
        env = VecNormalize(env, **options)
    mine = {"buffer_size": 500, "learning_starts": 10**6}
    if algorithm in (PPO, A2C):
        mine = {"n_steps": 25} | ({"batch_size": 25, "n_epochs": 1} if algorithm is PPO else {})
    model = algorithm(
        "MlpPolicy", env, seed=seed, device="cpu", policy_kwargs={"net_arch": [8]}, **mine
    )
    model.learn(75 * n)
    return saved(model, folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "name", "n"),
    [(PPO, "unit_circle", 4), (SAC, "unit_circle", 1), (PPO, "vehicle", 1), (DQN, "rover", 4)],
)
def test_an_agent_of_vecnormalize_is_refused_and_one_of_plain_observations_taken(
    algorithm, name, n, tmp_path
):
    """Also one of which the rewards alone were normalised."""
    task = hyrl_mj.get_task(name)
    path = trained(task, algorithm, tmp_path, n, 0, norm_obs=True)
    refused(path, task, r"normalised observations \(VecNormalize\).*--vecnormalize FILE")
    for options in ({}, {"norm_obs": False}):
        load_agent(trained(task, algorithm, tmp_path, n, 0, **options), task)


@pytest.mark.slow
def test_what_cannot_be_told_is_refused_with_the_way_out(tmp_path):
    task = hyrl_mj.get_task("rover")
    path = trained(task, PPO, tmp_path, 4, 0, norm_obs=False)
    refused(path, task, "nothing in it tells whether.*--vecnormalize FILE.*also for norm_obs=False")
    identity = {"mean": np.zeros(3), "var": np.ones(3), "clip": np.inf, "epsilon": 0}
    np.savez(tmp_path / "identity.npz", **identity)
    load_agent(path, task, vecnormalize=tmp_path / "identity.npz")


@pytest.mark.slow
def test_last_observations_that_cannot_be_read_tell_nothing(circle, tmp_path):
    executed = tmp_path / "executed"
    payload = pickle.dumps(Payload(executed))
    path = trained(circle, PPO, tmp_path, 1, 0, norm_obs=True)
    about = json.loads(members(path)["data"])
    for content in (payload, b"", b"\x80\x02" + DOUBLING + b".", b"\x80\x02" + b"]" * 10**5 + b"."):
        entry = {":serialized:": base64.b64encode(content).decode()}
        with_metadata(path, _last_obs=entry, _last_original_obs=about["_last_original_obs"])
        refused(path, circle, "nothing in it tells whether")
    for text in ("no base64", 3, None):
        with_metadata(path, _last_obs={":serialized:": text})
        refused(path, circle, "nothing in it tells whether")
    assert not executed.exists()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_an_agent_that_keeps_no_observation_is_not_taken_for_a_plain_one(
    algorithm, circle, tmp_path
):
    path = trained(circle, algorithm, tmp_path, 1, 0, norm_obs=True)
    about = json.loads(members(path)["data"])
    for without in ("_last_obs", "_last_original_obs"):
        left = {name: entry for name, entry in about.items() if name != without}
        refused(rewritten(path, data=json.dumps(left)), circle, "VecNormalize.*--vecnormalize none")
    load_agent(path, circle, vecnormalize="none")


@pytest.fixture(scope="module")
def pushed():
    return hyrl_mj.from_gymnasium(Flat, steps=20)


@pytest.mark.slow
@pytest.mark.parametrize("wrapped", ["plain", "VecNormalize", "NormalizeObservation"])
@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_the_type_of_observations_tells_of_wrappers(algorithm, wrapped, pushed, tmp_path):
    """Both wrappers give float32, and most environments of MuJoCo float64."""
    inside = wrapped == "NormalizeObservation"
    make = Flat if not inside else lambda: gym.wrappers.NormalizeObservation(Flat())
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(make(), 20)])
    env = VecNormalize(env) if wrapped == "VecNormalize" else env
    options = {"n_steps": 32} if algorithm is PPO else {"learning_starts": 10**6}
    model = algorithm("MlpPolicy", env, seed=0, device="cpu", **options)
    path = saved(model.learn(64), tmp_path)
    if wrapped == "plain":
        load_agent(path, pushed)
    else:
        refused(path, pushed, "normalised observations .VecNormalize.*--vecnormalize")


def test_limits_leave_room_for_large_mlps(circle, tmp_path):
    path = saved(untrained(SAC, circle, net_arch=[512, 512]), tmp_path)
    assert len(members(path)["policy.pth"]) > 5e6
    load_agent(path, circle)
    assert torch_file.LARGEST <= 2**25
    assert sb3_zip.LARGEST_METADATA <= 2**22


# ---- safetensors


def described(folder, header, data=b"", **about):
    """A `.safetensors` file with a header, and its description beside it."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    (folder / "p.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + data)
    about = {"task": "unit_circle", "algorithm": "ppo", "activation": "tanh", **about}
    artifacts.write_json(folder / "p.json", about, kind="policy")
    return folder / "p.safetensors"


def tensor(shape, start, end):
    return {"dtype": "F32", "shape": shape, "data_offsets": [start, end]}


@pytest.mark.parametrize(
    ("header", "data", "message"),
    [
        ({f"t{i}": tensor([0], 0, 0) for i in range(30_000)}, b"", "names take more than 1 MiB"),
        ({"a": tensor([2**40, 2**40], 0, 4)}, bytes(4), "cannot be read"),
        ({"a": tensor([1] * 10_000, 0, 4)}, bytes(4), "cannot be read"),
        ({f"t{i}": tensor([2], 0, 8) for i in range(9)}, bytes(8), "cannot be read"),
        ({}, bytes(2**25 + 2**20), "larger than 33 MiB"),
        (b'{"a":' + b"[" * 10**5, b"", "cannot be read"),
    ],
    ids=["many", "shape", "dimensions", "overlap", "large", "depth"],
)
def test_absurd_safetensors_are_refused(header, data, message, circle, tmp_path):
    refused(described(tmp_path, header, data), circle, message)


def test_a_header_that_lies_about_its_length_is_refused(circle, tmp_path):
    path = described(tmp_path, {})
    for length in (2**63, 2**40, 2**21):
        path.write_bytes(struct.pack("<Q", length) + b"{}")
        refused(path, circle, "names take more than 1 MiB")


def test_a_description_names_a_task_by_its_name_only(circle, tmp_path):
    network = load_agent(saved(untrained(PPO, circle, net_arch=[8]), tmp_path), circle)
    network.save(tmp_path / "p.safetensors")
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')\n")
    for name in (
        str(tmp_path / "evil.py"),
        "evil.py",
        "evil",
        "os:system",
        3,
        None,
        ["unit_circle"],
    ):
        about = {"task": name, "algorithm": "ppo", "activation": "tanh"}
        artifacts.write_json(tmp_path / "p.json", about, kind="policy")
        for task in (circle, None):
            with pytest.raises(BadArtifact, match=r"p\.json"):
                hyrl_mj.MlpPolicy.load(tmp_path / "p.safetensors", task)
        with pytest.raises(BadArtifact, match=r"p\.json"):
            load_agent(tmp_path / "p.safetensors", circle)
    for algorithm in ("evil:X", "os:system"):
        about = {"task": "unit_circle", "algorithm": algorithm, "activation": "tanh"}
        artifacts.write_json(tmp_path / "p.json", about, kind="policy")
        with pytest.raises(BadArtifact, match=r"algorithm '.*' of the policy is unknown"):
            load_agent(tmp_path / "p.safetensors", circle)
    assert not (tmp_path / "executed").exists()
