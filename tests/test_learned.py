"""Tests of runs whose stage 1 has not learned the task."""

import pytest

import hyrl_mj
from hyrl_mj.errors import HyrlError
from hyrl_mj.judging import Arrivals, failures
from hyrl_mj.pipeline import runs
from hyrl_mj.tasks import Outcome


@pytest.mark.slow
def test_a_run_stops_where_stage_1_has_not_learned_unless_told_to_go_on(tmp_path, monkeypatch):
    short = {"stage1.samples": 4_096}
    options = {"set": short, "out": tmp_path / "run", "say": lambda text: None}
    for _ in range(2):  # it is not trained twice
        with pytest.raises(
            HyrlError, match=r"has not learned vehicle: its policy arrives from \d+ of 1,000"
        ):
            hyrl_mj.run("vehicle", **options)
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

    ends, nearest = failures(vehicle, Still())
    assert ends == {Outcome.CRASHED: 1_000 - Arrivals.measure(vehicle, Still()).arrived}
    assert ends.total() > 500
    assert nearest > vehicle.close
