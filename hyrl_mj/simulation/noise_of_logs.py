"""Which noise sensors have, from a log of what they measured, and its errors as noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from hyrl_mj.errors import LARGEST_NUMBER, BadInput, counted, unknown
from hyrl_mj.files.logs import Log
from hyrl_mj.simulation.column_noise import LEAST, LONGEST_DELAY, ColumnNoise, column_noise
from hyrl_mj.simulation.noise import LOG, Noise, Sample, Signal
from hyrl_mj.simulation.sensors import Sensor, begins_with_chart

if TYPE_CHECKING:
    from hyrl_mj.policies import Controller
    from hyrl_mj.tasks import Task

TIMES = ("t", "time")


@dataclass(frozen=True)
class LogNoise:
    """The noise of a log; as noise its errors, measurement minus reference, without delays and held samples.

    Each run begins at a time of the log that is drawn for it, and goes on at its beginning where it ends.
    What a log does not tell, because of gaps in time or lost samples, is left out. The columns of the log are
    those of the chart with the same names; the others have no noise.

    Attributes:
        columns: the noise of each column.
        remarks: sentences about the whole log.
        kind: what runs under it are called.
    """

    columns: tuple[ColumnNoise, ...]
    remarks: tuple[str, ...]
    kind: str = LOG
    everywhere: ClassVar[bool] = False

    @property
    def worst(self) -> ColumnNoise:
        """The worst of each quantity of all columns."""

        def most(name: str) -> float:
            values = np.abs([getattr(column, name) for column in self.columns])
            return float(np.nanmax(values)) if np.isfinite(values).any() else nan

        names = (
            "delay", "held", "held_rate", "quantum", "bias", "told_bias", "drift", "drift_rate", "bound",
            "sigma",
        )  # fmt: skip
        worst: dict[str, Any] = {name: most(name) for name in names}
        worst["held"] = int(worst["held"])
        usual = max(self.columns, key=lambda column: (column.uniform, len(column.errors)))
        return replace(usual, name="all", **worst)

    @property
    def text(self) -> str:
        """The noise of all columns to give to a run."""
        return self.worst.text

    @property
    def bound(self) -> float:
        """The largest error of all columns, in the unit of the measurement."""
        return max(float(np.abs(c.errors).max(initial=0.0)) for c in self.columns)

    def against(self, task: Task, controller: Controller | None) -> Signal:
        """Returns the signal for one closed loop.

        Raises:
            BadInput: the log has no column of the chart, or the measurement does not begin with the chart.
        """
        columns = {c.name: c for c in self.columns if len(c.errors) > 1}
        found = [(i, columns[name]) for i, name in enumerate(task.chart.names) if name in columns]
        if not found:
            raise BadInput(
                f"the log has errors of {', '.join(columns)}, and the chart of {task.name} is "
                f"({', '.join(task.chart.names)}): rename the columns of the log"
            )
        if not begins_with_chart(task):
            raise BadInput(
                f"the errors of a log are those of chart coordinates, and the measurement of {task.name} "
                f"does not begin with its chart ({', '.join(task.chart.names)}): give another noise"
            )
        signal = _Windows(task, found, self.bound)
        task.with_noise(tuple(signal.shares.tolist())).check_noise(signal.bound)
        return signal


class _Windows(Signal):
    """Windows of the errors of some columns of the measurement, each given with its number."""

    kind = LOG
    unseeing = True

    def __init__(self, task: Task, columns: list[tuple[int, ColumnNoise]], bound: float):
        shares = np.zeros(len(task.noisy))
        for i, column in columns:
            shares[i] = np.abs(column.errors).max() / (bound or 1.0)
        super().__init__(bound, shares)
        self._dt = task.dt
        every = [column for _, column in columns]
        times = reduce(np.intersect1d, [column.times for column in every])
        if len(times) < 2:
            raise BadInput("the columns of the log have no time in common: give them the same rows")
        self._errors = np.zeros((len(times), len(shares)))
        for i, column in columns:
            self._errors[:, i] = column.errors[np.searchsorted(column.times, times)]
        # What lasts longer than the rows are apart is a gap.
        steps = np.diff(times)
        steps = np.minimum(steps, 2 * np.quantile(steps, 0.95))
        self._times = np.concatenate([[0.0], np.cumsum(steps)])
        if (step := float(np.median(steps))) > 10 * task.dt:  # so many samples a row may last
            raise BadInput(
                f"the rows of the log are {step:g} s apart and the samples of {task.name} {task.dt:g} s, so "
                "that each error would stay for long: give the times in seconds, or a log with more rows"
            )

    def reset(self, n: int, rng: np.random.Generator) -> None:
        super().reset(n, rng)
        self._window = np.zeros(n)

    def sample(self, now: Sample) -> np.ndarray:
        fresh, whole = now.rows[now.k == 0], self._times[-1]
        if len(fresh):
            self._window[fresh] = self.rng.uniform(0.0, whole, len(fresh))
        t = (self._window[now.rows] + now.k * self._dt) % whole
        return self._errors[np.searchsorted(self._times, t, side="right") - 1]


def noise_from_log(
    path: str | Path | Log,
    *,
    columns: Sequence[str] | None = None,
    dt: float | None = None,
    at_rest: bool = False,
    scale: Mapping[str, float] | None = None,
    turn: Sequence[str] | Mapping[str, float] = (),
    share: float = 0.999,
) -> LogNoise:
    """Returns the noise that the measurements of a log have.

    Args:
        path: a CSV file with a line of names: `t` or `time` [s], measured columns, and for each NAME what is
            true as NAME_ref.
        columns: the measured columns; by default all that have a reference, and at rest all.
        dt: the time between two rows [s], of a log without times.
        at_rest: whether the robot stood still, so that no reference is needed.
        scale: factors by which columns are multiplied.
        turn: columns of angles [rad], whose difference by a whole turn is none; or, by their names, what a
            whole turn is in their units.
        share: the share of the samples that keeps the bound.

    Raises:
        BadInput: the file or an argument cannot be used, or the log tells nothing.
    """
    factors = dict(scale or {})
    for name, factor in factors.items():
        number = isinstance(factor, int | float | np.number) and not isinstance(factor, bool)
        if not number or not 0 < abs(factor) <= LARGEST_NUMBER:
            raise BadInput(f"{name} cannot be multiplied by {factor!r:.40}: give a factor as 0.001")
    if dt is not None:
        _check_step(dt)
    if not 0.5 <= share <= 1:
        raise BadInput(f"a share of {share:g} cannot be used: give one from 0.5 to 1, as 0.999")
    log = path if isinstance(path, Log) else Log(path)
    path = log.path
    chosen = _chosen(path, log.names, columns, at_rest)
    clock = [name for name in log.names if name in TIMES][:1]
    looked_at = [*chosen, *([] if at_rest else [f"{name}_ref" for name in chosen])]
    turns = turn if isinstance(turn, Mapping) else dict.fromkeys(turn, 2 * np.pi)
    for name in (*turns, *factors):
        if name not in looked_at:
            raise unknown(f"column of {path}", name, looked_at)
    data = log.read([*clock, *looked_at])
    rows = len(data[chosen[0]])
    if rows < LEAST:
        raise BadInput(f"{path} has {counted(rows, 'row')} of samples: give at least {LEAST}")
    for name in chosen if at_rest else ():
        tiny = 1e-9 * np.abs(data[name]).max()  # as in column_noise
        if (np.diff(data[name]) > tiny).all():
            raise BadInput(
                f"{name} rises in each row of {path}, as a clock or a counter does, and nothing of a robot "
                "at rest: choose the columns that are measured, as --columns x"
            )
    times, place, step, remarks = _clock(path, data[clock[0]] if clock else None, rows, dt)
    most = 1_200_000  # samples with gaps between them, of which a column takes 150 bytes each
    if place[-1] > most:
        raise BadInput(
            f"{path} has so many gaps in time that it takes {place[-1]:,} samples: give at most {most:,}"
        )
    if step >= 0.5:  # few robots are controlled so slowly [s]
        remarks.append(f"its rows are {step:g} s apart: are the times in seconds?")
    if rows * (1 - share) < 1 and share < 1:
        remarks.append(
            f"a bound that {share:g} of the samples keep needs {1 / (1 - share):,.0f} rows, and the log has "
            f"{rows:,}: the bounds may be exceeded"
        )

    def placed(values: np.ndarray) -> np.ndarray:
        whole = np.full(place[-1] + 1, nan)
        whole[place] = values
        return whole

    for name, factor in factors.items():
        data[name] *= factor
    t, found = placed(times), []
    for name in chosen:
        r = None if at_rest else placed(data[f"{name}_ref"])
        found.append(
            column_noise(name, placed(data[name]), r, t, step, turns.get(name, 0.0), share)
        )
    if any(column.held or column.delay >= 1 for column in found):
        remarks.append(
            f"delay and held samples are counted in samples of this log, of {step:.3g} s: for a robot with "
            "another sample time, give the samples of the robot that take as long, rounded up"
        )
    if len({column.text for column in found}) > 1:
        remarks.append(
            "the noise to give to a run is the worst of all columns, whatever their units; a task gives each "
            "of its columns the share in its `noisy` of that, so a share below 1 needs so much larger bounds"
        )
    if not any(len(column.errors) for column in found):
        raise BadInput(f"{path} tells no noise: {found[0].remarks[0]}")
    return LogNoise(tuple(found), tuple(remarks))


def _chosen(
    path: str | Path, header: Sequence[str], columns: Sequence[str] | None, at_rest: bool
) -> list[str]:
    """Returns the measured columns that are looked at."""
    measured = [name for name in header if name not in TIMES and not name.endswith("_ref")]
    for name in columns or ():
        if name not in measured:
            raise unknown(f"measured column of {path}", name, measured)
    usual = [name for name in measured if at_rest or f"{name}_ref" in header]
    chosen = list(dict.fromkeys(columns or usual))
    most = 200  # each takes some 20 ms
    if len(chosen) > most:
        raise BadInput(f"{path} has {len(chosen):,} measured columns: choose at most {most}")
    lacks = [name for name in chosen or measured if f"{name}_ref" not in header]
    if not measured or (lacks and not at_rest):
        name = lacks[0] if lacks else "x"
        raise BadInput(
            f"{path} has no column {name}_ref: give what is true in it, or --at-rest if the robot stood still"
            if measured
            else f"{path} has no measured column: give one beside the time"
        )
    return chosen


def _clock(
    path: str | Path, t: np.ndarray | None, rows: int, dt: float | None
) -> tuple[np.ndarray, np.ndarray, float, list[str]]:
    """Returns the times [s] and the sample numbers of the rows, the time of a sample [s], and remarks."""
    if t is None and dt is None:
        raise BadInput(f"{path} has no column t or time: give the time between rows, as --dt 0.05")
    if t is not None and dt is not None:
        raise BadInput(f"{path} has its own times: leave --dt out")
    if t is None:
        assert dt is not None
        return np.arange(rows) * dt, np.arange(rows), dt, []
    steps = np.diff(t)
    if not (steps > 0).all():
        i = int(np.argmin(steps > 0))  # the names are line 1
        raise BadInput(
            f"{path}, line {i + 3}: the time does not increase, from {t[i]:.10g} to {t[i + 1]:.10g}: sort "
            "the rows by it, leave out what has the same, and of a clock that was set back give the rows "
            "before or after that"
        )
    step, remarks = _check_step(float(np.median(steps))), []
    samples = np.rint(steps / step)
    if gaps := int((samples > 1).sum()):
        remarks.append(
            f"the log has {counted(gaps, 'gap')} in time of up to {steps.max():.3g} s: what was lost there "
            "is not counted"
        )
    if np.quantile(np.abs(steps - samples * step), 0.95) > 0.1 * step:
        remarks.append(
            f"its rows are {np.quantile(steps, 0.05):.3g} s to {np.quantile(steps, 0.95):.3g} s apart: a "
            f"sample is taken as {step:.3g} s"
        )
    # A gap only has to be longer than any delay.
    apart = np.clip(samples, 1, LONGEST_DELAY + 1).astype(int)
    return t, np.concatenate([[0], np.cumsum(apart)]), step, remarks


def _check_step(dt: float) -> float:
    """Returns the time between two rows [s], or raises `BadInput` if no log has it."""
    if not 1e-9 <= dt <= 1e9:
        raise BadInput(
            f"a time of {dt:g} s between rows cannot be used: give one > 0, of 1e-9 to 1e9 s"
        )
    return dt


# What a text can name.
NamedNoise = Noise | Sensor | LogNoise


def noise_of(task: Task, text: str, bound: float, everywhere: bool = False) -> NamedNoise:
    """Returns the noise that a text names: a kind, a sum of parts, or "log FILE" with the errors of a log.

    Args:
        task: whose periodic coordinates turn in a log as they do in its chart.
        text: the text.
        bound, everywhere: of a kind of noise; the others tell their own bounds.

    Raises:
        BadInput: it names none, or its file cannot be used.
    """
    word, _, rest = text.strip().partition(" ")
    noise: NamedNoise
    if word == LOG and rest:
        log, chart = Log(path := rest.strip()), task.chart
        # What the log tells of others is no noise of this robot.
        own = [name for name in chart.names if {name, f"{name}_ref"} <= {*log.names}]
        sides = zip(chart.names, chart.sides.tolist(), chart.periodic, strict=True)
        turns = {name: side for name, side, turns in sides if turns and name in own}
        noise = replace(noise_from_log(log, columns=own, turn=turns), kind=f"{word} {path}")
    else:
        noise = Sensor.parse(text) if rest else Noise(text, bound, everywhere)
    if rest and everywhere:
        raise BadInput(f"the noise {text!r} tells where it acts: leave all coordinates out")
    return noise
