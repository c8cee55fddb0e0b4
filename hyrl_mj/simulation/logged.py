"""The errors of a log as noise: each run plays a window of them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.files.logs import names_of
from hyrl_mj.simulation.noise import Noise, Sample, Signal
from hyrl_mj.simulation.noise_of_logs import ColumnNoise, LogNoise, noise_from_log
from hyrl_mj.simulation.sensors import Sensor

if TYPE_CHECKING:
    from hyrl_mj.policies import Controller
    from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Logged:
    """Noise as a log has it: measurement minus reference, delays and held samples left out.

    Each run begins at a time of the log that is drawn for it, and goes on at its beginning where it ends. The
    columns of the log are those of the chart with the same names; the others have no noise.

    Attributes:
        log: what `noise_from_log` returns.
        kind: what runs under it are called.
    """

    log: LogNoise
    kind: str = "log"
    everywhere: ClassVar[bool] = False

    @property
    def bound(self) -> float:
        """The largest error of all columns, in the unit of the measurement."""
        return max(float(np.abs(c.errors).max(initial=0.0)) for c in self.log.columns)

    def against(self, task: Task, controller: Controller | None) -> Signal:
        """Returns the signal for one closed loop.

        Raises:
            BadInput: the log has no column of the chart.
        """
        columns = {c.name: c for c in self.log.columns if len(c.errors) > 1}
        found = [(i, columns[name]) for i, name in enumerate(task.chart.names) if name in columns]
        if not found:
            raise BadInput(
                f"the log has errors of {', '.join(columns)}, and the chart of {task.name} is "
                f"({', '.join(task.chart.names)}): rename the columns of the log"
            )
        signal = _Windows(task, found, self.bound)
        task.with_noise(tuple(signal.shares.tolist())).check_noise(signal.bound)
        return signal


class _Windows(Signal):
    """Windows of the errors of some columns of the measurement, each given with its number."""

    kind = "log"
    unseeing = True

    def __init__(self, task: Task, columns: list[tuple[int, ColumnNoise]], bound: float):
        shares = np.zeros(len(task.noisy))
        for i, column in columns:
            shares[i] = np.abs(column.errors).max() / (bound or 1.0)
        super().__init__(bound, shares)
        self._columns, self._dt = columns, task.dt
        self._first = max(column.times[0] for _, column in columns)
        self._time = min(column.times[-1] for _, column in columns) - self._first
        if self._time <= 0:
            raise BadInput("the columns of the log have no time in common: give them the same rows")

    def against(self, task: Task, controller: Controller | None) -> Self:
        return copy(self)

    def reset(self, n: int, rng: np.random.Generator) -> None:
        super().reset(n, rng)
        self._window = np.zeros(n)

    def sample(self, now: Sample) -> np.ndarray:
        fresh = now.rows[now.k == 0]
        if len(fresh):
            self._window[fresh] = self.rng.uniform(0.0, self._time, len(fresh))
        t = self._first + (self._window[now.rows] + now.k * self._dt) % self._time
        noise = np.zeros_like(now.measurement)
        for i, column in self._columns:
            latest = np.searchsorted(column.times, t, side="right") - 1
            noise[:, i] = column.errors[latest]
        return noise


# What a text can name.
NamedNoise = Noise | Sensor | Logged


def noise_of(task: Task, text: str, bound: float, everywhere: bool = False) -> NamedNoise:
    """Returns the noise that a text names: a kind, a sum of parts, or "log FILE" with the errors of a log.

    Args:
        task: whose periodic coordinates are angles in a log.
        text: the text.
        bound, everywhere: of a kind of noise; the others tell their own bounds.

    Raises:
        BadInput: it names none, or its file cannot be used.
    """
    word, _, rest = text.strip().partition(" ")
    if word == Logged.kind and rest:
        path = Path(rest.strip())
        angles = [
            n for n, turns in zip(task.chart.names, task.chart.periodic, strict=True) if turns
        ]
        log = noise_from_log(path, turn=[name for name in names_of(path) if name in angles])
        noise: NamedNoise = Logged(log, f"{word} {path.name}")
    else:
        noise = Sensor.parse(text) if rest else Noise(text, bound, everywhere)
    if rest and everywhere:
        raise BadInput(f"the noise {text!r} tells where it acts: leave all coordinates out")
    return noise
