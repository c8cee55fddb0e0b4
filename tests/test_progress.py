"""Tests of what is shown while work goes on."""

import pytest

from hyrl_mj.system import progress


@pytest.fixture
def lines(monkeypatch):
    """Standard error is no terminal, and each step of the work is worth a line."""
    monkeypatch.setattr(progress, "shown", "lines")
    monkeypatch.setattr(progress, "EVERY", 0.0)


def test_where_no_bar_can_be_drawn_lines_tell_how_far_work_is(lines, capsys):
    assert [*progress.progress_bar(range(3), "stage 1", "samples")] == [0, 1, 2]
    said = capsys.readouterr().err.splitlines()
    assert said
    assert all(line.startswith("stage 1: ") and " of 3.00 samples in " in line for line in said)


def test_quiet_work_and_a_library_say_nothing(lines, capsys, monkeypatch):
    assert [*progress.progress_bar(range(3), "stage 1", "samples", quiet=True)] == [0, 1, 2]
    monkeypatch.setattr(progress, "shown", "")
    assert [*progress.progress_bar(range(3), "stage 1", "samples")] == [0, 1, 2]
    assert capsys.readouterr().err == ""
