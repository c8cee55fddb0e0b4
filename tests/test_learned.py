"""Tests of what a run tells before it rests on a policy, or on a task, that does not do what it should."""

import re

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj.errors import HyrlError
from hyrl_mj.judging import Arrivals, failures
from hyrl_mj.pipeline import runs
from hyrl_mj.tasks import Outcome, hidden_goal, overlooked
from hyrl_mj.tasks.scaffold import write_task
from hyrl_mj.viz import figures


@pytest.mark.slow
def test_a_run_stops_where_stage_1_has_not_learned_unless_told_to_go_on(tmp_path, monkeypatch):
    short = {"stage1.samples": 4_096}
    options = {"set": short, "out": tmp_path / "run", "say": lambda text: None}
    shown = tmp_path / "run" / "figures" / "arrivals.png"
    for _ in range(2):  # it is not trained twice
        with pytest.raises(
            HyrlError, match=r"has not learned vehicle: its policy arrives from \d+ of 1,000"
        ):
            hyrl_mj.run("vehicle", **options)
        assert shown.exists()
    monkeypatch.setattr(runs, "_check_learned", None)  # which is not asked
    after = []

    def stage(run, name, say):
        after.append(name)
        return run

    monkeypatch.setattr(runs, "run_stage", stage)
    hyrl_mj.run("vehicle", go_on=True, **options)
    assert after[0] == "critical-set"


def test_how_episodes_fail_is_counted(vehicle):
    class Still:
        task = vehicle

        def act(self, measured):
            return measured[:, :1] * 0

    starts, ends, nearest = failures(vehicle, Still())
    crashed = ends == Outcome.CRASHED
    assert crashed.sum() == 1_000 - Arrivals.measure(vehicle, Still()).arrived > 500
    away = np.abs(starts[:, 1])
    assert away[crashed].max() < away[~crashed].min() + 0.01
    assert away[~crashed].min() == pytest.approx(0.75, abs=0.01)
    legend = figures.draw_arrivals(vehicle, starts, ends).axes[0].get_legend_handles_labels()[1]
    assert legend[-2:] == ["reached (248)", "crashed (752)"]
    assert nearest > vehicle.close


SECOND = '<geom name="obstacle_2" type="cylinder" pos="0.6 0.9 0.1" size="0.2 0.1"/>'


@pytest.mark.parametrize("forgotten", [False, True])
def test_a_second_obstacle_of_the_template_is_a_crash_and_a_forgotten_one_is_told(
    forgotten, tmp_path
):
    name = "a_forgotten_post" if forgotten else "two_posts"
    write_task(name, tmp_path)
    model, path = tmp_path / f"{name}.xml", tmp_path / f"{name}.py"
    model.write_text(model.read_text().replace("<worldbody>", f"<worldbody>{SECOND}", 1))
    if forgotten:
        text = path.read_text().replace("in mjcf.obstacles(self.model)", 'in ["obstacle"]')
        path.write_text(text.replace("(measured[:, 3] > 0) | ", ""))
    task = hyrl_mj.get_task(path)
    ends = task.ending(task.placed(np.array([[0.6, 0.9]])).measurement)
    assert (ends == Outcome.RUNNING) == forgotten
    said = overlooked(task)
    assert ("whose puck is " in said and " inside of obstacle_2, as at x " in said) == forgotten
    assert bool(said) == forgotten


def test_no_task_of_the_package_overlooks_an_obstacle():
    tasks = [hyrl_mj.get_task(name) for name in hyrl_mj.task_names()]
    assert not [task for task in tasks if task.source is None and overlooked(task)]


def test_a_set_point_that_noise_hides_is_told_with_what_would_do(circle):
    """It moves by 0.05 rad in a sample: beside the set-point it may be by 0.1 rad of noise and that."""

    class Strict(type(circle)):
        close = 0.12

    class Looking(Strict):  # where its goal is tells its miss alone
        set_point = None
        miss = staticmethod(circle.miss)

    for strict in (Strict(), Looking()):
        said = hidden_goal(strict, 0.1)
        assert re.search(r"hides up to 0\.1\d* of that, and 0\.15\d* with", said), said
        told = re.search(r"a close of at least (0\.1[56]), or noise of at most (0\.0\d+)$", said)
        assert told, said
        assert not hidden_goal(strict, float(told[2]))
        strict.close = float(told[1])
        assert not hidden_goal(strict, 0.1), "what is told would do"
        strict.close = 0.12
        assert not hidden_goal(strict, 0.05)
    assert not hidden_goal(circle, 0.1)
