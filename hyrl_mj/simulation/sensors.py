"""Sensors: noise that is a sum of parts, some of which remember.

A sensor measures with a bias, a drift and noise, rounds to a quantum, and sends what arrives late or not at
all. `Sensor.parse` reads such a sum from a text; `Sensor.reach` bounds what all of it together can hide, so
that what holds for every noise within that bound holds for the sensor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from hyrl_mj.errors import LARGEST_NUMBER, BadInput, check_bound, unknown
from hyrl_mj.simulation.checked_noise import begin_signal, drawn
from hyrl_mj.simulation.noise import (
    DELAY,
    HOLD,
    KINDS,
    LOG,
    QUANTUM,
    SENSOR,
    Sample,
    Signal,
    made,
    noise_class,
    noise_kinds,
    register_noise,
)
from hyrl_mj.tasks import Outcome

if TYPE_CHECKING:
    from hyrl_mj.policies import Controller
    from hyrl_mj.tasks import Task

# Bounds are rounded up to parts of so many, but for the rounding of sums of floats, which is far below that.
DECIMALS, ROUNDING = 1e9, 1e-3


@register_noise
class Gaussian(Signal):
    """Normal noise drawn anew at every sample, truncated at its bound.

    Attributes:
        sigma: standard deviation before it is truncated, by default a third of the bound.
    """

    kind = "gaussian"
    unseeing = True
    sigma: float | None = None

    def sample(self, now: Sample) -> np.ndarray:
        from scipy.special import ndtr, ndtri  # slow to import

        sigma = self.bound / 3 if self.sigma is None else self.sigma
        sigma = min(sigma, 1e3 * self.bound)  # from there on it is uniform, to seven digits
        if not self.bound:
            return np.zeros_like(now.measurement)
        share = self.rng.uniform(
            ndtr(-self.bound / sigma), ndtr(self.bound / sigma), now.measurement.shape
        )
        return np.clip(sigma * ndtri(share), -self.bound, self.bound) * self.shares


@register_noise
class Bias(Signal):
    """An error that is drawn at the start of an episode, uniformly between its bounds, and stays."""

    kind = "bias"
    unseeing = True

    def reset(self, n: int, rng: np.random.Generator) -> None:
        super().reset(n, rng)
        self._bias = np.zeros((n, len(self.shares)))

    def sample(self, now: Sample) -> np.ndarray:
        begun = now.rows[now.k == 0]
        if len(begun):
            drawn = self.rng.uniform(-self.bound, self.bound, (len(begun), len(self.shares)))
            self._bias[begun] = drawn
        return self._bias[now.rows] * self.shares


@register_noise
class Drift(Signal):
    """An error that goes from one value between its bounds to the next, drawn uniformly, at its rate.

    Attributes:
        rate: how fast it changes, in the unit of the measurement each second; by default by the bound.
    """

    kind = "drift"
    unseeing = True
    rate: float | None = None
    _step: float

    def against(self, task: Task, controller: Controller | None) -> Self:
        signal = super().against(task, controller)
        signal._step = task.dt * (self.bound if self.rate is None else self.rate)
        return signal

    def reset(self, n: int, rng: np.random.Generator) -> None:
        super().reset(n, rng)
        self._drift, self._goal = (np.zeros((n, len(self.shares))) for _ in range(2))

    def sample(self, now: Sample) -> np.ndarray:
        rows, fresh = now.rows, (now.k == 0)[:, None]
        first, turn = self.rng.uniform(-self.bound, self.bound, (2, len(rows), len(self.shares)))
        at, goal = self._drift[rows], self._goal[rows]
        there = np.abs(goal - at) <= self._step
        at = np.where(fresh, first, np.where(there, goal, at + self._step * np.sign(goal - at)))
        goal = np.where(fresh | there, -np.sign(at) * np.abs(turn), goal)  # to the other side
        self._drift[rows], self._goal[rows] = at, goal
        return at * self.shares


@dataclass(frozen=True)
class Part:
    """One part of a sensor.

    Attributes:
        word: a kind of noise, or "delay", "hold" or "quantum".
        value: the bound of noise and the quantum, in the unit of the measurement; the longest delay, or the
            most samples that are held in a row.
        options: other numbers by their names: `sigma`, `rate`, or the shortest delay as `least`.

    Raises:
        BadInput: a number that cannot be.
    """

    word: str
    value: float
    options: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        value, options = self.value, self.options
        check_bound(value)
        if self.word in (DELAY, HOLD) and not (1 <= value <= 1_000 and value == int(value)):
            raise BadInput(f"{self}: give a whole number of samples from 1 to 1000")
        if options.get("least", value) > value:
            raise BadInput(f"{self}: give the shortest delay first")
        if self.word == HOLD and not 0 < options.get("rate", 1) <= 1:
            raise BadInput(f"{self}: the rate is the share of samples that are held, in (0, 1]")
        for name, x in options.items():
            if name in ("sigma", "rate") and not (math.isfinite(x) and x > 0):
                raise BadInput(f"{self}: give a {name} > 0")
        if any(
            x and not 1 / LARGEST_NUMBER <= x <= LARGEST_NUMBER for x in (value, *options.values())
        ):
            raise BadInput(
                f"{self}: give numbers from {1 / LARGEST_NUMBER:g} to {LARGEST_NUMBER:g}, or 0"
            )

    def __str__(self) -> str:
        value, options = f"{self.value:.12g}", dict(self.options)
        if self.word == DELAY and (least := options.pop("least", self.value)) < self.value:
            value = f"{least:.12g}-{value}"
        return " ".join([self.word, value, *(f"{name} {x:.12g}" for name, x in options.items())])

    @property
    def is_noise(self) -> bool:
        """Whether it is noise that is added to each sample."""
        return self.word not in (DELAY, HOLD, QUANTUM)

    @staticmethod
    def parse(text: str) -> Part:
        """Returns the part that a text names, as "drift 0.05 rate 0.01".

        Raises:
            BadInput: it names none, or a number that cannot be.
        """
        word, *rest = text.split() or [""]
        if word == LOG:
            raise BadInput(
                f"{text.strip()!r} is no part of a sensor: hyrl-mj noise LOG.csv tells which parts it has"
            )
        words = [
            kind
            for kind in noise_kinds()
            if kind not in ("none", SENSOR) and not noise_class(kind).needs_controller
        ]
        if word not in (words := [*words, DELAY, HOLD, QUANTUM]):
            if re.fullmatch(r"[\d.]+(e-?\d+)?", word):
                raise BadInput(
                    f"the noise {text.strip()!r} names no kind: give one before the bound, as in "
                    f"'uniform {word}', or the bound alone as eps {word}"
                )
            raise unknown("part of a sensor", word, words)
        allowed = ["rate"] if word == HOLD else []
        if word in noise_kinds():
            kind, none = noise_class(word), property()  # which no signal can be given
            allowed = [
                n for n in ("sigma", "rate") if not isinstance(getattr(kind, n, none), property)
            ]
        said = f"{text.strip()!r} is no part of a sensor"
        what = " ".join([word, "N", *(f"[{name} X]" for name in allowed)])
        names, values = rest[1::2], rest[2::2]
        if not rest or len(names) != len(values) or len({*names}) < len(names):
            raise BadInput(f"{said}: write {what}, as in 'uniform 0.05 + bias 0.05 + delay 1'")
        if wrong := [name for name in names if name not in allowed]:
            raise BadInput(f"{said}, because {word} has no {wrong[0]}: write {what}")
        first, options = rest[0], {}
        if word == DELAY and (between := re.fullmatch(r"(\d+)-(\d+)", first)):
            options["least"], first = float(between[1]), between[2]
        try:
            value = float(first)
            options |= {name: float(x) for name, x in zip(names, values, strict=True)}
        except ValueError as error:
            raise BadInput(f"{said} ({error}): write {what}") from None
        return Part(word, value, options)


def begins_with_chart(task: Task) -> bool:
    """Returns whether the measurement begins with the coordinates of the chart."""
    measured = task.placed(task.starts(16, np.random.default_rng(0))).measurement
    apart = task.chart.difference(task.z(measured), measured[:, : task.chart.dimension])
    return bool(np.abs(apart).max() <= 1e-6)


# A part that does nothing.
NOTHING = Part("uniform", 0.0)


@dataclass(frozen=True)
class Sensor:
    """Noise as a sensor makes it: the sum of its parts.

    Each sample is what is true, plus noise of each kind, rounded to the quantum. It arrives after the delay;
    one that is lost is replaced by the last that arrived. A robot was at rest before the start. Noise, bias
    and drift act on the noisy columns of the measurement by their shares, as for `Noise`; a late or held
    sample is late in all columns.

    Attributes:
        parts: the parts.
    """

    parts: tuple[Part, ...]
    everywhere: ClassVar[bool] = False

    @staticmethod
    def parse(text: str) -> Sensor:
        """Returns the sensor that a text describes, as "uniform 0.05 + bias 0.05 + delay 1".

        Its parts are: KIND B for each kind of noise (uniform, gaussian B [sigma S], alternating, bias,
        drift B [rate R], ...) with its bound B; delay D, or delay D-E for one that is drawn for each episode
        [samples]; hold M [rate P], where samples are lost with probability P (by default a half), at most M
        in a row; and quantum Q.

        Raises:
            BadInput: it describes none.
        """
        if not isinstance(text, str):
            raise BadInput(
                f"the sensor {text!r:.60} is no text: give one as 'uniform 0.05 + delay 1'"
            )
        parts = re.split(r"\+(?!\d)", text)  # not that of 1e+3
        if len(parts) > (most := 20):  # each takes its time at every sample
            raise BadInput(f"the sensor {text!r:.60} has {len(parts):,} parts: give at most {most}")
        return Sensor(tuple(map(Part.parse, parts)))

    def __post_init__(self) -> None:
        for word in (DELAY, HOLD, QUANTUM):
            if sum(part.word == word for part in self.parts) > 1:
                raise BadInput(f"'{self}' has more than one {word}: give one")

    def __str__(self) -> str:
        return " + ".join(map(str, self.parts))

    @property
    def kind(self) -> str:
        """Its text, by which runs under it are called."""
        return str(self)

    @property
    def bound(self) -> float:
        """The largest magnitude of what is added to a sample, in the unit of the measurement."""
        noises = (part.value for part in self.parts if part.is_noise)
        return sum(noises) + self.part(QUANTUM).value / 2

    @property
    def delays(self) -> tuple[int, int]:
        """The shortest and the longest delay of an episode [samples]."""
        delay = self.part(DELAY)
        return int(delay.options.get("least", delay.value)), int(delay.value)

    @property
    def held(self) -> int:
        """How many samples are held in a row, at most."""
        return int(self.part(HOLD).value)

    @property
    def late(self) -> int:
        """How many samples old a measurement can be."""
        return self.delays[1] + self.held

    def part(self, word: str) -> Part:
        """Returns the part of a word, or `NOTHING`."""
        return next((part for part in self.parts if part.word == word), NOTHING)

    def bounds(self, task: Task) -> tuple[np.ndarray, np.ndarray]:
        """Returns the bounds of what is added to the chart's coordinates at a sample, but for the bias (d,).

        Then those of the bias (d,), which stays during an episode.
        """
        shares = np.abs(self._shares(task))[: task.chart.dimension]
        bias = sum(part.value for part in self.parts if part.word == Bias.kind)
        return (self.bound - bias) * shares, bias * shares

    def reach(self, task: Task) -> np.ndarray:
        """Returns how far off each column of a measurement can be: (p,), in its unit.

        That is the bound of what is added, and what the robot moves meanwhile; see `Task.moves`.
        """
        added = self.bound * np.abs(self._shares(task))
        reach = added + self.late * task.moves if self.late else added
        return np.abs(np.ceil(reach * DECIMALS - ROUNDING)) / DECIMALS  # where it is 0 not -0

    def _check_on(self, task: Task) -> None:
        """Raises `BadInput` if it hides the whole chart, or the chart is not how the measurement begins."""
        reach, d = self.reach(task), task.chart.dimension
        if bound := float(reach[:d].max()):
            task.with_noise(tuple((reach / bound).tolist())).check_noise(bound)
        if self.late and not begins_with_chart(task):
            raise BadInput(
                f"what a robot moves while a sensor is late is known of each column, and those of "
                f"{task.name} do not begin with its chart ({', '.join(task.chart.names)}): let the "
                "measurement begin with them, or leave delay and hold out"
            )

    def on(self, task: Task) -> tuple[float, tuple[float, ...]]:
        """Returns the noise bound, and its shares (p,), that cover all that it can do to a chart point.

        Columns of the measurement beside the chart get the noise that is added to them, and may be late.

        Raises:
            BadInput: the sensor cannot be used with the task, or its noise hides the whole chart.
        """
        self.against(task, None)
        reach, d = self.reach(task), task.chart.dimension
        reach[d:] = self.bound * np.abs(self._shares(task))[d:]
        if not (bound := float(reach[:d].max())):
            raise BadInput(
                f"the sensor {self} adds nothing on the chart of {task.name}: give it a bound"
            )
        return bound, tuple((reach / bound).tolist())

    def against(self, task: Task, controller: Controller | None) -> Signal:
        """Returns the signal for one closed loop.

        Raises:
            BadInput: a part cannot be used there.
        """
        if task.abilities.side_by_side is not None and (self.late or self.part(QUANTUM).value):
            raise BadInput(
                f"{task.name} is an environment, which observes by itself: put Gymnasium's "
                "DelayObservation around it for a delay, and leave delay, hold and quantum out"
            )
        if self.late >= task.max_steps:
            raise BadInput(
                f"the sensor {self} can be {self.late} samples late, and an episode of {task.name} has "
                f"{task.max_steps}: give fewer"
            )
        self._check_on(task)
        return Sensed(self.bound, self._shares(task)).begin(self, task, controller)

    def _shares(self, task: Task) -> np.ndarray:
        return np.array(task.sensor_shares or task.noisy, dtype=float)


@register_noise
class Sensed(Signal):
    """The noise of a sensor in one closed loop.

    `Noise("sensor", eps)` is what the task's own sensor does, with the bound that covers it, or with none.
    """

    kind = SENSOR
    sensor: Sensor | None = None

    def against(self, task: Task, controller: Controller | None) -> Signal:  # type: ignore[override]
        if self.sensor is not None:
            return self.sensor.against(task, controller)
        if not task.sensor:
            raise BadInput(
                f"{task.name} has no sensor of its own: make its run with --noise, as --noise 'uniform 0.05 "
                "+ delay 1', or give another kind of noise"
            )
        if self.bound and not covers_sensor(task, self.bound):
            raise BadInput(
                f"the sensor of {task.name} ({task.sensor}) reaches beyond a bound of {self.bound:g}: leave "
                "the bound out"
            )
        return Sensor.parse(task.sensor).against(task, controller)

    def begin(self, sensor: Sensor, task: Task, controller: Controller | None) -> Self:
        """Gets ready for one closed loop of a task, and returns itself."""
        shares, self._reach = self.shares, sensor.reach(task)
        self.bound = float(self._reach[: task.chart.dimension].max())
        self.sensor, self.task = sensor, task
        self.noises = [
            made(part.word, part.value, shares, part.options, task, controller)
            for part in sensor.parts
            if part.is_noise
        ]
        self._quantum = sensor.part(QUANTUM).value * np.abs(shares)
        self._delays, self._most = sensor.delays, sensor.held
        self._rate = sensor.part(HOLD).options.get("rate", 0.5)
        self._late, added = sensor.late, not (sensor.late or self._quantum.any())
        self.unseeing = added and all(noise.unseeing for noise in self.noises)
        return self

    @property
    def limits(self) -> np.ndarray:
        return np.asarray(self._reach + (self._reach > 0) / DECIMALS)

    def reset(self, n: int, rng: np.random.Generator) -> None:
        super().reset(n, rng)
        for noise in self.noises:
            begin_signal(noise, n, rng)
        columns = len(self.shares)
        self._sent = np.zeros((n, 1 + self._delays[1], columns))  # the last one last
        self._told, self._row = np.zeros((n, columns)), np.zeros(n, int)
        self._delay = np.zeros(n, int)

    def sample(self, now: Sample) -> np.ndarray:
        true, rows, fresh = now.measurement, now.rows, now.k == 0
        added = sum((drawn(noise, now) for noise in self.noises), np.zeros_like(true))
        seen = true + added
        if (some := self._quantum > 0).any():
            seen[:, some] = np.round(seen[:, some] / self._quantum[some]) * self._quantum[some]
            added = seen - true
        if not self._late:
            return added
        sent = np.concatenate([self._sent[rows, 1:], seen[:, None]], axis=1)
        sent[fresh] = seen[fresh, None]
        self._sent[rows] = sent
        low, high = self._delays
        self._delay[rows[fresh]] = self.rng.integers(low, high + 1, int(fresh.sum()))
        told = sent[np.arange(len(rows)), -1 - self._delay[rows]]
        if self._most:
            lost = (self.rng.random(len(rows)) < self._rate) & (self._row[rows] < self._most)
            lost &= ~fresh
            told[lost] = self._told[rows[lost]]
            self._row[rows] = np.where(lost, self._row[rows] + 1, 0)
        self._told[rows] = told
        noise, d = told - true, self.task.chart.dimension
        noise[:, :d] = self.task.chart.difference(told[:, :d], true[:, :d])
        # A run that is over is measured no more: what its end does, such as a collision, is no move.
        over = self.task.outcome(true, now.plant.unstable[rows]) != Outcome.RUNNING
        noise[over] = 0.0
        self._check_moves(noise, now)
        return noise

    def _check_moves(self, noise: np.ndarray, now: Sample) -> None:
        """Raises `BadInput` if the robot has moved farther than the noise (n, p) of a delay allows for."""
        if (beyond := np.abs(noise) > self.limits).any():
            row, column = np.argwhere(beyond)[0]
            at = f"column {column} at sample {now.k[row]} of simulation {now.rows[row]}"
            raise BadInput(
                f"a measurement of {self.task.name} is off by {abs(noise[row, column]):.6g} in {at}, where "
                f"{self._reach[column]:.6g} was allowed for: the robot moves farther in one sample than the "
                f"{self.task.moves[column]:.6g} that trials have shown, so no bound covers its sensor's delay"
            )


def covers_sensor(task: Task, bound: float) -> bool:
    """Returns whether a task has a sensor, and a bound of noise covers all that it does to chart points."""
    if not task.sensor:
        return False
    reach = Sensor.parse(task.sensor).reach(task)[: task.chart.dimension]
    return bool((reach <= task.noise_in_chart(bound) + 1 / DECIMALS).all())


def usual_kinds(task: Task, bound: float, everywhere: bool = False) -> tuple[str, ...]:
    """Returns the kinds of noise by which controllers of a task are judged under noise of a bound.

    Where samples take long, an adversary that looks ahead takes too long; an attack is there. What the task's
    own sensor does is one of them if the bound covers it, and noise does not act on all columns.
    """
    kinds = KINDS if task.effort.looks_ahead else KINDS[:-1]
    return (*kinds, SENSOR) if not everywhere and covers_sensor(task, bound) else kinds
