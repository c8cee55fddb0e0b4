"""Sweeps: what is planned, what is refused, and that their runs are those that are made one by one."""

import csv
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

import hyrl_mj
from hyrl_mj import BadInput, sweeps
from hyrl_mj.learning import changed, preset
from hyrl_mj.pipeline import cluster, report
from hyrl_mj.pipeline.board import Board
from hyrl_mj.sweeps import DONE, Common, Row, Setting, Sweep
from hyrl_mj.viz import sweep_tables

CIRCLE = Setting("unit_circle", "", 0.1)
# Runs of some seconds, without pictures that can be seen.
TINY = {"stage1.samples": 4096, "stage6.samples": 4096, "lattice": 120, "cells": 240}
SMOKE = {"preset": "smoke", "set": TINY}


def call(*words, **environment):
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "hyrl_mj.cli", *map(str, words)],
        env=os.environ | environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


# ---- settings that are changed


def test_settings_are_changed_by_name(circle):
    settings = preset(circle, "smoke")
    new = changed(
        settings,
        {
            "stage1.samples": "3e5",
            "lattice": 240,
            "stage6.options.n_epochs": "4",
            "stage1.hidden": "[8, 8]",
        },
    )
    assert new.stage1.samples == 300_000
    assert new.stage1.hidden == (8, 8)
    assert new.lattice == 240
    assert new.stage6.options == settings.stage6.options | {"n_epochs": 4}
    assert new == replace(
        settings, lattice=240,
        stage1=replace(settings.stage1, samples=300_000, hidden=(8, 8)),
        stage6=replace(settings.stage6, options=new.stage6.options),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("stage1.sample", 1, "Did you mean 'stage1.samples'"),
        ("stage1.samples", "many", "samples 'many' cannot be used"),
        ("noise", 0.2, "give it by --eps"),
        ("stage1.algorithm", "sac", "give it by --algorithm"),
        ("stage1.options.nsteps", 3, "nsteps"),
    ],
)
def test_settings_that_cannot_be_changed(name, value, message, circle):
    with pytest.raises(BadInput, match=message):
        changed(preset(circle, "smoke"), {name: value})


@pytest.mark.slow
def test_a_changed_setting_stands_in_the_run_and_in_the_message_about_another(tmp_path):
    out = tmp_path / "run"
    words = ("run", "unit_circle", "--preset", "smoke", "--out", out, "--set")
    first = call(*words, *(f"{name}={value}" for name, value in TINY.items()))
    assert first.returncode in (0, 1), first.stderr
    settings = json.loads((out / "config.json").read_text())["settings"]
    assert settings["stage1"]["samples"] == TINY["stage1.samples"]
    again = call(*words, "lattice=120", "cells=240", "stage1.samples=8192")
    assert again.returncode == 2
    assert "stage1.samples: 4096 there, 8192 given" in again.stderr


# ---- the plan


def test_bad_sweeps_make_nothing(tmp_path):
    out = tmp_path / "sweep"
    for tasks, changes, message in (
        ([], {}, "at least one task"),
        ("unit_circle", {"seeds": ()}, "at least one seed"),
        ("unit_circle", {"seeds": (1, 1)}, "the seed 1 is given twice"),
        ("unit_circle", {"eps": (0.1, 0.1)}, "noise 0.1 is given twice"),
        ("unit_circle", {"eps": (-1.0,)}, "noise bound -1.0"),
        ("unit_circel", {}, "Did you mean 'unit_circle'"),
        ("unit_circle", {"algorithm": ("dqm",)}, "dqm"),
        ("unit_circle", {"set": {"latice": 1}}, "Did you mean 'lattice'"),
        ("unit_circle", {"cores": 0}, "cores 0 cannot be used"),
        ("unit_circle", {"memory": -1}, "memory -1 cannot be used"),
        ("unit_circle", {"memory": 9_999.0}, "no machine has 1 cores"),
        ("unit_circle", {"address": "nowhere"}, "give HOST:PORT"),
        ("unit_circle", {"address": "127.0.0.1:1"}, "no Ray cluster answers at 127.0.0.1:1"),
    ):
        with pytest.raises(BadInput, match=message):
            hyrl_mj.sweep(tasks, out=out, say=str, **{"preset": "smoke", **changes})
        shutil.rmtree(out, ignore_errors=True)


def test_ranges_of_seeds_on_the_command_line(tmp_path):
    for seeds in ("9-0", "", "a", "1-", "0-9-2"):
        done = call("sweep", "unit_circle", "--seeds", seeds, "--out", tmp_path / "sweep")
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "sweep").exists()


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(BadInput, match="is not the folder of a sweep"):
        hyrl_mj.sweep("unit_circle", out=tmp_path, **SMOKE)


def test_another_sweep_is_refused_and_more_seeds_are_taken(tmp_path):
    rows = [Row(CIRCLE, 0)]
    common = Common("smoke", None, {})
    sweeps.opened(tmp_path, common, rows).save(tmp_path)
    with pytest.raises(BadInput, match="preset: smoke there, fast given"):
        sweeps.opened(tmp_path, replace(common, preset="fast"), rows)
    with pytest.raises(BadInput, match=r"noise 0.1 there, of unit_circle, noise 0.2 given"):
        sweeps.opened(tmp_path, common, [Row(replace(CIRCLE, eps=0.2), 0)])
    more = sweeps.opened(tmp_path, common, [Row(CIRCLE, 1)])
    assert [row.name for row in more.rows] == ["unit_circle-0.1-0", "unit_circle-0.1-1"]


def test_without_ray_one_sentence_says_how_to_install_it(tmp_path):
    (tmp_path / "ray.py").write_text("raise ImportError('not here')")
    path = os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", "")))
    out = tmp_path / "sweep"
    done = call("sweep", "unit_circle", "--preset", "smoke", "--out", out, PYTHONPATH=path)
    assert done.returncode == 2
    assert done.stderr == (
        'hyrl-mj: sweep needs Ray, which is not installed: pip install "hyrl-mj[sweep]"\n'
    )


# ---- the tables


def row(seed, **figures):
    return Row(CIRCLE, seed, DONE, "all is well", "WON", 10.0, figures)


def test_tables_show_median_least_and_greatest():
    rows = (row(0, hyrl_won=1.0), row(1, hyrl_won=0.5), row(2, hyrl_won=0.75), Row(CIRCLE, 3))
    sweep = Sweep(Common("fast", None, {}), rows)
    table = sweep_tables.summary_table(sweep)
    assert table.headings == ["figure", "unit_circle, noise 0.1"]
    assert table.rows == [
        ["runs", "3 of 4"], ["verdicts", "3 WON"], ["HyRL won, own q0", "75.00% (50.00% to 100%)"],
    ]  # fmt: skip
    assert sweep_tables.worst(rows).seed == 1
    assert sweep_tables.markdown(table).splitlines()[1] == "| --- | --- |"


def test_what_runs_say_reads_well_in_a_log():
    lines = []
    with Board(lines.append, 2) as board:
        board.tell(Row(CIRCLE, 0), "begins")
        board.end(row(0))
        board.end(replace(Row(CIRCLE, 1), state="stopped", sentence="no room"))
    assert lines == [
        "unit_circle-0.1-0: 0 s: begins",
        "unit_circle-0.1-0: 10 s: WON: all is well (1 of 2)",
        "unit_circle-0.1-1: 0 s: stopped: no room (2 of 2)",
    ]


# ---- whole sweeps


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep over two seeds, and what it said."""
    out, said = tmp_path_factory.mktemp("sweeps") / "sweep", []
    result = hyrl_mj.sweep("unit_circle", seeds=(0, 1), out=out, say=said.append, **SMOKE)
    return out, result, said


@pytest.mark.slow
def test_a_sweep_makes_the_runs_that_are_made_one_by_one(swept, tmp_path):
    out, result, said = swept
    assert [row.state for row in result.rows] == [DONE, DONE]
    assert any("unit_circle-0.1-1" in line and "retrain" in line for line in said)
    run = hyrl_mj.run("unit_circle", seed=1, out=tmp_path / "run", say=str, **SMOKE)
    names = ("policy", "mode_0", "mode_1")
    for name in [f"{name}.safetensors" for name in names] + [
        "extended_sets.npz",
        "critical_set.npz",
    ]:
        assert (run.path / name).read_bytes() == (out / "unit_circle-0.1-1" / name).read_bytes()
    assert result.rows[1].verdict == run.verdict.word


@pytest.mark.slow
def test_what_is_done_is_not_done_again_and_tables_are_made_from_what_is_there(swept):
    out, result, _ = swept
    before = {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}
    said = []
    again = hyrl_mj.sweep("unit_circle", seeds=(0, 1), out=out, say=said.append, **SMOKE)
    assert len(said) == 2
    assert all("done before" in line for line in said)
    assert again == result == report(out)
    assert {path: path.read_bytes() for path in before} == before
    with (out / "sweep.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["seed"] for line in lines] == ["0", "1"]
    assert float(lines[0]["hyrl_won"]) == pytest.approx(
        result.rows[0].figures["hyrl_won"], rel=1e-4
    )
    page = (out / "sweep.html").read_text()
    assert 'href="unit_circle-0.1-0/report.html"' in page
    assert "data:image/png;base64" in page


@pytest.mark.slow
def test_a_run_that_fails_does_not_stop_the_others(tmp_path):
    broken = tmp_path / "sweep" / "unit_circle-0.1-0"
    rows = [Row(CIRCLE, seed) for seed in (0, 1)]
    Sweep(Common("smoke", None, TINY), tuple(rows)).save(tmp_path / "sweep")
    broken.write_text("a file where the run directory should be")
    result = hyrl_mj.sweep("unit_circle", seeds=(0, 1), out=tmp_path / "sweep", say=str, **SMOKE)
    assert [row.state for row in result.rows] == ["stopped", DONE]
    assert str(broken) in result.rows[0].sentence


def test_a_machine_that_keeps_its_files_is_told_of(tmp_path):
    from hyrl_mj.pipeline.sweep import _on_disk

    kept = _on_disk(row(0), tmp_path)
    assert kept.state == "stopped"
    assert "share" in kept.sentence


def test_a_run_directory_that_is_held_is_waited_for(monkeypatch, tmp_path):
    from hyrl_mj.manifest import Busy

    tries = []

    def busy(task, options, say):
        tries.append(time.monotonic())
        if len(tries) < 2:
            raise Busy("another process is working there")
        raise BadInput("no more")

    monkeypatch.setattr(cluster, "run", busy)
    ended = cluster.make(Row(CIRCLE, 0), hyrl_mj.RunOptions(out=Path(tmp_path)), 1)
    assert (ended.state, ended.sentence) == ("stopped", "no more")
    assert len(tries) == 2
