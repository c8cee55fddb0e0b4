"""The benchmark compares what it says: rates, times and ratios. How fast anything is, no test asserts."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "scripts"))

from benchmark import table
from benchmarks import Figure


@pytest.fixture
def clock(monkeypatch):
    """A clock that only the work moves."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


def takes(clock, seconds, units):
    def work() -> int:
        clock[0] += seconds
        return units

    return work


def test_a_ratio_is_that_of_the_rates(clock):
    ours, other = takes(clock, 0.5, 10), takes(clock, 2.0, 10)
    found = Figure("walk", "steps/s", "crawl", ">= 3", ours, other).measure(3)
    assert tuple(found[name] for name in ("ours", "other", "ratios")) == (
        20.0,
        5.0,
        [4.0, 4.0, 4.0],
    )


def test_a_time_is_that_of_one_unit(clock):
    ours, other = takes(clock, 0.002, 1), takes(clock, 0.004, 1)
    found = Figure("blink", "ms", "nod", "<= 5 ms", ours, other).measure(1)
    assert found["ours"] == pytest.approx(2.0)
    assert found["ratios"] == [pytest.approx(2.0)]


def test_the_table_shows_what_was_measured(clock):
    ours = takes(clock, 30.0, 1)
    alone = Figure("sleep", "s", "", "<= 60 s", ours, memory=lambda: 512.0).measure(1)
    drawn = table([alone])
    cells = [next(iter(column.cells)) for column in drawn.columns]
    assert cells == ["sleep", "30 s, 512 MB", "", "", "<= 60 s"]
