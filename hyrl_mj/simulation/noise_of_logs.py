"""Which noise sensors have, from a log of what they measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path

import numpy as np

from hyrl_mj.errors import BadInput, counted, unknown
from hyrl_mj.files.logs import names_of, read_log
from hyrl_mj.simulation.column_noise import LEAST, LONGEST_DELAY, ColumnNoise, column_noise

TIMES = ("t", "time")
MOST = 20_000_000  # samples with gaps between them, which take 160 MB a column and step


@dataclass(frozen=True)
class LogNoise:
    """The noise of a log.

    Attributes:
        columns: the noise of each column.
        remarks: sentences about the whole log.
    """

    columns: tuple[ColumnNoise, ...]
    remarks: tuple[str, ...]

    @property
    def worst(self) -> ColumnNoise:
        """The worst of each quantity of all columns."""

        def most(name: str) -> float:
            values = np.abs([getattr(column, name) for column in self.columns])
            return float(np.nanmax(values)) if np.isfinite(values).any() else nan

        return replace(
            max(self.columns, key=lambda column: (column.uniform, len(column.errors))),
            name="all",
            delay=most("delay"),
            held=int(most("held")),
            held_rate=most("held_rate"),
            quantum=most("quantum"),
            bias=most("bias"),
            told_bias=most("told_bias"),
            drift=most("drift"),
            drift_rate=most("drift_rate"),
            bound=most("bound"),
            sigma=most("sigma"),
        )

    @property
    def text(self) -> str:
        """The noise of all columns to give to a run."""
        return self.worst.text


def noise_from_log(
    path: str | Path,
    *,
    columns: Sequence[str] | None = None,
    dt: float | None = None,
    at_rest: bool = False,
    scale: Mapping[str, float] | None = None,
    turn: Sequence[str] = (),
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
        turn: columns of angles [rad], whose difference by a whole turn is none.
        share: the share of the samples that keeps the bound.

    Raises:
        BadInput: the file or an argument cannot be used, or the log tells nothing.
    """
    factors = dict(scale or {})
    for name, factor in factors.items():
        if isinstance(factor, bool) or not isinstance(factor, int | float | np.number):
            raise BadInput(f"{name} cannot be multiplied by {factor!r:.40}: give a factor as 0.001")
    if bad := [name for name, factor in factors.items() if not 0 < abs(factor) < np.inf]:
        raise BadInput(
            f"{bad[0]} cannot be multiplied by {factors[bad[0]]:g}: give a factor as 0.001"
        )
    if dt is not None and not 0 < dt < np.inf:
        raise BadInput(f"a time of {dt:g} s between rows cannot be used: give one > 0")
    if not 0.5 <= share <= 1:
        raise BadInput(f"a share of {share:g} cannot be used: give one from 0.5 to 1, as 0.999")
    header = names_of(path)
    chosen = _chosen(path, header, columns, at_rest)
    clock = [name for name in header if name in TIMES][:1]
    references = [] if at_rest else [f"{name}_ref" for name in chosen]
    for name in (*turn, *factors):
        if name not in (*chosen, *references):
            raise unknown(f"column of {path}", name, [*chosen, *references])
    data = read_log(path, [*clock, *chosen, *references])
    rows = len(data[chosen[0]])
    if rows < LEAST:
        raise BadInput(f"{path} has {counted(rows, 'row')} of samples: give at least {LEAST}")
    times, place, step, remarks = _clock(path, data[clock[0]] if clock else None, rows, dt)
    if place[-1] > MOST:
        raise BadInput(
            f"{path} has so many gaps in time that it takes {place[-1]:,} samples: give at most {MOST:,}"
        )
    if step > 5:  # [s]: no robot is controlled so slowly
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

    found = []
    for name in chosen:
        y = data[name] * factors.get(name, 1.0)
        reference = f"{name}_ref"
        r = None if at_rest else placed(data[reference] * factors.get(reference, 1.0))
        found.append(column_noise(name, placed(y), r, placed(times), step, name in turn, share))
    if any(column.held or column.delay >= 1 for column in found):
        remarks.append(
            f"delay and held samples are counted in samples of this log, of {step:.3g} s: for a robot with "
            "another sample time, give the samples of the robot that take as long, rounded up"
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
        line = int(np.argmin(steps > 0)) + 3  # the names are line 1
        raise BadInput(f"{path}, line {line}: the time does not increase, so sort the rows by it")
    step, remarks = float(np.median(steps)), []
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
