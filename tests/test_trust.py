"""Opening what somebody else has made executes nothing: code runs only where the user names it."""

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call, python
from planted import believe, without_pictures

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput
from hyrl_mj.files import artifacts, trust
from hyrl_mj.files.manifest import check_contents
from hyrl_mj.pipeline import run_stage
from hyrl_mj.policies import algorithms
from hyrl_mj.runs.directory import Run, write_config
from hyrl_mj.sets import GridSet
from hyrl_mj.tasks import described_task, write_task

EVIL = "import pathlib\npathlib.Path({marker!r}).touch()\n"


@pytest.fixture
def marker(tmp_path):
    """The file that appears if foreign code runs."""
    return tmp_path / "executed"


@pytest.fixture(autouse=True)
def blank(monkeypatch):
    """No picture is looked at."""
    without_pictures(monkeypatch)


@pytest.fixture
def received(planted_circle, tmp_path):
    """A run directory that may be changed."""
    return shutil.copytree(planted_circle[0].path, tmp_path / "received")


@pytest.fixture
def evil(marker, tmp_path, monkeypatch):
    """A Python file in the working directory that leaves the marker."""
    path = tmp_path / "evilmod.py"
    path.write_text(EVIL.format(marker=str(marker)))
    monkeypatch.chdir(tmp_path)
    return path


def open_everything(path):
    run = hyrl_mj.load_run(path)
    run.controller.initial_mode(run.critical_set.points)
    _ = run.policy, run.robustness, run.arcs()
    for stage in ("simulate", "figures", "report"):
        run = run_stage(run, stage, say=str)


def test_a_run_that_names_a_file_as_its_task_is_refused(received, evil, marker):
    run = hyrl_mj.load_run(received)
    write_config(Run(received, replace(run.settings, task=str(evil))))
    believe(received, task="unit_circle")
    with pytest.raises(BadInput, match=rf"{re.escape(str(evil))}.*--task FILE"):
        open_everything(received)
    assert not marker.exists()


def test_a_policy_that_names_a_file_as_its_task_is_refused(received, evil, marker):
    description = artifacts.read_json(received / "mode_0.json", "policy", dict)
    artifacts.write_json(received / "mode_0.json", description | {"task": str(evil)}, "policy")
    believe(received)
    with pytest.raises(BadArtifact, match="it is a policy for"):
        open_everything(received)
    with pytest.raises(BadArtifact, match="for the unknown task"):
        hyrl_mj.MlpPolicy.load(received / "mode_0.safetensors")
    assert not marker.exists()


@pytest.mark.slow
def test_an_algorithm_that_a_run_names_is_not_imported(received, evil, marker):
    run = hyrl_mj.load_run(received)
    foreign = replace(run.settings.stage1, algorithm="evilmod:X")
    write_config(Run(received, replace(run.settings, stage1=foreign)))
    believe(received)
    open_everything(received)
    with pytest.raises(BadInput, match="from a module that you have not named before"):
        run_stage(hyrl_mj.load_run(received), "train")
    assert not marker.exists()


# ---- what the user has named


@pytest.fixture
def robot(tmp_path):
    """A task file of the user's, which has not run yet."""
    return write_task("robot_of_mine", tmp_path)[0]


@pytest.mark.slow
def test_a_task_file_that_the_user_has_named_is_known_until_it_changes(robot):
    assert not trust.is_known(robot)
    code = f"import hyrl_mj; hyrl_mj.get_task({str(robot)!r})"
    assert python(code).returncode == 0
    assert trust.is_known(robot)
    opened = f"from hyrl_mj.tasks import described_task; print(described_task({str(robot)!r}).name)"
    assert python(opened).stdout == "robot_of_mine\n"
    robot.write_text(robot.read_text() + "\n# changed\n")
    with pytest.raises(BadInput, match="as it is now"):
        described_task(str(robot))


@pytest.mark.parametrize("name", ["helper.pyc", "helper/__init__.pyc", "helper.abi3.so"])
def test_a_module_without_source_beside_a_task_file_is_a_part_of_it(name, robot):
    """Python takes it where the file imports it, a package and an extension before helper.py."""
    robot.write_text("import helper\n" + robot.read_text())
    (robot.parent / "helper.py").touch()
    trust.remember(robot)
    assert trust.is_known(robot)
    (robot.parent / name).parent.mkdir(exist_ok=True)
    (robot.parent / name).write_bytes(b"compiled")
    assert not trust.is_known(robot)


def test_an_algorithm_that_the_user_has_named_is_known(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("raise RuntimeError('imported')\n")
    with pytest.raises(BadInput, match="--algorithm mine:Fast"):
        algorithms.check_named("mine:Fast")
    algorithms.remember("mine:Fast")
    algorithms.check_named("mine:Fast")
    algorithms.check_named("ppo")


@pytest.mark.parametrize("content", ["", "[1]", "{", '{"a": 1}'])
def test_damaged_records_are_none(content, robot):
    trust.store().parent.mkdir(parents=True, exist_ok=True)
    trust.store().write_text(content)
    assert not trust.is_known(robot)


def test_without_a_place_for_records_nothing_is_known(robot, monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(blocked))
    trust.remember(robot)
    assert not trust.is_known(robot)


@pytest.mark.slow
def test_a_run_of_somebody_else_s_robot_opens_when_its_file_is_named(received, robot):
    run = hyrl_mj.load_run(received)
    write_config(Run(received, replace(run.settings, task=str(robot.with_name("elsewhere.py")))))
    believe(received, task="unit_circle")
    refused = call("report", received)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert "--task FILE" in refused.stderr
    other = call("report", received, "--task", robot)
    assert other.returncode == 2, "its policies are for another robot"
    assert "a grid of 2,880 cells" in other.stderr, "cells of a circle are too many for a plane"
    assert other.stderr.count("\n") == 1


# ---- what a stranger may try


def test_a_relative_place_for_records_is_ignored(monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "here")
    assert trust.store() == Path.home() / ".local" / "state" / "hyrl_mj" / "code.json"


def test_a_pipe_in_a_run_directory_is_refused(tmp_path):
    os.mkfifo(tmp_path / "policy.json")
    with pytest.raises(BadArtifact, match=r"policy.json is no file"):
        check_contents(tmp_path)


@pytest.mark.parametrize(
    ("count", "sets", "message"),
    [
        *((count, (10**12, 0), "cannot be used") for count in (0, 1, 2**40)),
        (2, (5_000, 2), "5,000 sets"),
    ],
)
def test_sets_that_no_run_has_are_refused(count, sets, message, circle):
    arrays = {"grid_counts": np.array([count]), "signed_distance": np.zeros(sets)}
    with pytest.raises(BadInput, match=message):
        GridSet.unpack(arrays, circle)


def _lost(content):
    """The first count of replays of results, with a start that was lost."""
    count = content["game"]["replays"][0]
    first = {"start": [0.0], "q0": None, "noise": next(iter(count["starts"])), "outcome": "late"}
    count["lost"] = {kind: int(kind == first["noise"]) for kind in count["starts"]}
    count.update(first=first, judged=max(count["judged"], 1))
    return count


@pytest.fixture(scope="module")
def examined(planted_circle, tmp_path_factory):
    """A run directory with the result of the worst-case game."""
    return shutil.copytree(planted_circle[0].path, tmp_path_factory.mktemp("received") / "run")


@pytest.mark.parametrize(
    "forge",
    [
        lambda content: content["game"]["scores"].pop("hyrl"),
        lambda content: content["game"]["scores"].update(hyrl=[]),
        lambda content: content["game"]["margin"].clear(),
        lambda content: content["game"]["curve"].update(eps=[]),
        lambda content: content.update(game=None),
        lambda content: _lost(content)["first"].update(start=[]),
    ],
)
@pytest.mark.slow
def test_forged_results_are_refused(forge, examined, tmp_path):
    path = shutil.copytree(examined, tmp_path / "examined")
    content = artifacts.read_json(path / "robustness.json", "robustness", dict)
    forge(content)
    artifacts.write_json(path / "robustness.json", content, "robustness")
    believe(path)
    with pytest.raises(BadArtifact, match=r"robustness.json(:| has) "):
        hyrl_mj.load_run(path).robustness  # noqa: B018


def test_what_is_written_again_pushes_no_other_record_out(tmp_path, monkeypatch):
    monkeypatch.setattr(trust, "MOST", 2)
    paths = [tmp_path / name for name in ("one", "other")]
    for path in (paths[0], *3 * paths[1:]):
        with trust.output(path), artifacts.replacing(path) as temporary:
            temporary.write_text("the same each time")
    for path in paths:
        with trust.output(path):
            pass  # it is known, or this raised an error
