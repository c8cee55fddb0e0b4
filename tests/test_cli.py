"""The command line: what people type, and what they are told when it is wrong."""

import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from command_line import call, contents, python
from gl import needs_gl
from PIL import Image
from planted import played_before
from sentences import assert_has_ended
from test_algorithms import make_sac_run

import hyrl_mj
from hyrl_mj import BadInput
from hyrl_mj.judging.game import MapClass, Maps
from hyrl_mj.pipeline.steps import STAGES
from hyrl_mj.runs.arcs import noisy_arcs
from hyrl_mj.viz.figures import FIGURES

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_runs")]  # whole runs

SMOKE = ("--preset", "smoke", "--algorithm", "sac")  # as `make_sac_run`


@pytest.fixture(scope="module")
def finished(small_runs, made_once, tmp_path_factory):
    """A whole run of the unit circle in the smoke preset, made by the command line, and what it said."""
    folder = made_once("circle_sac", make_sac_run)
    path = shutil.copytree(folder / "run", tmp_path_factory.mktemp("runs") / "circle")
    return path, (folder / "said").read_text().replace(str(folder / "run"), str(path))


@pytest.fixture
def copied(finished, tmp_path):
    """A copy of it, to be damaged."""
    return shutil.copytree(finished[0], tmp_path / "run")


def assert_one_sentence(process, *parts):
    assert process.returncode == 2, process.stdout + process.stderr
    assert len(process.stderr.strip().splitlines()) == 1
    for part in parts:
        assert part in process.stderr


def test_run_ends_with_a_table_and_leaves_every_artifact(finished):
    path, said = finished
    for words in ("policy (SAC)", "HyRL, q0 = 0", "HyRL, q0 = 1", "on M*", "critical set of"):
        assert words in said
    names = ["config.json", "policy.safetensors", "policy.json", "critical_set.npz"]
    names += ["partition.npz", "extended_sets.npz", "mode_0.safetensors", "mode_1.safetensors"]
    names += ["arcs/start0_policy.npz", "arcs/critical_hyrl_q1.npz", "robustness.json"]
    names += [f"figures/{name}{suffix}" for name in FIGURES for suffix in (".png", ".pdf")]
    names += ["report.html"]
    assert [n for n in names if not (path / n).is_file()] == []
    assert not list(path.rglob("*.partial*"))
    assert f"report {path / 'report.html'}" in said


def test_a_run_tells_from_which_starts_a_controller_is_lost(finished):
    run = hyrl_mj.load_run(finished[0])
    lost = run.lost("policy")
    assert lost.shape == (len(lost), 1)
    maps = Maps.load(finished[0] / "robustness.npz")
    assert len(lost) <= (maps.map["policy"] == MapClass.BEATEN).sum()
    if len(lost):  # what is told is lost under the signal that `simulate` plays
        arc = noisy_arcs(run, lost[:1], "worst")["policy"][0]
        assert not arc.arrives(run.task)
    with pytest.raises(BadInput, match="unknown controller 'best': choose one of policy, hyrl"):
        run.lost("best")


@needs_gl
def test_run_renders_the_replay_and_does_nothing_again(finished):
    before = contents(finished[0])
    assert len(before[finished[0] / "replay.mp4"]) > 1_000
    assert finished[0] / "replay.png" in before
    again = call("run", "unit_circle", *SMOKE, "--out", finished[0])
    assert_has_ended(again)
    assert again.stdout.count("done before") == len(STAGES)
    assert contents(finished[0]) == before


def test_a_stage_that_gives_the_same_again_leaves_those_after_it_done(copied):
    assert call("critical-set", copied).returncode == 0
    run = hyrl_mj.load_run(copied)
    assert all(run.manifest.is_done(stage) for stage in STAGES), "it found the same again"


def test_figures_are_drawn_again(copied):
    (copied / "figures" / "runs.pdf").unlink()
    done = call("figures", copied)
    assert done.returncode == 0, done.stderr
    assert "overview, policy, extended_sets, runs" in done.stdout
    assert (copied / "figures" / "runs.pdf").is_file()


@pytest.mark.long
@needs_gl
def test_a_run_without_a_critical_set_has_one_mode_and_leaves_nothing_of_two(copied):
    run = hyrl_mj.load_run(copied)
    none = replace(run.critical_set, points=np.empty((0, 1)), component=np.zeros(0, dtype=int))
    with run.manifest.stage("critical-set"):
        none.save(copied / "critical_set.npz")
    again = call("run", "unit_circle", *SMOKE, "--out", copied)
    assert_has_ended(again)
    assert "no critical set found" in again.stdout
    assert "extended set everything" in again.stdout
    assert "of 5 of the scene's starts" in again.stdout
    assert hyrl_mj.load_run(copied).controller.modes == (0,)
    left = {p.name for p in [*copied.glob("mode_*"), *(copied / "arcs").iterdir()]}
    assert not {n for n in left if "critical" in n or "1." in n.replace("start1", "")}
    again = call("run", "unit_circle", *SMOKE, "--out", copied)
    assert again.stdout.count("done before") == len(STAGES)


@needs_gl
def test_what_was_simulated_is_replayed_and_so_are_the_paper_s_starts_anew(copied):
    start = ("--start", "3.0", "--q0", "1", "--noise", "worst", "--time", "0.5")
    assert call("simulate", copied, *start).returncode == 0
    before = contents(copied)
    for name, options in (
        ("latest.png", ["--starts", "latest"]),
        ("paper.png", ["--starts", "paper", "--noise", "adversarial", "--eps", "0.05"]),
    ):
        done = call("replay", copied, "--out", copied / name, "--size", "640x320", *options)
        assert done.returncode == 0, done.stderr
        assert f"picture at {copied / name}" in done.stdout
        with Image.open(copied / name) as picture:
            assert picture.size == (640, 320)
    assert set(contents(copied)) - set(before) == {copied / "latest.png", copied / "paper.png"}


def test_without_a_latest_simulation_there_is_nothing_to_replay(copied):
    for left in (copied / "arcs").glob("latest_*"):
        left.unlink()
    done = call("replay", copied, "--starts", "latest", "--out", "x.mp4")
    assert_one_sentence(done, "latest_policy.npz is missing", "simulate it again")


@needs_gl
def test_a_video_that_cannot_be_written_leaves_nothing(planted_circle, tmp_path):
    run = shutil.copytree(planted_circle[0].path, tmp_path / "run")
    (run / "file").write_text("mine")
    before = contents(run)
    done = call("replay", run, "--out", run / "file" / "replay.mp4", "--size", "640x320")
    assert_one_sentence(done, str(run / "file"))
    assert contents(run) == before


@pytest.mark.skipif(sys.platform != "linux", reason="a window would open")
def test_the_web_viewer_ends_with_ctrl_c(planted_circle):
    child = subprocess.Popen(
        [sys.executable, "-m", "hyrl_mj.cli", "view", str(planted_circle[0].path)],
        env={**os.environ, "DISPLAY": "", "WAYLAND_DISPLAY": ""},  # with one a window would open
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Who runs in the background is deaf to Ctrl+C, and so would be its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert re.search(r"http://127.0.0.1:\d+/", child.stdout.readline())
        child.send_signal(signal.SIGINT)
        _, complaints = child.communicate(timeout=30)
    finally:
        child.kill()
    assert child.returncode == 130
    assert "Traceback" not in complaints


def test_robustness_prints_the_worst_case_and_the_episodes(copied, monkeypatch):
    played_before(monkeypatch, hyrl_mj.load_run(copied))
    done = call("robustness", copied, "--episodes", "8", "--noise", "uniform,adversarial")
    assert done.returncode == 0, done.stderr
    for words in (
        "worst case over all noise",
        "limit",
        "margins",
        "uniform 0.1",
        "adversarial 0.1",
    ):
        assert words in done.stdout
    robustness = hyrl_mj.load_run(copied).robustness
    assert [score.eps for score in robustness.game.scores["hyrl"]] == [0.0, 0.05, 0.1]
    kinds = {(c.noise, c.controller) for c in robustness.episodes}
    assert kinds == {(n, c) for n in ("uniform", "adversarial") for c in ("policy", "hyrl")}


@pytest.mark.parametrize(
    ("form", "out", "file"), [("onnx", "circle.onnx", "."), ("numpy", "circle", "controller.py")]
)
def test_export_writes_the_controller(form, out, file, planted_circle, tmp_path):
    (tmp_path / out / file).parent.mkdir(exist_ok=True)
    (mine := tmp_path / out / file).write_text("mine")
    words = ("export", planted_circle[0].path, "--to", form, "--out", tmp_path / out)
    assert_one_sentence(call(*words), str(mine), "--force")
    assert mine.read_text() == "mine"
    done = call(*words, "--force")
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / out) in done.stdout
    assert mine.read_bytes() != b"mine"
    assert call(*words).returncode == 0, "it has written what is there"


def test_simulate_finds_the_worst_noise_and_prints_both_ends(copied):
    words = ("--start", "3.1416", "--q0", "1", "--noise", "worst", "--eps", "0.1")
    done = call("simulate", copied, *words)
    assert done.returncode == 0, done.stderr
    assert "policy " in done.stdout
    assert "hyrl " in done.stdout
    arc = hyrl_mj.HybridArc.load(copied / "arcs" / "latest_policy.npz")
    assert (arc.noise, arc.outcome) == ("worst", "stalled")
    assert abs(arc.measured[:-1] - arc.z[:-1]).max() <= 0.1 + 1e-9


def test_list():
    listed = call("list").stdout.split()
    own = {name for name in hyrl_mj.task_names() if hyrl_mj.get_task(name).source is None}
    assert {"vehicle", "slalom", "gaps", "gate"} <= own <= set(listed)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["run", "unicycle"], ["'unicycle'", "unit_circle, vehicle"]),
        (["run", "vehicle", "--preset", "quick"], ["'quick'", "fast, paper, smoke"]),
        (["run", "vehicle", "--eps", "-0.1"], ["-0.1", ">= 0"]),
        (["run", "vehicle", "--horizon", "0"], ["horizon 0", "> 0"]),
        (["run", "vehicle", "--eps", "1.5"], ["1.5 hides the whole state space", "below 1.5 m"]),
        (["run", "vehicle", "--seed", "-1"], ["seed -1", "from 0 to"]),
    ],
)
def test_bad_input_before_anything_is_made(arguments, parts, tmp_path):
    assert_one_sentence(call(*arguments, cwd=tmp_path), *parts)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["simulate", "--start", "nan"], ["theta = nan"]),
        (["simulate", "--start", "1", "2"], ["theta", "got 2"]),
        (["simulate", "--start", "1", "--q0", "5"], ["mode 5", "(0, 1)"]),
        (["simulate", "--start", "1", "--noise", "white"], ["'white'", "uniform"]),
        (["simulate", "--start", "1", "--time", "0"], ["horizon 0", "> 0"]),
        (["simulate", "--q0", "1"], ["--start"]),
        (["simulate", "--start", "1", "--eps", "4"], ["4 hides the whole", "below 3.14 rad"]),
        (["robustness", "--eps", "4"], ["4 hides the whole", "below 3.14 rad"]),
        (["robustness", "--noise", "uniform"], ["--episodes"]),
        (["replay", "--starts", "mine", "--out", "x.mp4"], ["'mine'", "critical, paper, latest"]),
        (["replay", "--layout", "overlay"], ["needs an --out"]),
        (["view", "--arc", "mine"], ["'mine'", "critical_hyrl_q0"]),
        (["view", "--port", "70000"], ["port 70000"]),
        (
            ["report", "--out", "/dev/null/page.html"],
            ["/dev/null/page.html", "a place that can be written"],
        ),
        (["export", "--to", "tflite", "--out", "x"], ["'tflite'", "onnx, numpy"]),
        (["export", "--to", "onnx", "--out", "/dev/null/x"], ["a place that can be written"]),
        (["simulate", "--start", "1", "--time", "1e12"], ["horizon 1e+12", "3600"]),
    ],
)
def test_bad_input_leaves_the_run_as_it_was(arguments, parts, finished):
    before = contents(finished[0])
    command, *options = arguments
    assert_one_sentence(call(command, finished[0], *options), *parts)
    assert contents(finished[0]) == before


def test_a_folder_that_is_no_run(tmp_path):
    (tmp_path / "file.txt").write_text("mine")
    assert_one_sentence(call("simulate", tmp_path), "not a run directory")
    assert_one_sentence(call("report", tmp_path), "not a run directory")
    assert_one_sentence(call("run", "vehicle", "--out", tmp_path), "choose another --out")
    assert (tmp_path / "file.txt").read_text() == "mine"


def test_other_settings_do_not_overwrite_a_run(finished):
    done = call("run", "unit_circle", *SMOKE, "--seed", "7", "--out", finished[0])
    assert_one_sentence(done, "seed: 0 there, 7 given")
    done = call("run", "unit_circle", *SMOKE, "--eps", "0.2", "--out", finished[0])
    assert_one_sentence(done, "eps: 0.1 there, 0.2 given")
    done = call("run", "vehicle", "--preset", "smoke", "--out", finished[0])
    assert_one_sentence(done, "other settings (task: unit_circle there, vehicle given): choose")


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("policy.safetensors", "critical-set"),
        ("arcs/critical_policy.npz", "replay"),
        ("figures/robustness_map.png", "report"),
        ("config.json", "train"),
    ],
)
def test_a_truncated_artifact_is_named(name, command, copied):
    damaged = copied / name
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    before = contents(copied)
    assert_one_sentence(call(command, copied), str(damaged))
    assert contents(copied) == before


def test_load_run_acts_as_the_contract_says_without_torch(finished):
    program = f"""
import sys
sys.modules["torch"] = sys.modules["stable_baselines3"] = None  # importing them raises
import numpy as np, hyrl_mj
run = hyrl_mj.load_run({str(finished[0])!r})
measured = np.linspace(-7, 7, 50)[:, None]
assert run.policy.act(measured).shape == (50, 1)
q = run.controller.initial_mode(measured)
assert q.shape == (50,) and set(q) <= set(run.controller.modes) == {{0, 1}}
u, after = run.controller.step(q, measured)
assert u.shape == (50, 1) and after.shape == (50,) and np.abs(u).max() <= 1
for mode in run.controller.modes:
    flow, jump = run.controller.flow_set(mode), run.controller.jump_set(mode)
    assert (flow.contains(measured) | jump.contains(measured)).all()
    assert flow.signed_distance(measured).shape == (50,)
arc = hyrl_mj.simulate(run.task, run.controller, [3.0], hyrl_mj.Noise("alternating", 0.1), q0=1)
print(arc.outcome)
"""
    done = python(program)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in ("reached", "stalled")
