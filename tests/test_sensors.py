"""Sensors: each part does what it says, together they stay within their bound, and runs are made for them."""

import shutil
from copy import copy
from dataclasses import dataclass, replace
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from manual import ROOT
from planted import few_noises

import hyrl_mj
from hyrl_mj import BadInput, Noise, RunOptions, Sensor, cli
from hyrl_mj.judging.game import percent
from hyrl_mj.pipeline import ExamineOptions, examine_run
from hyrl_mj.pipeline.runs import settings_of
from hyrl_mj.simulation import (
    KINDS,
    SENSOR,
    LoopSettings,
    Signal,
    closed_loop,
    covers_sensor,
    noise_of,
    register_noise,
    usual_kinds,
)
from hyrl_mj.simulation.noise import _KINDS, noise_class
from hyrl_mj.simulation.sensors import Part
from hyrl_mj.viz import beginning
from hyrl_mj.viz.tables import robustness_sentence, sensed_table

VEHICLE, CIRCLE = "vehicle", "unit_circle"
get_task = cache(hyrl_mj.get_task)  # how far a sample leads is found out once


@dataclass(frozen=True)
class Fixed:
    """Steers by the measurement alone."""

    def act(self, measured):
        return np.clip(-measured[:, -1:], -1, 1)


def played(text, n=50, task=VEHICLE, seed=0, steps=40):
    """What was added (K, n, p), and the rollout."""
    task = get_task(task)
    z0 = task.starts(n, np.random.default_rng(3))
    options = LoopSettings(record=True, quiet=True, steps=steps)
    loop = hyrl_mj.policies.PolicyController(Fixed())
    run = closed_loop(task, loop, z0, Sensor.parse(text), seed=seed, settings=options)
    return run.measured - run.true[:-1], run


def lateral(text, **options):
    return played(text, **options)[0][:, :, 1]


def test_noise_is_drawn_anew_within_its_bound():
    for text, spread in (("uniform 0.3", 0.3 / 3**0.5), ("gaussian 0.3 sigma 0.1", 0.0987)):
        noise = lateral(text)
        assert np.abs(noise).max() <= 0.3
        assert noise.std() == pytest.approx(spread, rel=0.05)
        assert abs(np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]) < 0.1
    assert np.abs(lateral("gaussian 0.1 sigma 9")).std() == pytest.approx(0.1 / 12**0.5, rel=0.1)


def test_a_bias_stays_and_differs_from_episode_to_episode():
    noise = lateral("bias 0.3")
    assert np.ptp(noise, axis=0).max() < 1e-12
    assert noise[0].min() < -0.25
    assert noise[0].max() > 0.25


def test_a_drift_goes_at_its_rate():
    task = get_task(VEHICLE)
    noise, step = lateral("drift 0.2 rate 0.5"), 0.5 * task.dt
    moved = np.abs(np.diff(noise, axis=0))
    assert moved.max() == pytest.approx(step)
    assert np.median(moved) == pytest.approx(step)
    assert np.abs(noise).max() <= 0.2
    assert (np.sign(noise[0]) != np.sign(noise[-1])).any()


def test_a_delay_is_what_was_true_before():
    run = played("delay 2", steps=20)[1]
    for k, before in ((0, 0), (1, 0), (2, 0), (3, 1), (9, 7)):
        on = run.length > k
        np.testing.assert_allclose(run.measured[k, on], run.true[before, on], rtol=0, atol=1e-12)
    drawn = played("delay 0-2", steps=20)[1]
    late = [
        {d for d in range(3) if np.allclose(drawn.measured[4, i], drawn.true[4 - d, i])}
        for i in np.flatnonzero(drawn.length > 4)
    ]
    assert all(late)
    assert {min(some) for some in late} == {0, 1, 2}


def test_a_run_that_ends_with_a_collision_is_measured_no_more():
    run = played("delay 3")[1]
    ended = run.length < len(run.measured)
    assert ended.any()
    rows = np.flatnonzero(ended)
    last = run.length[rows]
    np.testing.assert_array_equal(run.measured[last, rows], run.true[last, rows])


def test_samples_are_held_at_most_so_often_in_a_row():
    run = played("hold 3 rate 0.6", n=500, steps=13)[1]
    on = np.arange(1, len(run.measured))[:, None] < run.length
    x, longest, row = run.measured[:, :, 0], 0, np.zeros(500)
    held = (x[1:] == x[:-1]) & on  # the vehicles drive on
    for now in held:
        row = np.where(now, row + 1, 0)
        longest = max(longest, row.max())
    assert longest == 3
    # Of a chain that loses with probability p, but never more than three in a row.
    p = 0.6
    share = (p + p**2 + p**3) / (1 + p + p**2 + p**3)
    assert held.sum() / on.sum() == pytest.approx(share, abs=0.03)


def test_a_quantum_rounds_the_noisy_columns():
    run = played("uniform 0.05 + quantum 0.02")[1]
    y = run.measured[:, :, 1] / 0.02
    np.testing.assert_allclose(y, np.round(y), atol=1e-9)
    assert np.array_equal(run.measured[:, :, 0], run.true[:-1, :, 0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rover", "quadrotor"])
def test_what_robots_with_inertia_move_while_a_sensor_is_late_is_allowed_for(name):
    """Also where all inputs are in their middle, so that it goes straight on as fast as it can."""
    task = get_task(name)
    middle = hyrl_mj.from_callable(lambda o: np.full(len(o), len(task.input_levels) // 2), task)
    loop, options = hyrl_mj.policies.PolicyController(middle), LoopSettings(quiet=True)
    z0 = task.starts(200, np.random.default_rng(0))
    run = closed_loop(task, loop, z0, Sensor.parse("delay 2"), settings=options)
    assert run.length.max() > 20


@pytest.mark.slow
def test_a_turn_is_no_jump():
    assert np.abs(played("delay 1", task=CIRCLE, steps=150)[0]).max() <= 0.05 + 1e-9


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("uniform 0.05 + bias 0.02 + drift 0.03 + delay 2 + hold 2 + quantum 0.01", VEHICLE),
        ("gaussian 0.1 + delay 0-3 + quantum 0.05", CIRCLE),
        ("bias 0.1 + drift 0.05 rate 0.2 + hold 3 rate 0.7", "gate"),
    ],
)
def test_all_parts_together_stay_within_the_bound(text, name):
    sensor, task = Sensor.parse(text), get_task(name)
    assert str(Sensor.parse(str(sensor))) == str(sensor)
    noise, _ = played(text, task=name, seed=5, n=20)
    d = task.chart.dimension
    bound, shares = sensor.on(task)
    assert (np.nanmax(np.abs(noise), axis=(0, 1))[:d] <= bound * np.array(shares[:d]) + 1e-9).all()
    again, _ = played(text, task=name, seed=5, n=20)
    np.testing.assert_array_equal(noise, again)


BAD = {
    "": "unknown part of a sensor ''",
    "uniform": "write uniform N",
    "uniform x": "could not convert string to float: 'x'",
    "uniform 0.1 rate 3": "uniform has no rate",
    "drift 0.1 rate": r"write drift N \[rate X\]",
    "drift 0.1 rate 0": "give a rate > 0",
    "gaussian 0.1 sigma nan": "give a sigma > 0",
    "delay 0": "a whole number of samples",
    "delay 1.5": "a whole number of samples",
    "delay 3-1": "give the shortest delay first",
    "delay 1 + delay 2": "more than one delay",
    "hold 3 rate 2": r"share of samples that are held, in \(0, 1\]",
    "quantum -1": "finite number >= 0",
    "bias inf": "finite number >= 0",
    "unifrom 0.1": "Did you mean 'uniform'",
    "sensor 0.1": "unknown part of a sensor",
    "0.1": r"names no kind: .* 'uniform 0.1', or the bound alone as eps 0.1",
    "uniform 0.1 +": "unknown part of a sensor ''",
    "uniform 1e308 + bias 1e308": r"give at most 1e\+30",
    "uniform 0.1 + quantum 1e-320": r"give numbers from 1e-30 to 1e\+30",
    "+".join(["bias 0"] * 21): "has 21 parts: give at most 20",
}


@pytest.mark.parametrize("text", BAD)
def test_what_is_no_sensor_is_refused(text):
    with pytest.raises(BadInput, match=BAD[text]):
        Sensor.parse(text)


def test_what_cannot_be_sensed_is_refused():
    vehicle = get_task(VEHICLE)
    with pytest.raises(BadInput, match="60: give fewer"):
        Sensor.parse("delay 60").on(vehicle)
    with pytest.raises(BadInput, match="hides the whole state space"):
        Sensor.parse("uniform 1 + bias 1").on(vehicle)
    with pytest.raises(BadInput, match="adds nothing"):
        Sensor.parse("uniform 0").on(vehicle)
    with pytest.raises(BadInput, match="field takes a bound of noise, and no sensor"):
        settings_of(get_task("field"), RunOptions(noise="bias 0.05"))
    with pytest.raises(BadInput, match="has no sensor of its own"):
        Noise("sensor", 0.1).against(vehicle, None)
    environment = copy(vehicle)
    environment.abilities = replace(vehicle.abilities, side_by_side=8)
    with pytest.raises(BadInput, match="put Gymnasium's DelayObservation around it"):
        Sensor.parse("delay 1").against(environment, None)
    assert Sensor.parse("bias 0.1").on(environment)[0] == 0.1


@register_noise
class Restless(Signal):
    """Noise with a generator that no seed decides."""

    kind = "restless"

    def reset(self, n, rng):
        self.own = np.random.default_rng()

    def sample(self, now):
        return self.own.uniform(-self.bound, self.bound, now.measurement.shape) * self.shares


@register_noise
class Growing(Signal):
    """Noise that raises its own bound."""

    kind = "growing"

    def sample(self, now):
        self.bound = self.bound * 1.1
        return np.zeros_like(now.measurement)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("restless 0.05 + delay 1", "other values where it begins anew with the same seed"),
        ("growing 0.05 + bias 0.05", "let sample\\(\\) leave bound and shares as they are"),
    ],
)
def test_noise_of_users_is_checked_inside_of_a_sum_and_in_an_environment(text, says):
    with pytest.raises(BadInput, match=says):
        played(text)
    if text.startswith("restless"):
        with pytest.raises(BadInput, match=says):
            gym.make("hyrl_mj/ObstacleAvoidance-v0", noise=Noise("restless", 0.05))


def test_a_late_sensor_needs_a_measurement_that_begins_with_the_chart():
    swapped = copy(get_task(VEHICLE))
    swapped.z = lambda measured: measured[:, ::-1]
    with pytest.raises(BadInput, match="let the measurement begin with them"):
        Sensor.parse("uniform 0.01 + delay 2").against(swapped, None)


def test_an_option_that_a_kind_cannot_take_is_refused(monkeypatch):
    kind = type(
        "Fixed", (noise_class("uniform"),), {"kind": "fixed", "sigma": property(lambda s: 1)}
    )
    monkeypatch.setitem(_KINDS, "fixed", kind)
    assert Sensor.parse("fixed 0.1").bound == 0.1
    with pytest.raises(BadInput, match="fixed has no sigma"):
        Sensor.parse("fixed 0.1 sigma 0.05")


def test_noise_that_cannot_be_copied_acts_in_an_environment():
    class Locked(noise_class("uniform")):
        """Uniform noise that holds what no copy can have."""

        def __deepcopy__(self, memo):
            raise TypeError("cannot be copied")

    noise = Locked(0.1, np.array([0.0, 1.0]))
    assert gym.make("hyrl_mj/ObstacleAvoidance-v0", noise=noise).reset(seed=0)[0].shape == (3,)


def test_what_hides_the_whole_chart_is_refused_wherever_it_is_used(tmp_path):
    vehicle = get_task(VEHICLE)
    with pytest.raises(BadInput, match="hides the whole state space"):
        Sensor.parse("uniform 50").against(vehicle, None)
    off = np.random.default_rng(0).uniform(-50, 50, 200)
    rows = [f"{0.05 * k:.2f},{k + off[k]},{k}" for k in range(200)]
    (tmp_path / "far.csv").write_text("\n".join(["t,y,y_ref", *rows]))
    with pytest.raises(BadInput, match="hides the whole state space"):
        noise_of(vehicle, f"log {tmp_path / 'far.csv'}", 0.0).against(vehicle, None)


def test_sums_tell_where_they_act():
    for text in ("uniform 0.05 + delay 1", "uniform 0.05"):
        with pytest.raises(BadInput, match="leave all coordinates out"):
            noise_of(get_task(VEHICLE), text, 0.0, everywhere=True)
    with pytest.raises(BadInput, match="leave all coordinates out"):
        Noise("sensor", 0.1, everywhere=True).against(get_task(VEHICLE), None)


def test_parts_made_in_python_are_checked_as_texts_are():
    with pytest.raises(BadInput, match="a whole number of samples"):
        Part("delay", 1.5)
    with pytest.raises(BadInput, match="more than one delay"):
        Sensor((Part("delay", 1), Part("delay", 3)))
    with pytest.raises(BadInput, match="is no text"):
        Sensor.parse(None)
    with pytest.raises(BadInput, match="give a text"):
        hyrl_mj.run(VEHICLE, noise=Noise("uniform", 0.1))
    given = RunOptions(noise=Sensor.parse("bias 0.04"))
    assert settings_of(get_task(VEHICLE), given).sensor == "bias 0.04"


def test_words_of_sensors_are_no_kinds_of_noise():
    with pytest.raises(BadInput, match="'delay' means something else"):
        register_noise(type("Late", (Signal,), {"kind": "delay"}))


# ---- logs


def test_an_angle_in_a_log_is_one_where_the_chart_says_so(tmp_path):
    rng, k = np.random.default_rng(0), np.arange(4000)
    true = 0.03 * k + 0.5 * np.sin(k / 15)
    told = np.append(np.full(2, true[0]), true[:-2]) + 0.05 + rng.uniform(-0.02, 0.02, len(k))
    turns = [(values % (2 * np.pi)).tolist() for values in (told, true)]
    lines = [f"{0.05 * i:.2f},{a},{b}" for i, a, b in zip(k, *turns, strict=True)]
    path = tmp_path / "theta.csv"
    path.write_text("\n".join(["t,theta,theta_ref", *lines]))
    noise = noise_of(get_task(CIRCLE), f"log {path}", 0.0)
    assert noise.bound == pytest.approx(0.07, rel=0.05)
    assert noise.worst.delay == 2


@pytest.fixture
def log(tmp_path):
    """A log in which y is 0.01 k too high at its k-th sample, and its reference moves."""
    path, rows = tmp_path / "log.csv", range(400)
    lines = [f"{0.05 * k:.2f},{np.sin(k / 9) + 1e-4 * k},{np.sin(k / 9)}" for k in rows]
    path.write_text("\n".join(["t,y,y_ref", *lines]))
    return path


def test_each_run_plays_a_window_of_a_log(log):
    task = get_task(VEHICLE)
    noise = noise_of(task, f"log {log}", 0.0)
    z0 = np.tile([0.0, 0.9], (40, 1))
    options = LoopSettings(record=True, quiet=True, steps=30)
    loop = hyrl_mj.policies.PolicyController(Fixed())
    run = closed_loop(task, loop, z0, noise, seed=0, settings=options)
    added = run.measured[:, :, 1] - run.true[:-1, :, 1]
    begun = added[0]
    assert np.ptp(begun) > 0.02
    assert begun.min() >= -1e-9
    assert noise.bound == pytest.approx(399e-4)
    inside = begun < 0.036  # of those that do not come to the end of the log
    np.testing.assert_allclose(
        added[:30, inside], begun[inside] + 1e-4 * np.arange(len(added))[:, None], atol=1.1e-4
    )
    around = added[-1] < begun  # the others go on at its beginning
    assert around.any()
    assert not (run.measured[:, :, 0] != run.true[:-1, :, 0]).any()


def test_what_is_no_log_of_a_task_is_refused(log, tmp_path):
    with pytest.raises(BadInput, match="rename the columns"):
        noise_of(get_task(CIRCLE), f"log {log}", 0.0).against(get_task(CIRCLE), None)
    with pytest.raises(BadInput, match="cannot be read"):
        noise_of(get_task(CIRCLE), f"log {tmp_path / 'none.csv'}", 0.0)
    with pytest.raises(BadInput, match="hyrl-mj noise LOG"):
        hyrl_mj.run(VEHICLE, noise=f"log {log}", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


# ---- runs


def make_late(folder):
    """Makes the run of the manual's page about sensors."""
    text = "uniform 0.05 + bias 0.05 + delay 1"
    with pytest.MonkeyPatch.context() as patch:
        few_noises(patch)
        hyrl_mj.run(VEHICLE, noise=text, preset="smoke", out=folder / "run", say=str)


@pytest.fixture(scope="module")
def late(small_runs, made_once, tmp_path_factory):
    """A run that is made for a sensor, which these tests examine again."""
    made = made_once("late", make_late) / "run"
    return hyrl_mj.load_run(shutil.copytree(made, tmp_path_factory.mktemp("late") / "run"))


def test_what_a_sensor_does_is_not_judged_where_noise_acts_everywhere(vehicle):
    task = vehicle.with_sensor("uniform 0.05", (0.0, 1.0))
    assert usual_kinds(task, 0.1) == (*KINDS, SENSOR)
    assert usual_kinds(task.noisy_everywhere(), 0.1, everywhere=True) == KINDS


@pytest.mark.slow
def test_a_run_is_made_for_a_bound_that_covers_the_sensor(late, capsys):
    run, s = hyrl_mj.load_run(late.path), late.settings
    assert (s.eps, s.sensor) == (0.15005, "uniform 0.05 + bias 0.05 + delay 1")
    np.testing.assert_allclose(run.task.noisy, (0.05005 / 0.15005, 1))
    assert run.task.sensor_shares == (False, True)
    assert covers_sensor(run.task, 0.15005)
    assert not covers_sensor(run.task, 0.149)
    assert "noise of up to 0.05005 m on x, 0.15005 m on y" in str(run.verdict.reasons)
    assert any("within that bound: uniform 0.05" in reason for reason in run.verdict.reasons)
    sensed = run.robustness.game.sensed
    assert [*sensed] == ["policy", "hyrl"]
    under = sensed_table(run.task, run.robustness.game)
    assert under.rows[1] == ["HyRL", *map(percent, vars(sensed["hyrl"]).values())]
    assert any(f"from {under.rows[1][1]} of all starts" in reason for reason in run.verdict.reasons)
    assert f"HyRL {under.rows[1][1]} proved" in robustness_sentence(run.robustness)
    arc = hyrl_mj.simulate(run.task, run.controller, [0.0, 0.3], Noise("sensor"))
    assert arc.measured[1, 0] == arc.z[0, 0]
    assert "--noise 'uniform 0.05 + bias 0.05 + delay 1'" in beginning(run)
    words = ("--start", "0", "0.3", "--noise")
    assert cli.dispatch(["simulate", str(late.path), *words, "gaussian 0.02 + hold 2"]) is None
    with pytest.raises(BadInput, match="leave eps out"):
        cli.dispatch(["simulate", str(late.path), *words, "bias 0.1", "--eps", "0.1"])


@pytest.mark.long
@pytest.mark.slow
def test_noisy_episodes_have_the_sensor_among_their_kinds(late):
    run = hyrl_mj.load_run(late.path)
    examine_run(run, ExamineOptions(episodes=20))
    kinds = {count.noise for count in hyrl_mj.load_run(late.path).robustness.episodes}
    assert kinds == {*KINDS, SENSOR}
    examine_run(run, ExamineOptions(episodes=20, eps=0.05))  # which does not cover the sensor
    kinds = {count.noise for count in hyrl_mj.load_run(late.path).robustness.episodes}
    assert kinds == {*KINDS}


@pytest.mark.slow
def test_a_robot_declares_its_sensors_once(tmp_path):
    shutil.copytree(ROOT / "models" / "common", tmp_path / "common")
    shutil.copy(ROOT / "models" / "vehicle.xml", tmp_path / "late.xml")
    file = tmp_path / "late.py"
    file.write_text(
        "from hyrl_mj.tasks.vehicle import Vehicle\n\n\nclass Late(Vehicle):\n    name = 'late'\n"
        "    env_id = 'hyrl_mj/Late-v0'\n"
        "    sensor = 'bias 0.02 + delay 1'\n"
    )
    task = get_task(file)
    for options, noise in (({}, 0.07005), ({"eps": 0.1}, 0.1), ({"noise": "bias 0.04"}, 0.04)):
        assert settings_of(task, RunOptions(**options)).eps == noise


@pytest.mark.parametrize("options", [{"eps": 0.1}, {"all_coordinates": True}])
def test_a_sensor_tells_its_own_bounds(options, tmp_path):
    with pytest.raises(BadInput, match="leave eps and all_coordinates out"):
        hyrl_mj.run(VEHICLE, noise="bias 0.1", out=tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()
