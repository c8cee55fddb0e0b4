"""The noise of a sensor is found in logs in which it was planted; what a log does not tell is said."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from command_line import call
from PIL import Image
from scipy import signal, stats

from hyrl_mj import BadInput, Sensor, from_callable, get_task, noise_from_log
from hyrl_mj.files import logs
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import LoopSettings, closed_loop, noise_of


def moved(t, amplitude=1.0):
    """What is true [m]: a motion with two periods."""
    return amplitude * (np.sin(0.7 * t) + 0.5 * np.sin(1.6 * t + 1))


def planted(
    seed, dt, amplitude=1.0, uniform=0.0, gaussian=0.0, bias=0.0, drift=(0.0, 1.0), delay=0,
    hold=(0, 0.0), lost=False, quantum=0.0, seconds=300,
):  # fmt: skip
    """A log of 300 s as columns by their names."""
    rng, t = np.random.default_rng(seed), np.arange(int(seconds / dt)) * dt
    n, (bound, rate), (most, share) = len(t), drift, hold
    x = moved(t, amplitude)
    slow = bound * signal.sawtooth(2 * np.pi * (t * rate / (4 * max(bound, 1e-9)) + seed / 3), 0.5)
    sent = x + bias + slow + rng.uniform(-uniform, uniform, n)
    sent += gaussian / 3 * stats.truncnorm.rvs(-3, 3, size=n, random_state=rng)
    if quantum:
        sent = np.round(sent / quantum) * quantum
    told = np.concatenate([np.full(delay, sent[0]), sent])[:n]
    row = 0
    for k in range(1, n):
        row = row + 1 if row < most and rng.random() < share else 0
        told[k] = told[k] if not row else np.nan if lost else told[k - 1]
    return {"t": t, "x": told, "x_ref": x}


def write(path, columns):
    """Writes a log, with empty cells for NaN."""
    rows = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        rows.append(",".join("" if np.isnan(value) else f"{value:.12g}" for value in row))
    path.write_text("\n".join(rows))
    return path


@pytest.fixture
def of(tmp_path):
    """The noise of the first column of a log."""
    return lambda columns, **how: noise_from_log(
        write(tmp_path / "log.csv", columns), **how
    ).columns[0]


# ---- what was planted is found


ALONE = {
    "uniform": ({"uniform": 0.05}, {"bound": 0.05, "sigma": 0.05 / 3**0.5, "uniform": True}),
    "gaussian": ({"gaussian": 0.06}, {"bound": 0.06, "sigma": 0.02, "uniform": False}),
    "bias": ({"bias": -0.03}, {"bias": -0.03}),
    "drift": ({"drift": (0.05, 0.01)}, {"drift": 0.05, "drift_rate": 0.01}),
    "delay": ({"delay": 3}, {"delay": 3}),
    "held": ({"hold": (3, 0.3)}, {"held": 3, "held_rate": 0.3}),
    "lost": ({"hold": (2, 0.2), "lost": True}, {"held": 2, "held_rate": 0.2}),
    "quantum": ({"quantum": 0.02}, {"quantum": 0.02}),
}
ALTERNATING = np.arange(100) % 2
NONE = {"bound": 0, "bias": 0, "drift": 0, "delay": 0, "held": 0, "held_rate": 0, "quantum": 0}


@pytest.mark.parametrize("kind", ALONE)
def test_each_quantity_is_found_alone_and_nothing_else(kind, of):
    plan, wanted = ALONE[kind]
    noise = of(planted(0, 0.05, **plan))
    largest = max(plan.get("drift", (0,))[0], plan.get("uniform", 0), plan.get("quantum", 0), 0.02)
    for name, value in (NONE | wanted).items():
        # Where nothing was planted, a twentieth of what was is let pass.
        tolerance = 0.1 * abs(value) if value else largest / 20
        assert getattr(noise, name) == pytest.approx(value, abs=tolerance), name
    assert str(Sensor.parse(noise.text)) == noise.text, "in the grammar of noise"
    assert set(noise.text.split()) & {"uniform", "gaussian", *ALONE, "hold"} == {
        {"held": "hold", "lost": "hold"}.get(kind, kind)
    }


@pytest.mark.parametrize(("scale", "kind"), [(0.1, "uniform"), (30, "gaussian")])
def test_all_together_are_found(scale, kind, of):
    plan = {"bias": 0.06, "drift": (0.06, 0.01), "quantum": 0.005, kind: 0.04}
    plan = {k: tuple(scale * np.array(v)) if k == "drift" else scale * v for k, v in plan.items()}
    noise = of(planted(1, 0.02, 3 * scale, delay=2, hold=(2, 0.2), **plan))
    assert (noise.delay, noise.held, noise.uniform) == (2, 2, kind == "uniform")
    found = [noise.bound, noise.bias, noise.drift, noise.drift_rate, noise.quantum, noise.held_rate]
    wanted = [plan[kind], plan["bias"], *plan["drift"], plan["quantum"], 0.2]
    np.testing.assert_allclose(found, wanted, rtol=0.1)


def test_a_deviation_that_is_no_third_of_the_bound_is_said(of):
    log = planted(0, 0.05)
    log["x"] += np.clip(np.random.default_rng(0).laplace(0, 0.01, len(log["x"])), -0.06, 0.06)
    noise = of(log)
    assert noise.text.startswith("gaussian 0.06")
    assert noise.sigma == pytest.approx(0.01 * 2**0.5, rel=0.1)
    assert f" sigma {noise.sigma:.3g}" in noise.text


@pytest.mark.slow
def test_the_worst_of_each_quantity_is_given_for_all(tmp_path):
    a, b = planted(0, 0.05, uniform=0.02, delay=2), planted(1, 0.05, uniform=0.05, bias=0.1)
    log = a | {"y": b["x"], "y_ref": b["x_ref"]}
    path = write(tmp_path / "log.csv", log)
    worst = noise_from_log(path).worst
    assert worst.bound == pytest.approx(0.05, rel=0.1)
    assert worst.bias == pytest.approx(0.1, rel=0.1)
    assert worst.delay == 2
    assert [c.name for c in noise_from_log(path, columns=["y"]).columns] == ["y"]
    told = call("noise", path, "--columns", "y,x").stdout
    assert "x: uniform 0.02 + delay 2\n" in told
    assert "is the worst of all columns, whatever their units" in told
    assert 'hyrl-mj run TASK --noise "uniform 0.0499 + bias 0.1 + delay 2"' in told


def test_angles_are_compared_round_the_circle(of):
    log = planted(0, 0.05, amplitude=3, uniform=0.05, delay=2)
    log = log | {name: np.mod(log[name], 2 * np.pi) for name in ("x", "x_ref")}
    noise = of(log, turn=["x"])
    assert (noise.delay, noise.text) == (2, f"uniform {noise.bound:.3g} + delay 2")
    assert noise.bound == pytest.approx(0.05, rel=0.1)


def test_other_units_are_named_and_scaled(of):
    log = planted(0, 0.05, uniform=0.05, seconds=60)
    milli = log | {"x": 1000 * log["x"]}
    with pytest.raises(BadInput, match=r"as mm against m: give --scale x=0[.]001"):
        of(milli)
    assert of(milli, scale={"x": 0.001}).bound == pytest.approx(0.05, rel=0.1)
    with pytest.raises(BadInput, match=r"as radians against degrees: give --scale x=57[.]29"):
        of(log | {"x_ref": np.degrees(log["x_ref"])})
    assert "0.8 times as much" in " ".join(of(log | {"x": 0.8 * log["x"]}).remarks)
    late = planted(0, 0.05, uniform=0.02, delay=2, seconds=60)
    with pytest.raises(BadInput, match="with the other sign: give --scale x=-1"):
        of(late | {"x": -late["x"]})
    assert of(late | {"x": -late["x"]}, scale={"x": -1}).delay == 2


@pytest.mark.slow
def test_times_in_milliseconds_are_asked_about_and_not_played(tmp_path):
    log = planted(0, 0.005, uniform=0.05, seconds=60)
    log["t"] *= 1000
    path = write_theta(tmp_path, log)
    assert "are the times in seconds?" in " ".join(noise_from_log(path).remarks)
    task = get_task("unit_circle")
    with pytest.raises(BadInput, match=r"5 s apart and the samples of unit_circle 0\.05 s"):
        noise_of(task, f"log {path}", 0.0).against(task, None)


# ---- what a log does not tell is said


def test_at_rest_there_is_no_bias_and_no_delay(of):
    log = planted(0, 0.05, amplitude=0, uniform=0.05, bias=0.3, hold=(2, 0.2))
    noise = of({"t": log["t"], "x": log["x"]}, at_rest=True)
    assert np.isnan(noise.bias)
    assert np.isnan(noise.delay)
    assert noise.bound == pytest.approx(0.05, rel=0.1)
    assert (noise.held, noise.held_rate) == (2, pytest.approx(0.2, rel=0.1))
    assert noise.remarks == ("without a reference, bias and delay cannot be told",)


SAID = {
    "needs 1,000 rows, and the log has 400": lambda log: {k: v[:400] for k, v in log.items()},
    "moves too little or too evenly for a delay": lambda log: log
    | {"x": log["x"] - log["x_ref"], "x_ref": 0 * log["t"]},
    "samples earlier than its reference": lambda log: log | {"x_ref": np.roll(log["x_ref"], 4)},
    "correlated from sample to sample": lambda log: log
    | {"x": log["x_ref"] + signal.lfilter([0.01], [1, -0.7], np.random.default_rng(0).normal(size=6000))},
    "alternating 0.02 describes it better": lambda log: log
    | {"x": log["x_ref"] + 0.02 * (-1.0) ** np.arange(6000)},
    "beyond the bound": lambda log: log | {"x": log["x"] + (log["t"] == 200)},
}  # fmt: skip


@pytest.mark.parametrize("what", SAID)
def test_what_the_log_does_not_tell_is_a_sentence(what, tmp_path):
    found = noise_from_log(write(tmp_path / "log.csv", SAID[what](planted(0, 0.05, uniform=0.02))))
    assert what in " ".join([*found.remarks, *found.columns[0].remarks])


def test_held_samples_are_not_guessed_where_the_quantum_hides_the_motion(of):
    noise = of(planted(0, 0.05, amplitude=0.1, quantum=0.05, hold=(2, 0.2)))
    assert "moves too little between samples for held ones to be told" in " ".join(noise.remarks)
    assert noise.held == 0


def test_gaps_and_uneven_times_are_said_and_are_no_lost_samples(tmp_path):
    log = planted(0, 0.05, uniform=0.05, delay=2)
    kept = np.r_[:2000, 2100:4000, 4010:6000]
    found = noise_from_log(write(tmp_path / "a.csv", {k: v[kept] for k, v in log.items()}))
    assert "2 gaps in time of up to 5.05 s" in " ".join(found.remarks)
    assert found.text == f"uniform {found.worst.bound:.3g} + delay 2"
    log["t"] = log["t"] + np.random.default_rng(0).uniform(0, 0.02, 6000)
    taken, counted = noise_from_log(write(tmp_path / "b.csv", log)).remarks
    assert "a sample is taken as 0.0499 s" in taken
    assert "delay and held samples are counted in samples of this log, of 0.0499 s" in counted


def test_a_column_that_never_changes_leaves_the_others(tmp_path):
    log = planted(0, 0.05, uniform=0.05)
    log |= {"dead": 0 * log["t"], "dead_ref": log["x_ref"]}
    path = write(tmp_path / "log.csv", log)
    assert noise_from_log(path).text.startswith("uniform 0.05")
    told = call("noise", path).stdout
    assert "dead never changes, so its noise cannot be told" in told
    with pytest.raises(BadInput, match="tells no noise: dead never changes"):
        noise_from_log(path, columns=["dead"])


@pytest.mark.filterwarnings("error")
def test_numbers_of_any_size_are_taken(of):
    log = {"x": np.where(np.arange(100) % 3, 1e-300 * ALTERNATING, np.nan)}
    assert "nan" not in of(log, dt=0.05, at_rest=True).text
    for tiny in (1e-9 * ALTERNATING, 0.9 * np.arange(100)):  # beside 1e9, the rounding of floats
        with pytest.raises(BadInput, match="tells no noise"):
            of({"x": 1e9 + tiny}, dt=0.05, at_rest=True)


# ---- the command, and files of strangers


@pytest.mark.slow
def test_the_command_draws_and_does_not_overwrite(tmp_path):
    path = write(tmp_path / "log.csv", planted(0, 0.05, uniform=0.05, drift=(0.05, 0.01)))
    assert call("noise", path, cwd=tmp_path).returncode == 0
    assert [*tmp_path.iterdir()] == [path]
    done = call("noise", path, "--out", "noise.png", cwd=tmp_path)
    assert done.stdout.endswith("picture at noise.png\n")
    with Image.open(tmp_path / "noise.png") as picture:
        colours = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)
    assert {(0, 114, 178), (213, 94, 0)} <= {*map(tuple, colours.tolist())}
    (tmp_path / "mine.png").write_text("mine")
    refused = call("noise", path, "--out", "mine.png", cwd=tmp_path)
    assert (refused.returncode, (tmp_path / "mine.png").read_text()) == (2, "mine")


ROWS = "".join(f"{k},{k % 7},{k % 5}\n" for k in range(100))
STRANGE = {
    "begins with the number": "1,2,3\n" + ROWS,
    "is empty": "",
    "has 1 row of samples": "t,x,x_ref\n1,2,3\n",
    "has 0 rows of samples": "t,x,x_ref\n",
    "which is no finite number": "t,x,x_ref\n0,a,1\n" + ROWS,
    "'inf', which is no": "t,x,x_ref\n0,inf,1\n" + ROWS,
    "line 102: the time does not increase": "t,x,x_ref\n" + ROWS + "5,0,0\n",
    "names the column 'x' twice": "t,x,x\n" + ROWS,
    "line 2 has 2 cells": "t,x,x_ref\n0,1\n" + ROWS,
    "has no column x_ref": "t,x,y\n" + ROWS,
    "has no measured column": "t\n1\n2\n",
    "has no column t or time": "s,x,x_ref\n" + ROWS,
    "fewer than 50 numbers": "t,x,x_ref\n" + "".join(f"{k},nan,1\n" for k in range(100)),
    "fewer than 50 samples with a reference": "t,x,x_ref\n"
    + "".join(f"{k},{k % 7},\n" for k in range(100)),
    "is no CSV file": 't,x,x_ref\n0,"1,2\n' + ROWS,
    "with control characters": "t,x\x1b[2J,x_ref\n" + ROWS,
    "is no text": b"\x89PNG\0\xff",
    "no finite number up to 1e+30": "t,x,x_ref\n0,-1e307,1\n" + ROWS,
    "x never changes": "t,x,x_ref\n"
    + "".join(f"{k},{k % 7}e-320,{k % 5}e-320\n" for k in range(100)),
    "a time of 1e-300 s between rows": "t,x,x_ref\n"
    + "".join(f"{k}e-300,{k % 7},{k % 5}\n" for k in range(100)),
    "names of up to 100,000 characters": "t,x,x_ref," + "a" * 100_000 + "\n" + ROWS,
    "500,000 names": ",".join(f"c{k}" for k in range(500_000)) + "\n" + ROWS,
}


@pytest.mark.parametrize("what", STRANGE)
def test_files_of_strangers_are_a_sentence(what, tmp_path):
    path, content = tmp_path / "log.csv", STRANGE[what]
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    done = call("noise", path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert what in done.stderr
    assert "\x1b" not in done.stderr


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["--columns", "y"], "unknown measured column"),
        (["--scale", "y=2"], "unknown column"),
        (["--scale", "x=0"], "give a factor"),
        (["--scale", "x=mm"], "give NAME=NUMBER"),
        (["--share", "2"], "from 0.5 to 1"),
        (["--dt", "0.05"], "leave --dt out"),
        (["--dt", "0"], "give one > 0"),
        (["--dt", "1e308"], "give one > 0"),
        (["--scale", "x=1e308"], "give a factor"),
        (["--out", "a.pdf"], "ends in .png"),
    ],
)
def test_wrong_options_are_a_sentence(options, what, tmp_path):
    write(tmp_path / "log.csv", planted(0, 0.05, uniform=0.05, seconds=60))
    done = call("noise", "log.csv", *options, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert what in done.stderr


def test_what_is_no_file_or_too_large_is_a_sentence(tmp_path, monkeypatch):
    assert "is no file" in call("noise", tmp_path).stderr
    assert "cannot be read" in call("noise", tmp_path / "none.csv").stderr
    monkeypatch.setattr(logs, "LARGEST", 2**20)
    (tmp_path / "log.csv").write_bytes(b"1" * (2**20 + 1))
    assert "is larger than 1 MiB" in call("noise", tmp_path / "log.csv").stderr
    monkeypatch.setattr(logs, "MOST_NUMBERS", 3 * 60)
    (tmp_path / "log.csv").write_text("t,x,x_ref\n" + ROWS)
    assert "line 62 is beyond the 60 rows" in call("noise", tmp_path / "log.csv").stderr


def test_a_log_of_gaps_alone_has_a_limit(tmp_path):
    rows = "".join(f"{k + k // 2 * 10_000},{k % 7},{k % 5}\n" for k in range(24_000))
    (tmp_path / "log.csv").write_text("t,x,x_ref\n" + rows)
    with pytest.raises(BadInput, match="so many gaps in time"):
        noise_from_log(tmp_path / "log.csv")


def test_a_log_without_times_takes_them_as_an_option(of):
    log = planted(0, 0.05, drift=(0.05, 0.01))
    del log["t"]
    assert of(log, dt=0.05).drift_rate == pytest.approx(0.01, rel=0.1)


def test_what_is_held_while_the_reference_moves_is_held_from_the_first_row_on(tmp_path):
    slow = planted(0, 0.01, uniform=0.02, seconds=60)
    slow["x"] = np.repeat(slow["x"][::10], 10)  # ten rows a measurement
    (column,) = noise_from_log(write(tmp_path / "slow.csv", slow)).columns
    assert (column.held, column.bound) == (9, pytest.approx(0.02, rel=0.1))
    assert np.abs(column.correlations[1:10]).max() == 0, "no two samples are so near to each other"
    late = planted(0, 0.05, uniform=0.02)
    late["x"][:20] = late["x"][0]
    (column,) = noise_from_log(write(tmp_path / "late.csv", late)).columns
    assert column.bound == pytest.approx(0.02, rel=0.1)


def test_beside_a_quantum_that_is_larger_both_reach_as_far_as_the_errors(tmp_path):
    quantum = 0.03
    log, rng = planted(0, 0.05, uniform=0.0), np.random.default_rng(0)
    log["x"] = np.round((log["x_ref"] + rng.normal(0, 0.005, len(log["t"]))) / quantum) * quantum
    (column,) = noise_from_log(write(tmp_path / "log.csv", log)).columns
    assert column.quantum == pytest.approx(quantum)
    assert np.mean(np.abs(log["x"] - log["x_ref"]) > column.bound + quantum / 2) < 0.002
    assert Sensor.parse(column.text).bound == pytest.approx(column.bound + quantum / 2, rel=0.01)


def test_angles_that_jump_by_a_turn_are_no_noise(tmp_path):
    log, rng = planted(0, 0.05, uniform=0.0), np.random.default_rng(0)
    true = 3 * log["x_ref"]
    log["x"], log["x_ref"] = (
        (values + np.pi) % (2 * np.pi) - np.pi
        for values in (true + rng.uniform(-0.1, 0.1, len(true)), true)
    )
    path = write(tmp_path / "log.csv", log)
    with pytest.raises(BadInput, match="give --turn x"):
        noise_from_log(path)
    exact = log | {"x": (true + 0.5 + np.pi) % (2 * np.pi) - np.pi}
    with pytest.raises(BadInput, match="give --turn x"):
        noise_from_log(write(tmp_path / "exact.csv", exact))
    (column,) = noise_from_log(path, turn=["x"]).columns
    assert column.bound == pytest.approx(0.1, rel=0.1)
    moved = planted(0, 0.05, uniform=4.0)  # [m]
    assert noise_from_log(write(tmp_path / "far.csv", moved)).worst.bound == pytest.approx(
        4.0, rel=0.1
    )


@pytest.mark.parametrize("factor", ["abc", None, True])
def test_a_factor_is_a_number(factor, tmp_path):
    with pytest.raises(BadInput, match="give a factor"):
        noise_from_log(tmp_path / "none.csv", scale={"x": factor})


def test_an_outlier_is_no_turn(of):
    log = planted(0, 0.05, uniform=0.1)
    log["x"][3_000] += 20
    assert of(log).bound == pytest.approx(0.1, rel=0.1)


def test_a_constant_error_is_a_bias_and_no_turn(of):
    log = planted(0, 0.05)
    assert of(log | {"x": log["x_ref"] + 0.3}).text == "bias 0.3"
    assert of(log | {"x": np.roll(log["x_ref"], 4)}).text == "delay 4"


# ---- a log that is played


def test_a_log_is_not_played_in_its_gaps(tmp_path):
    log = planted(0, 0.05, uniform=0.05, seconds=60)
    late = {name: np.concatenate([log[name], log[name] + 3_000 * (name == "t")]) for name in log}
    noise = noise_of(task := get_task("unit_circle"), f"log {write_theta(tmp_path, late)}", 0.0)
    at_rest = from_callable(lambda observation: np.zeros((len(observation), 1)), task)
    runs = closed_loop(
        task, PolicyController(at_rest), np.ones((50, 1)), noise,
        settings=LoopSettings(20, record=True, quiet=True),
    )  # fmt: skip
    assert (np.ptp(runs.noise[:20, :, 0], axis=0) > 0.03).all()


def test_angles_turn_in_a_log_as_in_the_chart(tmp_path):
    degrees = copy(get_task("unit_circle"))
    degrees.chart = replace(degrees.chart, low=(0.0,), high=(360.0,))
    log = planted(0, 0.05, amplitude=100, uniform=5, bias=7)
    log["x"] = log["x"] % 360
    noise = noise_of(degrees, f"log {write_theta(tmp_path, log)}", 0.0)
    assert (noise.bound, noise.columns[0].bias) == pytest.approx((12, 7), rel=0.02)


def test_a_log_is_of_columns_that_are_those_of_the_chart(tmp_path, monkeypatch):
    path = write_theta(tmp_path, planted(0, 0.05, uniform=0.05))
    noise = noise_of(task := get_task("unit_circle"), f"log {path}", 0.0)
    monkeypatch.setattr(type(task), "z", lambda self, measured: measured[:, :1] + 1)
    with pytest.raises(BadInput, match="does not begin with its chart"):
        noise.against(task, None)


def test_what_a_log_tells_of_others_is_no_noise_of_a_robot(tmp_path):
    log, other = planted(0, 0.05, uniform=0.05), planted(1, 0.05, uniform=9.0)["x"]
    log |= {"battery": other, "battery_ref": log["x_ref"], "elbow": other}
    log |= {"shoulder": log["x"], "shoulder_ref": log["x_ref"]}
    path = write(tmp_path / "log.csv", log)
    noise = noise_of(get_task("arm"), f"log {path}", 0.0)
    assert noise.bound == pytest.approx(0.05, rel=0.1)
    assert noise.kind == f"log {path}", "another log of this name is another noise"
    exact = {"t": log["t"], "x": log["x_ref"], "x_ref": log["x_ref"]}
    assert "--noise" not in call("noise", write(tmp_path / "exact.csv", exact)).stdout


def write_theta(folder, log):
    """Writes a log of theta."""
    return write(folder / "log.csv", {k.replace("x", "theta"): v for k, v in log.items()})


@pytest.mark.parametrize("gaussian", [0.0, 0.03])
def test_samples_that_the_noise_told_cannot_show_are_told(gaussian, of):
    """Beside a quantum the tails of a sum of uniform and normal noise are taken for uniform noise."""
    kinds = {"uniform": 0.05, "delay": 2, "hold": (2, 0.2), "quantum": 0.01}
    found = of(planted(10, 0.05, seconds=200, gaussian=gaussian, **kinds))
    told = f"% of the samples of x are beyond what {found.text} can show"
    assert any(told in remark for remark in found.remarks) == bool(gaussian)


# ---- what strangers' logs hold


@pytest.mark.parametrize("turn", [360.0, 1.0, np.pi, 4096.0])
def test_angles_jump_by_a_turn_in_any_unit(turn, of):
    """Where only the measurement is one of a single turn, too."""
    log = planted(0, 0.05, amplitude=2.5, uniform=0.05, delay=2)
    scaled = {name: turn / (2 * np.pi) * log[name] for name in ("x", "x_ref")}
    wrapped = {name: np.mod(values, turn) for name, values in scaled.items()}
    for some in (wrapped, scaled | {"x": wrapped["x"]}):
        with pytest.raises(BadInput, match=r"if it is an angle.*give --turn x"):
            of(log | some)
    noise = of(log | wrapped, turn={"x": turn})
    assert noise.bound == pytest.approx(0.05 * turn / (2 * np.pi), rel=0.1)


def test_a_sensor_that_is_mounted_the_other_way_round_has_a_bias_of_half_a_turn(of):
    log = planted(0, 0.05, amplitude=2.5, uniform=0.1, bias=3.1)
    noise = of(log | {name: np.mod(log[name], 2 * np.pi) for name in ("x", "x_ref")}, turn=["x"])
    assert noise.bias == pytest.approx(3.1, rel=0.01)
    assert noise.bound == pytest.approx(0.1, rel=0.1)


def test_a_reference_with_long_gaps_makes_no_drift(of):
    log = planted(4, 0.05, uniform=0.05, bias=0.1)
    log["x_ref"][:2_000] = log["x_ref"][4_000:] = np.nan
    noise = of(log)
    assert noise.drift == 0
    assert noise.bias == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("every", [2, 5])
def test_a_reference_of_a_lower_rate_is_told(every, of):
    log = planted(0, 0.05, uniform=0.05)
    rows = np.arange(len(log["t"]))
    held = log | {"x_ref": log["x_ref"][rows // every * every]}
    assert "as one that is sampled less often" in str(of(held).remarks)
    new = of(log | {"x_ref": np.where(rows % every, np.nan, log["x_ref"])})
    assert new.bound == pytest.approx(0.05, rel=0.1)
    # A robot that moves in steps is none.
    steps = np.sign(np.sin(log["t"]))
    assert not of(log | {"x": log["x"] - log["x_ref"] + steps, "x_ref": steps}).remarks


def test_a_clock_beside_a_robot_at_rest_is_no_measurement(of):
    log = {"stamp": np.arange(2_000) * 0.05, "x": np.random.default_rng(0).uniform(-1, 1, 2_000)}
    with pytest.raises(BadInput, match=r"stamp rises in each row.*--columns x"):
        of(log, dt=0.05, at_rest=True)
    assert of({"x": log["x"]}, dt=0.05, at_rest=True).bound == pytest.approx(1, rel=0.1)


@pytest.mark.parametrize("longest", [20, 600])
def test_a_single_loss_of_many_samples_is_as_long_as_it_is(longest, of):
    """Also where the probability of as many in a row is no number."""
    log = planted(4, 0.05, uniform=0.05)
    log["x"][2_000 : 2_000 + longest] = log["x"][1_999]
    assert of(log).held == longest


def test_steps_of_a_quantum_may_lie_anywhere(of):
    log = planted(0, 0.05, quantum=0.05)
    log["x"] += 0.02
    assert of(log).text.startswith("bias 0.0")
    assert of(log).held == 0
    log = planted(0, 0.05, quantum=0.02, hold=(2, 0.3))
    log["x"] += 0.007
    assert of(log).held_rate == pytest.approx(0.3, rel=0.1)


def test_held_samples_are_not_guessed_where_steps_are_uneven(of):
    log = planted(0, 0.05, uniform=0.002)
    log["x"] = np.array([float(f"{x:.3g}") for x in log["x"]])
    noise = of(log)
    assert noise.held == 0
    assert "x is rounded in uneven steps" in str(noise.remarks)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [5, 40])
def test_a_delay_is_found_in_a_log_of_a_high_rate(delay, of):
    """Of which the next sample is hardly another."""
    noise = of(planted(0, 0.001, uniform=0.05, delay=delay, hold=(3, 0.2), seconds=60))
    assert noise.delay == pytest.approx(delay, abs=max(1, delay / 10))
    assert (noise.held, noise.drift) == (3, 0)


def test_a_file_with_other_signs_between_its_cells_says_so(tmp_path):
    path = write(tmp_path / "log.csv", planted(0, 0.05, uniform=0.05))
    path.write_text(path.read_text().replace(",", ";").replace(".", ","))
    with pytest.raises(BadInput, match="has ';' between its names: give commas between cells"):
        noise_from_log(path)


def test_empty_cells_are_lost_whatever_the_quantum_hides(of):
    noise = of(planted(0, 0.1, uniform=0.12, quantum=0.08, hold=(3, 0.2), lost=True))
    assert noise.held == 3
    assert noise.held_rate == pytest.approx(0.2, rel=0.1)
    resting = planted(0, 0.05, amplitude=0.0, uniform=0.05, hold=(2, 0.2), lost=True)
    assert of(resting).held == 2
