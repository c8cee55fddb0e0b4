"""The table of the paper's values: ours are computed from the artifacts, whatever these are."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from figure_parts import arcs_of, planted_run
from planted import without_pictures

import hyrl_mj
from hyrl_mj.learning.presets import preset
from hyrl_mj.runs.directory import Run, write_config

SCRIPT = Path(__file__).parents[1] / "scripts" / "reproduce_paper.py"
spec = importlib.util.spec_from_file_location("reproduce_paper", SCRIPT)
script = importlib.util.module_from_spec(spec)
spec.loader.exec_module(script)


def table_of(lines):
    """Ours and the note, by quantity."""
    return {quantity: (ours, note) for quantity, _, ours, note in lines}


def test_the_circles_values():
    found = table_of(script.circle_lines(planted_run(hyrl_mj.get_task("unit_circle"))))
    assert found["M*"] == ("1.0000π", "")
    width, unit = found["overlap at the replay starts"][0].split()
    assert (float(width), unit) == (pytest.approx(0.4, abs=0.03), "rad")
    assert found["overlap at the replay starts"][1] == script.SIZED, "less than the paper's 0.2 pi"
    assert found["PPO from 0.80π"][0] == "arrives, clockwise"
    assert found["PPO from 1.00π"][0] == "stalls"
    assert found["HyRL from 0.90π, q0 = 1"] == ("arrives, counter-clockwise", "")
    assert found["HyRL from 1.25π, q0 = 0"][0] == "arrives, counter-clockwise"


def test_the_vehicles_values():
    found = table_of(script.vehicle_lines(planted_run(hyrl_mj.get_task("vehicle"))))
    assert found["M*"][0] == "x 0.00 to 0.40, |y| <= 0.0000"
    width, unit = found["overlap where it is narrowest"][0].split()
    assert (float(width), unit) == (pytest.approx(0.4, abs=0.02), "m")
    assert found["DQN from (0, 0)"][0] == "crashes"
    assert found["arena"][0] == "[0, 3] x [-1.5, 1.5]"
    assert sum(q.startswith("HyRL") for q in found) == 10


def test_a_controller_that_fails_is_said_to_fail():
    vehicle = hyrl_mj.get_task("vehicle")
    arcs = arcs_of(vehicle)
    alone = {(start, who): arcs[start, "policy"] for start, who in arcs}
    found = table_of(script.vehicle_lines(planted_run(vehicle, alone)))
    fates = [ours for quantity, (ours, _) in found.items() if quantity.startswith("HyRL")]
    assert (
        fates.count("crashes")
        == 2 * sum(arcs[f"start{i}", "policy"].outcome == "crashed" for i in range(5))
        > 0
    )


@pytest.mark.slow
def test_sets_by_the_papers_horizon_need_no_note():
    circle = hyrl_mj.get_task("unit_circle")
    found = table_of(script.circle_lines(planted_run(circle, horizon=0.5)))
    assert not any(script.SIZED in note for _, note in found.values())


def test_a_run_of_another_task_is_refused(tmp_path):
    write_config(Run(tmp_path, preset(hyrl_mj.get_task("vehicle"))))
    with pytest.raises(hyrl_mj.BadInput, match="is a run of vehicle: give one of unit_circle"):
        script.opened(tmp_path, "unit_circle")


@pytest.mark.slow
def test_the_papers_seven_figures_are_written(tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    circle, vehicle = (planted_run(hyrl_mj.get_task(t)) for t in ("unit_circle", "vehicle"))
    script.draw(circle, vehicle, tmp_path)
    names = {path.stem.partition("_")[0] for path in tmp_path.iterdir()}
    assert names == {f"fig{i}" for i in range(1, 7)}
    assert len([*tmp_path.glob("*.png")]) == 7
    assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".pdf"}
    assert np.all([path.with_suffix(".pdf").is_file() for path in tmp_path.glob("*.png")])
