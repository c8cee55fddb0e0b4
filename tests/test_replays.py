"""What is proved or won is replayed in MuJoCo; one lost start is named, and plain MuJoCo is the judge."""

import json
import shutil
from copy import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from planted import (
    circle_controller,
    halves,
    ideal_controller,
    one_way_policy,
    without_pictures,
)
from test_certificate import EPS, hybrid

import hyrl_mj
from hyrl_mj import BadInput, Noise, pipeline
from hyrl_mj.judging import worst_case as examination
from hyrl_mj.judging.game import NEVER, Game
from hyrl_mj.judging.proof import Certificate, replays
from hyrl_mj.judging.verdict import Verdict
from hyrl_mj.judging.worst_case import worst_case
from hyrl_mj.policies import PolicyController
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import NOT_STARTED, LoopSettings, closed_loop, judge, judge_task
from hyrl_mj.tasks import Outcome
from hyrl_mj.tasks.vehicle import Vehicle

FEW = {"none": 120, "uniform": 120, "alternating": 120, "worst": 60, "cells": 20, "sensor": 60}


@pytest.fixture(autouse=True)
def few_starts(monkeypatch):
    monkeypatch.setattr(replays, "STARTS", FEW)
    monkeypatch.setattr(replays, "BATCH", 100)
    monkeypatch.setattr(replays, "WHOLE", 100)


@pytest.fixture(scope="module")
def loops(vehicle):
    return {"hyrl": hybrid(vehicle)}


@pytest.fixture(scope="module")
def certified(vehicle, loops):
    game = Game(vehicle, halves(vehicle), loops, EPS, grid=Grid.with_cells(vehicle.chart, 240))
    return Certificate.certify(game, loops)


@pytest.fixture
def certificate(certified):
    """The certificate, with a game of its own, whose task may be changed."""
    return replace(certified, game=copy(certified.game))


@pytest.fixture(scope="module")
def scores(certified, loops):
    return examination._scores(certified, (EPS,))[0]


def delayed(samples):
    """The vehicle, whose steering answers some samples late."""

    class Late(Vehicle):
        def __init__(self):
            spec = mujoco.MjSpec.from_file(str(self.model_path))
            steering = spec.actuator("lateral_velocity")
            steering.delay, steering.nsample = samples * 0.05, samples + 1
            self.model = spec.compile()

    return Late()


@pytest.mark.slow
def test_an_honest_plant_keeps_what_is_proved(certificate, loops, scores):
    assert scores["hyrl"][-1].proved > 0.99
    (count,) = examination._replays(certificate, scores)
    assert (count.controller, count.of, count.eps, count.first) == ("hyrl", "proved", EPS, None)
    assert count.starts == {kind: n for kind, n in FEW.items() if kind != "sensor"}
    assert (count.failures, count.judged, count.is_whole) == (0, 440 // 20, True)


@pytest.mark.slow
def test_a_plant_that_lags_behind_what_was_proved_of_it_loses_the_word(certificate, loops, scores):
    certificate.game.task = delayed(3)  # what was proved is true of another plant
    (count,) = examination._replays(certificate, scores)
    assert 0 < count.lost["none"] <= count.failures < count.played
    assert count.judged >= count.failures
    first, task = count.first, certificate.game.task
    noise = None if first.noise == "none" else Noise(first.noise, EPS)
    mode = None if first.q0 is None else np.array([first.q0])
    run = closed_loop(task, loops["hyrl"], np.array([first.start]), noise, mode)
    assert Outcome(run.outcome[0]).label == first.outcome != "reached"


@pytest.mark.slow
def test_a_proof_of_everything_is_refuted(vehicle, monkeypatch):
    """From one side to the other no policy can change in front of the pillar."""
    lost = {"hyrl": ideal_controller(vehicle, overlap=0.6)}
    game = Game(vehicle, halves(vehicle), lost, EPS, grid=Grid.with_cells(vehicle.chart, 120))
    everything = Certificate.certify(game, lost)
    grid = {"hyrl": hybrid(vehicle, cells=60)}
    cells = Certificate.certify(
        Game(vehicle, halves(vehicle), grid, EPS, grid=game.lattice.grid), grid
    )
    everything = replace(everything, cells=cells.cells)
    places = np.zeros((3, cells.cells.places), dtype=int)
    monkeypatch.setattr(Certificate, "value", lambda self, name, eps: places)
    score = replace(examination._scores(cells, (EPS,))[0]["hyrl"][-1], proved=1.0)
    (count,) = examination._replays(everything, {"hyrl": (score,)})
    assert 0 < count.failures < count.played
    assert count.first.outcome == "crashed"


@pytest.mark.slow
def test_starts_that_are_won_are_replayed_where_nothing_is_proved(vehicle):
    """Of policies that are no networks nothing is proved."""
    loops = {"hyrl": ideal_controller(vehicle), "policy": PolicyController(one_way_policy(vehicle))}
    result, _ = worst_case(vehicle, np.empty((0, 2)), halves(vehicle), loops, (EPS,), cells=120)
    (won,) = [c for c in result.replays if result.scores[c.controller][-1].not_broken == 1]
    assert (won.controller, won.of, won.failures) == ("hyrl", "won", 0)
    assert [*won.starts] == ["none", "uniform", "alternating", "worst"]
    assert won.starts["none"] == FEW["none"]


def test_an_estimate_is_not_replayed(certificate, loops, scores, monkeypatch):
    monkeypatch.setattr(type(certificate.game.lattice), "estimate", True)
    assert examination._replays(certificate, scores) == ()


def test_starts_lie_in_what_is_proved_in_every_mode_and_at_its_border(certificate, loops, scores):
    assert scores["hyrl"][-1].proved > 0.99
    batches = replays.batches_of(certificate, "hyrl", EPS, "proved")
    z0, q0 = (np.concatenate([getattr(b, name) for b in batches]) for name in ("z0", "q0"))
    assert set(q0) == {-1, 0, 1}
    cells, spacing = certificate.cells, certificate.game.lattice.grid.spacing
    value = certificate.value("hyrl", EPS)[:, :-2]
    each = 440 // 3
    for mode, row in ((0, 0), (1, 1), (-1, 2)):
        assert abs((q0 == mode).sum() - each) < 5

        proved = value[row] < NEVER
        assert proved[cells.place(z0[q0 == mode])].all()
        outer = ~proved & ~cells.arrived
        beside = [
            outer[np.minimum(cells.place(z0[q0 == mode] + spacing * step), cells.nodes - 1)]
            for step in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        assert np.any(beside, axis=0).mean() > 0.2
    firsts = {b.noise.kind: b for b in reversed(batches)}
    assert all(b.steps is None and len(set(b.q0)) == 3 for b in firsts.values())
    others = [b for b in batches if b.steps is not None]
    assert others
    for b in others:  # until they are proved to have arrived
        rows = {0: 0, 1: 1, NOT_STARTED: 2}
        proved = [value[rows[q], cells.place(z[None])[0]] for z, q in zip(b.z0, b.q0, strict=True)]
        assert (b.steps == np.maximum(proved, 1)).all()
    off = (z0 - vehicle_low(certificate)) / spacing
    assert np.std(off - np.round(off), axis=0).min() > 0.2, "between the nodes"


def vehicle_low(certificate):
    return np.array(certificate.game.task.chart.low)


@pytest.mark.long
@pytest.mark.slow
def test_a_run_of_which_too_much_is_proved_says_so_everywhere(
    planted_circle, tmp_path, monkeypatch, capsys
):
    shutil.copytree(planted_circle[0].path, path := tmp_path / "run")
    without_pictures(monkeypatch)
    real = Certificate.value
    monkeypatch.setattr(Certificate, "value", lambda *asked: np.zeros_like(real(*asked)))
    pipeline.examine_run(hyrl_mj.load_run(path), say=print)
    run = hyrl_mj.load_run(path)
    game = run.robustness.game
    found = game.replays_of("hyrl")
    assert game.scores["hyrl"][-1].proved == 1
    assert found.failures > 0
    unseen = replace(found, lost=dict.fromkeys(found.lost, 0), first=None)
    believed = replace(run.robustness, game=replace(game, replays=(unseen,)))
    facts = run.retraining, run.arrivals
    assert Verdict.judge(run.task, EPS, believed, *facts).word == "PROVED"
    assert run.verdict.word == "FAILED"
    assert "withdrawn: a proved start was lost in a replay: from theta = " in run.verdict.sentence
    assert f"HyRL lost {found.failures:,} of {found.played:,} replays" in capsys.readouterr().out
    content = json.loads((path / "robustness.json").read_text())
    (told,) = [c for c in content["game"]["replays"] if c["controller"] == "hyrl"]
    assert told["first"]["outcome"] == found.first.outcome
    pipeline.run_stage(run, "report", print)
    page = (path / "report.html").read_text()
    assert "ithdrawn: a proved start was lost in a replay" in page
    assert "replays in MuJoCo, noise of up to" in page


# ---- plain MuJoCo as judge


def played(task, controller, n=8, noise=0.1, **settings):
    z = task.starts(n, np.random.default_rng(0))
    settings = LoopSettings(record=True, quiet=True, **settings)
    run = closed_loop(task, controller, z, Noise("uniform", noise), settings=settings)
    return run, task.state(z, settings.rng_of_starts(0))


class Straight:
    """A policy that answers the middle of the input limits."""

    def __init__(self, task):
        self.middle = np.mean(task.input_limits, axis=0)

    def act(self, measured):
        return np.tile(self.middle, (len(measured), 1))


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ["vehicle", "unit_circle", "rover", "quadrotor", "gate", "arm"])
def test_plain_mujoco_plays_the_same_episodes(name):
    task = hyrl_mj.get_task(name)
    for vary in (False, True):
        run, start = played(task, PolicyController(Straight(task)), vary=vary)
        assert judge(task, run, start) == 8
        assert judge(task, run, start, [5, 2]) == 2


def test_what_differs_is_named_with_sample_and_both_values(circle):
    run, start = played(circle, circle_controller(circle))
    for name, change, told in (
        ("true", 1e-6, r"the measurement at sample 7 is .*, and .* where the same inputs"),
        ("u", 0.5, r"the measurement at sample 8 is"),
    ):
        values = getattr(run, name).copy()
        values[7, 3] += change if name == "true" else -np.sign(values[7, 3]) * change
        with pytest.raises(BadInput, match=told):
            judge(circle, replace(run, **{name: values}), start)
        judge(circle, replace(run, **{name: values}), start, [0, 1, 2, 4])
    outcome = run.outcome.copy()
    outcome[3] = Outcome.CRASHED
    with pytest.raises(BadInput, match=r"the end at sample 150 is crashed, and reached where"):
        judge(circle, replace(run, outcome=outcome), start)


def test_a_simulation_that_diverges_has_to_diverge_in_plain_mujoco_too(circle):
    run, start = played(circle, circle_controller(circle))
    outcome, length = run.outcome.copy(), run.length.copy()
    outcome[2], length[2] = Outcome.UNSTABLE, 40
    with pytest.raises(BadInput, match="the end at sample 40 is unstable, and runs on where"):
        judge(circle, replace(run, outcome=outcome, length=length), start)


class Counting(Vehicle):
    """Its reward grows with every question: a memory in the task."""

    calls = 0

    def reward(self, measurement, u):
        type(self).calls += 1
        return super().reward(measurement, u) + 1e-3 * self.calls


class Mixing(Vehicle):
    """Its observation depends on the others of a batch."""

    def observation(self, measured):
        seen = super().observation(measured)
        seen[:, 1] -= 1e-3 * seen[:, 1].mean()
        return seen


class Ordered(Vehicle):
    """Its end depends on the place in a batch."""

    def ending(self, measurement):
        ends = super().ending(measurement)
        ends[4:][measurement[4:, 0] > 1] = Outcome.REACHED
        return ends


class Leaking(Vehicle):
    """Its measurement keeps what was measured before."""

    before = 0.0

    def measure(self, sensors):
        measured = sensors + np.array([0.0, 1e-6 * self.before])
        type(self).before = float(np.mean(sensors))
        return measured


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        (Counting, "the reward at sample"),
        (Mixing, r"observation\[1\] at sample 0"),
        (Ordered, "the end at sample"),
        (Leaking, r"measurement\[1\] at sample"),
    ],
)
def test_a_task_with_a_memory_or_a_view_of_others_is_refused_by_name(kind, told):
    task = kind()
    controller = PolicyController(one_way_policy(task))
    run, start = played(task, controller)
    with pytest.raises(BadInput, match=rf"vehicle is not simulated as .* {told}"):
        judge(task, run, start)


@pytest.mark.parametrize("kind", [Counting, Mixing, Ordered, Leaking])
def test_a_run_of_such_a_task_is_refused_before_it_trains(kind, tmp_path, monkeypatch):
    with pytest.raises(BadInput, match="vehicle is not simulated as MuJoCo alone simulates it"):
        judge_task(kind())
    monkeypatch.setattr("hyrl_mj.pipeline.runs.check_task", lambda task, played: task)
    monkeypatch.setattr(hyrl_mj.runs.directory.Run, "task", kind())
    with pytest.raises(BadInput, match="something keeps a memory between episodes or copies"):
        hyrl_mj.run("vehicle", preset="smoke", out=tmp_path / "run")
    assert not (tmp_path / "run" / "policy.safetensors").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vehicle", "beam", "field"])
def test_the_tasks_of_this_package_are_simulated_as_plain_mujoco_does(name):
    assert judge_task(hyrl_mj.get_task(name)) == 50


@pytest.mark.slow
def test_every_examination_by_episodes_is_judged(puck, monkeypatch):
    from hyrl_mj.judging import Regions, episodes, noisy_episodes

    asked = []

    def judged(task, run, start, rows):
        asked.append((len(rows), (run.outcome != Outcome.REACHED).sum(), rows))
        return judge(task, run, start, rows)

    monkeypatch.setattr(episodes, "judge", judged)
    monkeypatch.setattr(episodes.cores, "in_processes", lambda work, calls: map(work, calls))
    kinds, loop = (
        [Noise(kind, 0.02) for kind in ("none", "uniform")],
        PolicyController(Straight(puck)),
    )
    before = noisy_episodes(puck, Regions(np.empty((0, 2))), {"policy": loop}, kinds, 400)
    assert [rows for rows, *_ in asked] == [250, 250]
    monkeypatch.setattr(episodes, "JUDGED", 0)
    assert noisy_episodes(puck, Regions(np.empty((0, 2))), {"policy": loop}, kinds, 400) == before
