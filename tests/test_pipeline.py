"""The pipeline does what is missing from a run directory, and one stage again where it is told to."""

import json
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from command_line import contents
from planted import circle_policy, decisions, halves, without_pictures
from test_report import plant

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput
from hyrl_mj.pipeline import ExamineOptions, examine_run, extend_again, run_stage
from hyrl_mj.pipeline.steps import STAGES
from hyrl_mj.runs.arcs import noisy_arcs
from hyrl_mj.viz.commands import beginning, commands

pytestmark = pytest.mark.slow  # a planted run goes through all later stages

NAMES = [*STAGES]


@pytest.fixture(autouse=True)
def blank(monkeypatch):
    """No picture is looked at."""
    without_pictures(monkeypatch)


@pytest.fixture
def run(planted_circle, tmp_path):
    """A copy of the planted run, to be changed."""
    return hyrl_mj.load_run(shutil.copytree(planted_circle[0].path, tmp_path / "run"))


def stages_done(run):
    return [name for name in NAMES if run.manifest.is_done(name)]


# ---- whole runs


def test_a_run_goes_on_where_it_was_left(planted_circle):
    run, (plan, *said) = planted_circle
    assert re.fullmatch(r"the run will be examined by the worst-case game on \d+ nodes", plan)
    stages = [line.partition(":")[0] for line in said]
    assert list(dict.fromkeys(stages)) == NAMES
    assert said[:5] == [f"{name}: done before" for name in NAMES[:5]]
    assert not any("done before" in line for line in said[5:])
    assert "replay: no video: no GL library here" in said
    assert said[-1] == f"report: page at {run.path / 'report.html'}"


def test_config_and_page_hold_the_version_of_this_package(planted_circle):
    run, _ = planted_circle
    versions = json.loads((run.path / "config.json").read_text())["versions"]
    assert versions["hyrl-mj"] == hyrl_mj.__version__
    assert hyrl_mj.__version__ in (run.path / "report.html").read_text()


def test_what_cannot_be_drawn_is_tried_again(planted_circle):
    assert stages_done(planted_circle[0]) == [name for name in NAMES if name != "replay"]


@pytest.mark.parametrize("name", ["policy.safetensors", "critical_set.npz", "extended_sets.npz"])
def test_a_newer_file_with_the_same_content_changes_nothing(run, name):
    before = stages_done(run)
    os.utime(run.path / name)
    assert stages_done(run) == before


def test_another_result_makes_those_that_were_made_from_it_out_of_date(run):
    other = replace(run.critical_set, points=run.critical_set.points + 0.01)
    before = stages_done(run)
    with run.manifest.stage("critical-set"):
        other.save(run.path / "critical_set.npz")
    # Extended sets and mode policies of this run are planted: they were made from nothing.
    built = ["robustness", "simulate", "figures", "report"]
    assert [name for name in before if name not in stages_done(run)] == built
    with pytest.raises(BadArtifact, match=r"robustness.json is older than what it was made from"):
        _ = hyrl_mj.load_run(run.path).robustness


# ---- one stage


def test_an_unknown_stage_lists_the_known(run):
    with pytest.raises(BadInput, match=r"'simulat'.*Did you mean 'simulate'"):
        run_stage(run, "simulat")


def test_arcs_that_no_stage_has_recorded_stay_and_are_not_those_of_the_run(run):
    folder, said = run.path / "arcs", []
    before, own = (
        contents(folder),
        {"start9_policy.npz", "critical_hyrl_q7.npz", "latest_policy.npz"},
    )
    for name in own:
        shutil.copy(folder / "start0_policy.npz", folder / name)
    again = run_stage(run, "simulate", say=said.append)
    after = {path.name for path in folder.iterdir()}
    assert after == {path.name for path in before} | own
    assert said == [f"simulate: {len(before)} arcs; {said[0].partition('; ')[2]}"]
    assert len(again.arcs()) == len(before)
    assert not {("start9", "policy"), ("critical", "hyrl_q7")} & again.arcs().keys()


def test_the_critical_set_and_the_parts_are_those_of_the_policy(run):
    again = run_stage(run_stage(run, "critical-set", say=str), "partition", say=str)
    assert np.abs(again.critical_set.points - np.pi).max() < 0.01
    assert again.partition.parts[0].contains(np.array([[2.0], [4.0]])).tolist() == [True, False]
    # Extended sets and mode policies of this run are planted: they were made from nothing.
    assert stages_done(again) == NAMES[:5]


def test_an_agent_of_others_is_not_trained(circle, tmp_path):
    said = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrl_mj.pipeline.runs.DIAGNOSIS", NAMES[:2])
        run = hyrl_mj.diagnose(
            "unit_circle",
            circle_policy(circle, critical=2.5),
            out=tmp_path / "run",
            preset="smoke",
            say=said.append,
        )
    assert said[0].startswith("train: none, ")
    assert np.abs(run.critical_set.points - 2.5).max() < 0.01
    with pytest.raises(BadInput, match="there is nothing to train"):
        run_stage(run, "train")


# ---- with other values


def test_another_horizon_is_kept_and_what_follows_is_out_of_date(run):
    said = []
    again = extend_again(run, 0.2, say=said.append)
    assert again.settings.horizon == again.extended_sets.horizon == 0.2
    assert hyrl_mj.load_run(run.path).settings == again.settings
    assert stages_done(again) == NAMES[:5], (
        "its mode policies are planted: they were made from nothing"
    )
    assert said[0].startswith("extended-sets: ")
    assert "--horizon 0.2" in said[-1]


def test_a_horizon_that_cannot_be_used_changes_nothing(run):
    before = contents(run.path)
    with pytest.raises(BadInput, match=r"horizon -1\.0"):
        extend_again(run, -1.0)
    assert contents(run.path) == before


@pytest.mark.long
def test_a_run_made_for_noise_on_all_coordinates_is_examined_so(vehicle, tmp_path, monkeypatch):
    path = tmp_path / "run"
    plant(path, vehicle, decisions(vehicle), halves(vehicle, 60), eps=0.05, everywhere=True)
    run = hyrl_mj.load_run(path)
    assert run.task.noisy == (True, True)
    assert hyrl_mj.get_task("vehicle").noisy == (False, True)
    sets = run_stage(run, "extended-sets", lambda text: None).extended_sets
    assert sets.eps == 0.05
    robustness = examine_run(run, say=lambda text: None)
    assert robustness.everywhere
    assert run.is_examined_as_usual
    assert "noise of up to 0.05 m on x and y" in " ".join(run.verdict.reasons)
    assert beginning(run).endswith("--eps 0.05 --seed 0 --preset smoke --all-coordinates")
    assert commands(run, robustness) == [beginning(run)]
    # The noise of a replay acts on both coordinates.
    (arc,) = noisy_arcs(run, np.array([[0.0, 0.1]]), "uniform", q0s=(0,), horizon=0.2)["hyrl_q0"]
    off = arc.measured[:-1] - arc.z[:-1]
    assert (np.abs(off) > 0).all()
    assert np.abs(off).max() <= 0.05


@pytest.mark.long
def test_episodes_are_added_on_demand(run):
    before, said = run.robustness, []
    twice = ("uniform", "uniform")  # is played once
    examine_run(run, ExamineOptions(eps=0.05, noise=twice, episodes=20), said.append)
    found = hyrl_mj.load_run(run.path).robustness
    assert found != before
    assert sum(count.episodes for count in found.episodes) == 2 * 20
    assert said[-1].startswith("worst case at noise 0.05, of the winnable starts: ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episodes": 0}, "episodes 0 cannot be used"),
        ({"seed": -1}, "seed -1 cannot be used"),
        ({"eps": -0.1}, "finite number >= 0"),
        ({"eps": 100.0}, "hides the whole state space"),
        ({"noise": ("pink",)}, "'pink'"),
    ],
)
def test_an_examination_that_cannot_be_made_leaves_the_last_one(run, options, message):
    before = contents(run.path)
    with pytest.raises(BadInput, match=message):
        examine_run(run, ExamineOptions(**options))
    assert contents(run.path) == before
