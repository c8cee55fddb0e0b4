"""What `scripts/benchmark.py` measures, a file for each group of figures, and how it is timed."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Figure:
    """What is compared: each function does some work and returns how many units it was.

    Attributes:
        name: of the figure.
        unit: what is counted, as "frames/s"; or a time that one unit of work takes: "s", "ms", "us".
        against: what the other way is.
        target: for people.
        ours, other: the work.
        memory: tells how much ours has taken at most [MB].
        least: seconds that one half of a pair takes at least.
        slow: whether `--quick` leaves it out.
    """

    name: str
    unit: str
    against: str
    target: str
    ours: Callable[[], int]
    other: Callable[[], int] | None = None
    memory: Callable[[], float] | None = None
    least: float = 0.5
    slow: bool = False

    def measure(self, pairs: int) -> dict[str, Any]:
        """Time both, alternately.

        Returns name, against, target and unit, with `ours` and `other`: medians in this unit, of which
        `other` is None where nothing is compared; `ratios`: how many times faster ours is, of each pair; and
        `memory`: the most that ours took [MB], where that is asked for.
        """
        both = [work for work in (self.ours, self.other) if work]
        rates = np.array([[_rate(work, self.least) for work in both] for _ in range(pairs)])
        ours, *other = [self._shown(float(rate)) for rate in np.median(rates, axis=0)]
        texts = {"name": self.name, "against": self.against, "target": self.target}
        return texts | {
            "unit": self.unit,
            "ours": ours,
            "other": other[0] if other else None,
            "ratios": (rates[:, 0] / rates[:, 1]).tolist() if other else [],
            "memory": self.memory() if self.memory else None,
        }

    def _shown(self, rate: float) -> float:
        times = {"s": 1.0, "ms": 1e3, "us": 1e6}
        return times[self.unit] / rate if self.unit in times else rate


def _rate(work: Callable[[], int], least: float) -> float:
    """Units a second."""
    began, units = time.perf_counter(), 0
    while True:
        units += work()
        took = time.perf_counter() - began
        if took >= least:
            return units / took
