"""Agents that were trained elsewhere: diagnosed, and made robust."""

import json
import pickle
import shutil
import zipfile
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from command_line import call, contents
from gl import needs_gl
from planted import circle_policy, few_noises, without_videos
from sentences import assert_has_ended
from stable_baselines3 import DQN, PPO
from test_agents import onnx_file, rewritten, saved, untrained

import hyrl_mj
from hyrl_mj import BadInput, MlpPolicy
from hyrl_mj.files import artifacts, manifest
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.judging.game.lattice import Lattice
from hyrl_mj.judging.game.limit import Limit
from hyrl_mj.learning import training
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.settings import Settings
from hyrl_mj.pipeline.steps import STAGES
from hyrl_mj.policies.external import read_agent, reopen_agent
from hyrl_mj.runs.arcs import noisy_arcs
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages import Partition, boundary, open_ways, with_room
from hyrl_mj.stages.grounds import ByGame, Judged, mode_ground
from hyrl_mj.stages.retraining import retrain, start_policy

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_runs")]  # whole runs on agents

SMOKE = {"preset": "smoke", "say": str}


def away(observation):
    """Turns away from the far side of the circle: a decision at pi."""
    return np.where(observation[:, 1:] >= 0, -1.0, 1.0)


def off_centre(observation):
    """The same, but the decision lies elsewhere."""
    angle = np.arctan2(observation[:, 1:], observation[:, :1]) % (2 * np.pi)
    return np.where(angle < 2.5, -1.0, 1.0)


def one_way(observation):
    """Turns clockwise until it is there: nothing to decide."""
    angle = np.arctan2(observation[:, 1:], observation[:, :1]) % (2 * np.pi)
    return np.clip(-5 * angle, -1, 1)


def make_dqn(folder):
    """Saves, by SB3 itself, a DQN agent of the vehicle that has learned something."""
    vehicle = hyrl_mj.get_task("vehicle")
    settings = replace(preset(vehicle, "smoke").stage1, samples=10_000)
    learned = training.train(vehicle, settings, seed=0)
    env = TaskVecEnv(BatchedEnv(vehicle, 1))
    model = DQN("MlpPolicy", env, policy_kwargs={"net_arch": list(learned.hidden)}, buffer_size=10)
    state = {name: training.torch.as_tensor(np.array(w)) for name, w in learned.weights.items()}
    model.policy.load_state_dict(state)
    saved(model, folder)


def make_robust(folder):
    """Makes a whole run on such an agent by the command line, after a diagnosis in the same folder."""
    make_dqn(folder)
    path = folder / "run"
    options = ["vehicle", "--policy", folder / "agent.zip", "--preset", "smoke", "--out", path]
    with pytest.MonkeyPatch.context() as patch:
        few_noises(patch)
        diagnosed = call("diagnose", *options)
        assert diagnosed.returncode == 0, diagnosed.stderr
        before = contents(path)
        done = call("robustify", *options)
    assert_has_ended(done)
    (folder / "told").write_bytes(pickle.dumps((diagnosed.stdout, before, done.stdout)))


@pytest.fixture(scope="module")
def robust(small_runs, made_once):
    folder = made_once("robust", make_robust)
    return folder / "run", *pickle.loads((folder / "told").read_bytes())


@pytest.fixture(scope="module")
def dqn(robust):
    return robust[0].parent / "agent.zip"


@pytest.fixture(scope="module")
def circle_run(small_runs, tmp_path_factory):
    """A whole run on a function, but for its video."""
    path = tmp_path_factory.mktemp("runs") / "circle"
    with pytest.MonkeyPatch.context() as patch:
        few_noises(patch)
        without_videos(patch)
        return hyrl_mj.robustify("unit_circle", off_centre, out=path, **SMOKE)


# ---- whole runs


def test_an_sb3_agent_is_diagnosed_and_then_made_robust(robust, dqn):
    path, diagnosed, before, said = robust
    assert "critical set of" in diagnosed
    assert "of the winnable starts" in diagnosed
    assert f"{dqn} (DQN) is given" in said
    for stage in ("critical-set", "partition"):
        assert f"{stage}: done before" in said
    after = contents(path)
    kept = before.keys() - {path / manifest.NAME}
    assert {p: after[p] for p in kept} == {p: before[p] for p in kept}, (
        "the diagnosis stays as it was"
    )
    run = hyrl_mj.load_run(path)
    assert run.controller.modes == (0, 1)
    assert (path / "report.html").is_file()
    assert not list(path.rglob("*.partial*"))
    settings = json.loads((path / "config.json").read_text())["settings"]["stage1"]
    assert settings["source"] == str(dqn)
    assert settings["algorithm"] == "dqn"


def test_the_agent_acts_in_the_run_as_in_its_file(robust, dqn, vehicle):
    policy = hyrl_mj.load_agent(dqn, vehicle)
    measured = np.random.default_rng(0).uniform(vehicle.chart.low, vehicle.chart.high, (500, 2))
    np.testing.assert_array_equal(
        hyrl_mj.load_run(robust[0]).policy.act(measured), policy.act(measured)
    )


@needs_gl
def test_a_diagnosis_shows_a_run_that_is_lost(robust, vehicle):
    path, diagnosed, *_ = robust
    arc = hyrl_mj.HybridArc.load(path / "diagnosis" / "worst.npz")
    assert arc.outcome != "reached"
    assert arc.noise == "worst"
    off = arc.measured[:-1] - arc.z[:-1]
    assert np.abs(off).max() <= 0.1 + 1e-9
    names = ("overview", "policy", "robustness_map", "robustness_curve")
    assert all((path / "diagnosis" / f"{name}.png").is_file() for name in names)
    page = (path / "diagnosis.html").read_text()
    assert f"from {vehicle.chart.format(arc.z[0])} it ends" in diagnosed
    assert page.count('<img src="data:image/png') == len(names)
    assert f"hyrl-mj robustify vehicle --policy {path.anchor}" in page


def test_a_diagnosis_trains_nothing(robust):
    names = {p.name for p in robust[2]}
    assert not [n for n in names if n.startswith(("mode_", "robustness.npz", "extended"))]
    assert "checkpoint.safetensors" not in names


def test_the_report_says_that_the_policy_was_given(robust, dqn):
    page = (robust[0] / "report.html").read_text()
    assert "The policy was trained elsewhere" in page
    assert "A policy was trained by" not in page
    assert f"hyrl-mj robustify vehicle --policy {dqn} --activation relu --eps 0.1" in page
    assert "The settings of this run are not those" not in page


def test_again_nothing_is_done_again_whatever_the_age_of_the_file(robust, dqn, tmp_path):
    path = shutil.copytree(robust[0], tmp_path / "run")
    before = contents(path)
    moved = Path(shutil.copy(dqn, tmp_path / "moved.zip"))
    said = []
    hyrl_mj.robustify("vehicle", moved, out=path, preset="smoke", say=said.append)
    assert sum("done before" in line for line in said) >= len(STAGES) - 2
    changed = {p.name for p, content in contents(path).items() if before.get(p) != content}
    assert not changed - {"replay.mp4", "replay.png", "report.html"}, "a video takes GL"


def test_a_zip_without_any_pickled_member_is_the_same_agent(dqn, vehicle, tmp_path):
    bare = Path(shutil.copy(dqn, tmp_path / "bare.zip"))
    with zipfile.ZipFile(bare) as file:
        others = [name for name in file.namelist() if name != "policy.pth"]
    rewritten(bare, **dict.fromkeys(others))
    assert read_agent(vehicle, bare, vecnormalize="none").agent == read_agent(vehicle, dqn).agent


def test_a_stage_works_on_the_agent(robust, tmp_path):
    path = shutil.copytree(robust[0], tmp_path / "run")
    assert call("critical-set", path).returncode == 0
    refused = call("train", path)
    assert refused.returncode == 2
    assert "there is nothing to train" in refused.stderr


# ---- functions, ONNX files, policies


def test_a_function_is_made_robust_where_it_decides(circle_run, circle):
    assert circle_run.agent.algorithm == "function"
    np.testing.assert_allclose(circle_run.critical_set.points, [[2.5]], atol=0.05)
    assert circle_run.controller.modes == (0, 1)
    arcs = circle_run.arcs()
    assert ("critical", "policy") in arcs
    assert (
        "hyrl_mj.robustify(&#39;unit_circle&#39;, policy"
        in (circle_run.path / "report.html").read_text()
    )


def test_a_function_is_given_again_when_the_run_is_opened(circle_run):
    run = hyrl_mj.load_run(circle_run.path)
    assert run.controller.modes == (0, 1), "the controller needs no function"
    with pytest.raises(BadInput, match=r"which no file holds: open it .*load_run\(path, policy="):
        run.policy  # noqa: B018
    with pytest.raises(BadInput, match="answers otherwise"):
        hyrl_mj.load_run(circle_run.path, policy=away).policy  # noqa: B018
    policy = hyrl_mj.load_run(circle_run.path, policy=off_centre).policy
    assert policy.act(np.array([[2.4], [2.6]])).tolist() == [[-1.0], [1.0]]
    refused = call("critical-set", circle_run.path)
    assert refused.returncode == 2
    assert "which no file holds" in refused.stderr


def test_another_agent_does_not_overwrite_a_run(circle_run):
    before = contents(circle_run.path)
    with pytest.raises(BadInput, match=r"policy: an agent of Python code .* given"):
        hyrl_mj.robustify("unit_circle", away, out=circle_run.path, **SMOKE)
    with pytest.raises(BadInput, match="training with ppo given"):
        hyrl_mj.run("unit_circle", out=circle_run.path, **SMOKE)
    with pytest.raises(BadInput, match="seed: 0 there, 1 given"):
        hyrl_mj.robustify("unit_circle", off_centre, seed=1, out=circle_run.path, **SMOKE)
    assert contents(circle_run.path) == before


@pytest.mark.long
def test_an_onnx_file_is_kept_in_the_run(circle, tmp_path):
    path = onnx_file(tmp_path, np.array([[0.0, -9.0]]), np.zeros(1))
    run = hyrl_mj.diagnose("unit_circle", path, out=tmp_path / "run", **SMOKE)
    assert run.critical_set.points == pytest.approx(np.pi, abs=0.05)
    kept = (tmp_path / "run" / "policy.onnx").read_bytes()
    assert kept == path.read_bytes()
    path.unlink()
    again = hyrl_mj.load_run(tmp_path / "run").policy
    np.testing.assert_allclose(again.act(np.array([[1.0], [4.0]])), [[-1.0], [1.0]])


def test_what_a_policy_is_given_as_is_remembered(circle, tmp_path):
    network = training.export(training.build(circle, preset(circle, "smoke").stage1, 0), circle)
    network.save(tmp_path / "p.safetensors")
    model = untrained(PPO, circle)
    cases = [
        (network, "ppo", False),
        (tmp_path / "p.safetensors", "ppo", False),
        (hyrl_mj.load_agent(saved(model, tmp_path), circle, stochastic=True), "ppo", True),
        (circle_policy(circle), "function", False),
        (hyrl_mj.from_callable(away, circle), "function", False),
    ]
    measured = np.linspace(0, 6, 50)[:, None]
    for k, (policy, algorithm, stochastic) in enumerate(cases):
        given = read_agent(circle, policy)
        assert (given.agent.algorithm, given.agent.stochastic) == (algorithm, stochastic)
        folder = tmp_path / str(k)
        folder.mkdir()
        given.store(folder)
        again = given.policy if algorithm == "function" else None
        found = reopen_agent(folder, given.agent, circle, 0, again)
        acts = found.policy.act if stochastic else found.act
        before = given.policy.policy.act if stochastic else given.policy.act
        np.testing.assert_array_equal(acts(measured), before(measured))
    assert read_agent(circle, network).agent == read_agent(circle, tmp_path / "p.safetensors").agent
    settings = preset(circle, "smoke", agent=given.agent)
    assert artifacts.parsed(asdict(settings), Settings) == settings


# ---- chance, and nothing to decide


@pytest.mark.long
def test_episodes_stand_in_for_the_game_where_the_policy_draws(circle, tmp_path):
    path = saved(untrained(PPO, circle), tmp_path)
    said = []
    run = hyrl_mj.diagnose(
        "unit_circle", path, stochastic=True, out=tmp_path / "run", preset="smoke", say=said.append
    )
    assert run.agent.stochastic
    assert not run.exact
    assert any("noisy episodes stand in for the worst case" in line for line in said)
    page = (tmp_path / "run" / "diagnosis.html").read_text()
    assert "which this policy is not (it draws its inputs)." in page
    assert isinstance(run.steady, MlpPolicy)
    with pytest.raises(BadInput, match=r"it draws its inputs.*the noise 'attack'"):
        noisy_arcs(run, np.zeros((1, 1)), "worst")


@pytest.mark.long
def test_without_a_critical_set_one_policy_is_trained_under_noise(tmp_path):
    said = []
    run = hyrl_mj.robustify("unit_circle", one_way, out=tmp_path, preset="smoke", say=said.append)
    assert any("no critical set found at this resolution (grid " in line for line in said)
    assert run.controller.modes == (0,)
    assert run.extended_sets.sets[0].mask.all()
    assert (tmp_path / "report.html").is_file()


# ---- what stage 6 goes on from


@pytest.fixture(scope="module")
def ground(circle_run):
    return mode_ground(circle_run.task, circle_run.extended_sets, 0)


def start_of(run, policy, ground, **changed):
    settings = replace(run.settings.stage6, **changed)
    return start_policy(policy, run.partition, ground, settings, 0)


def test_a_function_is_distilled_part_by_part(circle_run, ground):
    found = start_of(circle_run, circle_run.policy, ground)
    assert found.algorithm == "ppo"
    # Mode 0 goes on clockwise beyond the decision at 2.5.
    assert ground.within.contains(np.array([[2.6]])).all()
    assert (found.act(np.linspace(0.5, 2.65, 50)[:, None]) < 0).all()


def test_dqn_goes_on_from_weights_that_fit_and_else_afresh(robust, vehicle):
    run = hyrl_mj.load_run(robust[0])
    function = hyrl_mj.from_callable(lambda o: np.zeros(len(o), dtype=int), vehicle)
    for policy, expected in ((run.policy, run.policy), (function, None)):
        ground = mode_ground(vehicle, run.extended_sets, 0)
        assert start_of(run, policy, ground, algorithm="dqn", options={}) is expected


def test_a_start_that_will_do_is_not_trained(circle_run, monkeypatch):
    monkeypatch.setattr(ByGame, "judge", lambda *_, **__: Judged((0.0, -0.5), True))
    monkeypatch.setattr("hyrl_mj.stages.retraining.train", None)
    run, settings = circle_run, circle_run.settings.stage6
    warm_start = partial(start_policy, run.policy, run.partition)
    found, _ = retrain(
        mode_ground(run.task, run.extended_sets, 0), settings, 0, warm_start=warm_start
    )
    assert (found.act(np.linspace(0.5, 2.4, 50)[:, None]) < 0).all()


# ---- parts without room for an overlap


def test_a_late_decision_is_taken_from_the_agent(vehicle):
    # Left of the line y = 0.4 - x, along which it drives towards the middle at full speed.
    grid = Grid.with_cells(vehicle.chart, 120)
    x, y = grid.nodes.T
    joined = x >= vehicle.obstacle[0]
    left = y > np.maximum(0.4 - x, 0)
    parts = tuple(GridSet.from_mask(grid, part | joined) for part in (left, ~left))
    partition = Partition((0, 1), parts, np.ones(len(x), dtype=bool))
    limit = Limit.solve(Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 240)), partition)
    ways = open_ways(limit, grid)
    policy = hyrl_mj.from_callable(lambda o: np.where(o[:, 2] > 0, 0, 4), vehicle)
    found = with_room(vehicle, policy, partition, ways, 0.1)
    points = np.array([[0.0, 0.35], [0.1, 0.2], [0.0, -0.2], [0.0, 0.6], [0.3, 0.05]])
    assert found.parts[0].contains(points).tolist() == [True, True, False, True, True]
    assert found.parts[1].contains(points).tolist() == [False, False, True, False, False]
    edge = boundary(found)
    assert np.abs(edge[edge[:, 0] < 0.4, 1]).max() < 0.35
    # Where nothing has to be given away, nothing is, but for a cell.
    middle = tuple(GridSet.from_mask(grid, part | joined) for part in (y > 0, y <= 0))
    fair = Partition((0, 1), middle, partition.succeeds)
    kept = with_room(vehicle, policy, fair, ways, 0.1)
    early = (x < 0.2) & (np.abs(y) > 0.03)
    for old, new in zip(fair.parts, kept.parts, strict=True):
        np.testing.assert_array_equal(old.mask[early], new.mask[early])
    everywhere = (np.ones(len(x), dtype=bool),) * 2
    assert with_room(vehicle, policy, partition, everywhere, 0.1) is partition


# ---- mistakes


def wrong_shape(observation):
    return np.zeros((len(observation), 7))


def not_a_number(observation):
    return np.full((len(observation), 1), np.nan)


def by_chance(observation):
    return np.random.default_rng().normal(size=(len(observation), 1))


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        (wrong_shape, {}, r"shape \(16, 7\) for 16 observations"),
        (not_a_number, {}, "gives nan"),
        (by_chance, {}, "without chance or memory"),
        (3, {}, "cannot be called"),
        (away, {"stochastic": True}, "about the file of an agent"),
        (away, {"eps": -1.0}, "noise bound -1.0"),
        (away, {"preset": "quick"}, "unknown preset 'quick'"),
    ],
)
def test_bad_functions_leave_nothing(policy, options, message, tmp_path):
    for work in (hyrl_mj.robustify, hyrl_mj.diagnose):
        with pytest.raises(BadInput, match=message):
            work("unit_circle", policy, out=tmp_path / "run", **{**SMOKE, **options})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["unit_circle", "--policy", "{here}/none.zip"], ["no file", "none.zip", "model.save"]),
        (["unit_circle", "--policy", "{dqn}"], ["network", "unit_circle"]),
        (["vehicle", "--policy", "{dqn}", "--activation", "swish"], ["'swish'", "relu, tanh"]),
        (["vehicle", "--policy", "{dqn}", "--stochastic"], ["dqn", "no distribution"]),
        (["vehicle", "--policy", "{dqn}", "--eps", "9"], ["9 hides the whole"]),
        (["boat", "--policy", "{dqn}"], ["'boat'", "unit_circle, vehicle"]),
        (["vehicle"], ["--policy"]),
    ],
)
@pytest.mark.parametrize("command", ["robustify", "diagnose"])
def test_bad_commands_leave_nothing(command, arguments, parts, dqn, tmp_path):
    arguments = [word.format(dqn=dqn, here=tmp_path) for word in arguments]
    done = call(command, *arguments, "--out", tmp_path / "run")
    assert done.returncode == 2, done.stdout + done.stderr
    for part in parts:
        assert part in done.stderr
    assert not list(tmp_path.iterdir())
