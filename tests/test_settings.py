"""Every setting has a type and a range, where it is made and where it is read."""

import inspect
import json
import math
from dataclasses import asdict, fields, replace

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, Outcome
from hyrl_mj.files import artifacts
from hyrl_mj.files.manifest import FILES
from hyrl_mj.judging.game import Lattice
from hyrl_mj.learning import Settings, Training, changed, changes, differing, preset, training
from hyrl_mj.learning.options import OPTIONS, OWN
from hyrl_mj.policies import algorithms
from hyrl_mj.runs.directory import Config, Run
from hyrl_mj.sets import MOST_NODES, Grid

NAN, INF = math.nan, math.inf


@pytest.fixture(scope="module")
def settings(circle):
    return preset(circle, "smoke")


# Values that are not allowed, and a part of the sentence.
OF_RUNS = {
    "task": (["", 5, None, "a\x1bb"], "give a text"),
    "preset": (["quick", None], "fast, paper, smoke"),
    "seed": ([-1, 2**32, 1.0, True, "0"], "from 0 to 4294967295"),
    "eps": ([-0.1, NAN, INF, "0.1", None], "finite number >= 0"),
    "horizon": ([0, -1.0, NAN, INF, "1"], "> 0"),
    "stage1": ([None, {}, "ppo"], "a Training or Agent"),
    "stage6": ([None, {}], "a Training"),
    "cells": ([-5, 0, 1, 10**7, 12.0, "12", True, NAN], "an integer from 2 to"),
    "rods": ([1, 2.5], "an integer from 2 to"),
    "lattice": ([-1, 10**7, 0.5], "an integer from 0 to"),
    "resolution": ([0, -1, NAN, 2, 1e-9, "1"], "a number from 1e-06 to 1"),
    "search": (["rod", 1, []], "rods, outcome"),
    "everywhere": ([1, "yes", None], "True or False"),
    "sensor": (["", 5, "a\x1bb"], "give a text"),
    "ways": ([None, {}, 4.0], "a WaySettings"),
    "overlap": ([None, {}], "OverlapSettings"),
    "modes": ([None, {}], "a ModeSettings"),
    "table": ([None, {}], "a TableSettings"),
    "attack": ([None, {}], "an? AttackSettings"),
    "verdict": ([None, {}], "a VerdictSettings"),
}
GROUPS = ("ways", "overlap", "modes", "table", "attack", "verdict")
# The same of the groups of settings.
OF_GROUPS = {
    "ways.samples": ([0, 1.5, "few"], "an integer from 1 to"),
    "ways.parting": ([0, 1.1, NAN], "> 0 and <= 1"),
    "ways.link": ([0.5, NAN, None], "a number from 1 to"),
    "ways.wedge": ([-1, INF], "a number from 0 to"),
    "ways.least_share": ([-0.1, 2, True], "a number from 0 to 1"),
    "ways.near_share": ([1.01, NAN], "a number from 0 to 1"),
    "overlap.filled": ([0, 1.1], "> 0 and <= 1"),
    "overlap.gap": ([-1, NAN], "a number from 0 to"),
    "overlap.longest": ([0, -1, INF], "> 0 and <= 3600"),
    "overlap.patience": ([-1, NAN], "a number from 0 to 3600"),
    "modes.lost_share": ([-0.1, 1.1], "a number from 0 to 1"),
    "modes.task_share": ([NAN, "most"], "a number from 0 to 1"),
    "modes.urgency": ([11, NAN], "a number from -10 to 10"),
    "modes.allowed_delay": ([0, -1], "> 0 and <= 10"),
    "modes.few": ([2, -1], "a number from 0 to 1"),
    "modes.margin": ([0.9, INF], "a number from 1 to 10"),
    "modes.batches": ([(), (0,), 64, (64.0,)], "batches"),
    "modes.allowed_miss": ([-1, NAN], "a number from 0 to 100"),
    "modes.miss_share": ([0, 1.5], "> 0 and <= 1"),
    "modes.alike": ([-0.1, 2], "a number from 0 to 1"),
    "modes.worth_attacking": ([-0.1, 2], "a number from 0 to 1"),
    "modes.may_break": ([-0.1, 2], "a number from 0 to 1"),
    "table.cells": ([-1, NAN], "a number from 0 to 100"),
    "table.bounds": ([-1, 101], "a number from 0 to 100"),
    "table.longest": ([0, 1.5], "an integer from 1 to"),
    "table.tables": ([0, True], "an integer from 1 to 100"),
    "table.worst": ([-0.1, 1.1], "a number from 0 to 1"),
    "attack.flips": ([0, 1.5], "an integer from 1 to"),
    "attack.period_step": ([0, NAN], "a number from 0.01 to 10"),
    "attack.segments": ([0, True], "an integer from 1 to"),
    "attack.population": ([0, None], "an integer from 1 to"),
    "attack.elites": ([0, 2.5], "an integer from 1 to"),
    "attack.explore": ([-0.1, 1.1], "a number from 0 to 1"),
    "attack.focused": ([0, "all"], "an integer from 1 to"),
    "attack.offspring": ([1, NAN], "an integer from 2 to"),
    "attack.pieces": ([0, 101], "an integer from 1 to 100"),
    "attack.spread": ([0, INF], "> 0 and <= 10"),
    "verdict.winnable": ([0.8, 1.1], "a number from 0.9 to 1"),
    "verdict.episodes": ([999, 1.5], "an integer from 1,000 to"),
    "verdict.attacked": ([299, True], "an integer from 300 to"),
}
OF_TRAININGS = {
    "algorithm": ([False, None, "sarsa", ""], "algorithm|a text"),
    "samples": (["abc", 0, -1, 1e5, NAN, 10**12], "an integer from 1 to"),
    "envs": ([0, 1.5, 10**6], "an integer from 1 to"),
    "hidden": ([(), 64, (0,), (64.0,), ("64",), (10**6,), (8,) * 99], "hidden"),
    "activation": (["swish", None, []], "tanh"),
    "learning_rate": ([0, -1, NAN, INF, "1e-3", 2], "> 0 and <= 1"),
    "anneal": ([1, "yes", None], "True or False"),
    "gamma": ([0, 1.1, NAN, "0.9"], "> 0 and <= 1"),
    "symmetric": ([0, None], "True or False"),
    "spread": ([0, None], "True or False"),
    "normalize": ([0, None], "True or False"),
    "final_rate": ([-0.1, 1.5, NAN], "a number from 0 to 1"),
    "rehearse": ([-0.1, 1.5, NAN, "half"], "a number from 0 to 1"),
    "rehearse_lost": ([-0.1, 1.5, NAN], "a number from 0 to 1"),
    "rehearse_deciding": ([-0.1, 0.7, NAN], "a number from 0 to 1|together give at most 1"),
    "warm_start": ([0, None], "True or False"),
    "episode": ([0, -3, 2.5, True], "an integer from 1 to"),
    "shaped": ([0, None], "True or False"),
    "attempts": ([0, 1.5, 10**6], "an integer from 1 to"),
    "minutes": ([-1, NAN, "3", 10**6], "a number from 0 to"),
    "action_noise": ([-1, NAN, 11, 0.1], "action_noise"),
    "options": ([None, 5, ["n_steps"]], "a dictionary"),
}


def cases(table):
    return [(name, value, says) for name, (values, says) in table.items() for value in values]


def replaced(settings, changes):
    return replace(settings, **changes)


def test_the_tables_leave_out_no_setting():
    assert set(OF_RUNS) == {field.name for field in fields(Settings)}
    assert set(OF_TRAININGS) == {field.name for field in fields(Training)}
    groups = {name: OF_RUNS[name] for name in GROUPS}
    names = (
        f"{g}.{f.name}" for g in groups for f in fields(Settings.__dataclass_fields__[g].default)
    )
    assert set(OF_GROUPS) == {*names}


@pytest.mark.parametrize(
    ("name", "value", "says"), [*cases(OF_RUNS), *cases(OF_TRAININGS), *cases(OF_GROUPS)]
)
def test_a_setting_out_of_its_range_is_one_sentence(settings, name, value, says):
    set_to, of = (changed, settings) if name in OF_GROUPS else (replaced, settings.stage1)
    with pytest.raises(BadInput, match=says) as refused:
        set_to(settings if name in OF_RUNS else of, {name: value})
    assert "\n" not in str(refused.value)
    if name in OF_GROUPS:
        assert str(refused.value).startswith(name.replace(".", ": "))
    elif name in OF_RUNS:
        assert name in str(refused.value) or name == "eps"
        assert str(value) in str(refused.value) or isinstance(value, str)


@pytest.mark.parametrize("name", OF_GROUPS)
def test_a_setting_of_a_stage_can_be_set_and_makes_the_stages_run_again(settings, tmp_path, name):
    group, _, field = name.partition(".")
    usual = getattr(getattr(settings, group), field)
    other = usual[:3] if name == "modes.batches" else usual + 1 if isinstance(usual, int) else 0.6
    other = 1.3 if name in ("ways.link", "modes.margin") else other
    other = 0.95 if name == "verdict.winnable" else other
    new = changed(settings, {name: json.dumps(other)})
    assert getattr(getattr(new, group), field) == other
    assert [*changes(new, settings)] == [name]
    assert next(differing(settings, new)).startswith(f"{name}: ")
    before, after = (Run(tmp_path, s).digests for s in (settings, new))
    assert all(before[stage] != after[stage] for stage in FILES)


@pytest.mark.parametrize(("name", "value", "says"), cases(OF_RUNS) + cases(OF_TRAININGS))
def test_a_file_with_such_a_setting_is_refused(settings, tmp_path, name, value, says):
    content = {"settings": asdict(settings), "versions": {}}
    inner = content["settings"] if name in OF_RUNS else content["settings"]["stage1"]
    inner[name] = value

    def write_and_read():
        artifacts.write_json(tmp_path / "config.json", content, "run")
        hyrl_mj.load_run(tmp_path)

    with pytest.raises(BadInput, match=r"start a new run|control characters") as refused:
        write_and_read()
    words = (name, {"eps": "noise bound"}.get(name, name), "control characters")
    assert any(word in str(refused.value) for word in words)


@pytest.mark.parametrize(
    "where",
    ["resolution", "everywhere", "stage1.episode", "stage6.options", "ways", "modes.margin"],
)
def test_a_file_without_a_setting_is_refused(settings, tmp_path, where):
    content = {"settings": asdict(settings), "versions": {}}
    inner = content["settings"]
    *path, last = where.split(".")
    for step in path:
        inner = inner[step]
    del inner[last]
    artifacts.write_json(tmp_path / "config.json", content, "run")
    with pytest.raises(BadArtifact, match=f"it has no settings.{where}"):
        hyrl_mj.load_run(tmp_path)


def test_numbers_of_numpy_become_plain_ones_that_a_file_can_hold(settings, tmp_path):
    changed = replace(settings, eps=np.float32(0.5), cells=np.int64(60), seed=np.uint8(3))
    assert [type(v) for v in (changed.eps, changed.cells, changed.seed)] == [float, int, int]
    artifacts.write_json(tmp_path / "config.json", Config(changed, {}), "run")
    assert Config.load(tmp_path / "config.json").settings == changed


def test_a_whole_number_may_stand_for_a_float(settings):
    assert replace(settings, eps=0, horizon=1).horizon == 1.0


def test_leaving_a_mode_for_ever_needs_a_discount(settings):
    with pytest.raises(BadInput, match=r"stage6\.gamma 1\.0 cannot be used.*less than 1"):
        replace(settings, stage6=replace(settings.stage6, gamma=1.0))
    assert replace(settings.stage1, gamma=1).gamma == 1.0


# ---- what fits the task


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"eps": 3.2}, "hides the whole state space of unit_circle"),
        ({"horizon": 8.0}, r"horizon 8 s.*at most 7\.5 s, the length of an episode of unit_circle"),
        ({"lattice": 10**6}, "has 1,000,000 nodes: give fewer cells"),
        ({"cells": 10**6}, "has 1,000,000 nodes: give fewer cells"),
        ({"rods": 10**6}, "has 1,000,000 nodes: give fewer cells"),
        ({"stage1": {"algorithm": "dqn"}}, "dqn needs levels of the input"),
    ],
)
def test_a_setting_that_does_not_fit_the_task_is_refused_when_a_run_is_opened(
    settings, circle, tmp_path, change, says
):
    if "stage1" in change:
        change = {"stage1": replace(settings.stage1, options={}, **change["stage1"])}
    wrong = replace(settings, **change)
    with pytest.raises(BadInput, match=says):
        wrong.check(circle)
    artifacts.write_json(tmp_path / "config.json", Config(wrong, {}), "run")
    with pytest.raises(BadInput, match=says):
        _ = hyrl_mj.load_run(tmp_path).task


def test_grids_and_lattices_fit_the_memory(circle, vehicle):
    Grid.with_cells(vehicle.chart, 700)
    with pytest.raises(BadInput, match=rf"at most {MOST_NODES:,}"):
        Grid.with_cells(vehicle.chart, 800)
    with pytest.raises(BadInput, match=r"100,000 nodes and .* inputs does not fit into the memory"):
        Lattice.tabulate(circle, Grid.with_cells(circle.chart, 100_000))


def test_a_lattice_without_a_node_to_start_from_is_refused(vehicle, monkeypatch):
    assert vehicle.chart_is_state  # which is found out once, from runs that go on
    monkeypatch.setattr(type(vehicle), "ending", lambda self, m: np.full(len(m), Outcome.CRASHED))
    with pytest.raises(BadInput, match="none at which vehicle goes on: give more cells"):
        Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 4))


def test_where_many_runs_take_too_long_there_are_fewer_and_the_bisection_is_coarser(
    vehicle, monkeypatch
):
    usual = preset(vehicle)
    assert usual.resolution == Settings.resolution
    monkeypatch.setattr(vehicle, "learning", replace(vehicle.learning, cells=30))
    coarse = preset(vehicle)
    assert (coarse.rods, coarse.cells) == (30, 30) != (usual.rods, usual.cells)
    assert Settings.resolution < coarse.resolution <= 1 / 8


# ---- options of SB3


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_is_one_of_sb3_and_none_is_decided_elsewhere(name):
    parameters = inspect.signature(algorithms.sb3_class(name).__init__).parameters
    assert set(OPTIONS[name]) <= set(parameters) - set(OWN)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"n_step": 8}, "unknown option of ppo 'n_step'.*Did you mean 'n_steps'"),
        ({"policy_kwargs": {}}, "unknown option of ppo"),
        ({"use_sde": True}, "unknown option of ppo"),
        ({"n_steps": 0}, r"options\.n_steps 0 cannot be used: give an integer from 1"),
        ({"batch_size": 1}, r"options\.batch_size 1 cannot be used: give an integer from 2"),
        ({"clip_range": NAN}, r"options\.clip_range nan"),
        ({"ent_coef": "auto"}, r"options\.ent_coef 'auto' cannot be used: give a number"),
        ({"normalize_advantage": 1}, "True or False"),
        ({"n_steps": 10**6}, "together give at most"),
    ],
)
def test_an_option_that_sb3_does_not_take_is_one_sentence(settings, options, says):
    with pytest.raises(BadInput, match=says):
        replace(settings.stage1, options=options)


def test_an_algorithm_that_would_learn_nothing_is_refused(vehicle):
    stage1 = preset(vehicle, "smoke").stage1
    with pytest.raises(BadInput, match=r"learning_starts 2,000 .*nothing would be learned in 500"):
        replace(stage1, samples=500)


def test_options_of_an_unknown_algorithm_are_plain_values(settings):
    foreign = replace(settings.stage1, algorithm="their:Own", options={"depth": 3, "mode": "a"})
    for options in ({"depth": [1]}, {"depth": NAN}, {"seed": 3}, {"policy_kwargs": "a"}):
        with pytest.raises(BadInput, match="options"):
            replace(foreign, options=options)


def test_what_sb3_refuses_when_it_is_built_is_one_sentence(circle, settings):
    alone = replace(settings.stage1, envs=1, options={"n_steps": 1})
    with pytest.raises(BadInput, match="ppo cannot train unit_circle: AssertionError") as refused:
        training.build(circle, alone, 0)
    assert "n_steps 1" in str(refused.value)


@pytest.mark.slow
def test_what_breaks_in_the_middle_of_a_training_is_one_sentence(circle, settings, monkeypatch):
    wild = replace(settings.stage1, learning_rate=1.0, anneal=False)

    def broken(self):
        raise RuntimeError("the loss is nan")

    monkeypatch.setattr("stable_baselines3.PPO.train", broken)
    with pytest.raises(
        BadInput, match=r"broke off after 4,096 samples.*the loss is nan"
    ) as refused:
        training.train(circle, wild, 0)
    assert "learning_rate 1.0" in str(refused.value)


@pytest.mark.slow
def test_weights_that_are_not_finite_end_a_training(circle, settings, monkeypatch):
    def spoiled(self):
        self.policy.action_net.bias.data[:] = np.nan

    monkeypatch.setattr("stable_baselines3.PPO.train", spoiled)
    with pytest.raises(BadInput, match=r"its weights are not finite|broke off"):
        training.train(circle, settings.stage1, 0)
