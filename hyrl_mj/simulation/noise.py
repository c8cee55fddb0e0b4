"""Measurement noise: signals bounded by eps on the columns of the measurement that they act on.

`Noise` names a kind and its bound; a `Signal` disturbs one closed loop. To add a kind, write a class like
those below and register it where it is defined.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, Self, TypeVar, get_args, runtime_checkable

import numpy as np

from hyrl_mj.errors import BadInput, check_bound, unknown
from hyrl_mj.simulation.checked_noise import (
    begin_signal,
    check_repeats,
    drawn,
    limits_of,
    play_and_begin,
    too_large,
    twin_of,
    within,
)

if TYPE_CHECKING:
    from hyrl_mj.physics.plant import Plant
    from hyrl_mj.policies import Controller
    from hyrl_mj.tasks import Task

# The mode of a run before its first measurement, from which the controller picks its start mode.
NOT_STARTED = -1
# The kinds of noise by which controllers are judged, the mildest first.
KINDS = ("none", "uniform", "alternating", "adversarial")
# The kind that is what a task's own sensor does; see `hyrl_mj.simulation.sensors`.
SENSOR = "sensor"
# The words of parts of sensors that are not noise which is added to a sample; and of the errors of a log.
DELAY, HOLD, QUANTUM, LOG = "delay", "hold", "quantum", "log"
# Noise that is searched for against a controller.
OF_RUNS = ("attack", "worst")
# What follows the last sample of a recorded signal.
After = Literal["refuse", "hold", "repeat", "none"]


@dataclass(frozen=True)
class Sample:
    """What a signal may know when it is sampled, for n of the simulations that it disturbs.

    Attributes:
        rows: (n,) int indices of the simulations.
        k: (n,) int sample numbers. Where k is 0 a run begins anew and a signal with memory has to restart.
        measurement: (n, p) true measurements.
        q: (n,) int modes; `NOT_STARTED` where none has been picked.
        plant: all simulations.
        memory: (n, ...) the controller's memory, (n, 0) for one without; None where each run begins.
    """

    rows: np.ndarray
    k: np.ndarray
    measurement: np.ndarray
    q: np.ndarray
    plant: Plant
    memory: np.ndarray | None = None


class Signal(ABC):
    """Measurement noise on one closed loop.

    Args:
        bound: largest magnitude eps >= 0, in the unit of the measurement.
        shares: (p,) how much of the bound acts on each column of the measurement.

    Attributes:
        kind: name of the kind.
        needs_controller: whether the signal acts against a controller.
        unseeing: whether it draws its noise whatever it is shown. In a loop whose runs are not at the same
            sample, the noise of each sample is then drawn for all of them at once.
        rng: the generator that random noise is drawn from, after `reset`.
    """

    kind = "unnamed"
    needs_controller = False
    unseeing = False
    # Signals that it is made of.
    noises: Sequence[Signal] = ()
    rng: np.random.Generator

    def __init__(self, bound: float, shares: np.ndarray):
        self.bound, self.shares = bound, shares

    @property
    def limits(self) -> np.ndarray:
        """The largest magnitude of the noise on each column of the measurement, (p,)."""
        return np.asarray(self.bound * np.abs(self.shares))

    def against(self, task: Task, controller: Controller | None) -> Self:
        """Returns the signal for one closed loop: a copy, because loops do not share their memory.

        The controller is None in an environment, where an agent closes the loop.

        Raises:
            BadInput: the signal needs a controller, and there is none.
        """
        if self.needs_controller and controller is None:
            raise BadInput(
                f"{self.kind} noise needs a controller to act against: use simulate(), or another kind of "
                "noise here"
            )
        return copy(self)

    def reset(self, n: int, rng: np.random.Generator) -> None:
        """Begins n simulations with a generator to draw from; a signal with memory allocates it here."""
        self.rng = rng

    @abstractmethod
    def sample(self, now: Sample) -> np.ndarray:
        """Returns the noise (n, p) on the measurements of a sample, in their unit."""


AnySignal = TypeVar("AnySignal", bound=Signal)
_KINDS: dict[str, type[Signal]] = {}


def register_noise(signal: type[AnySignal]) -> type[AnySignal]:
    """Registers a class of signals by its `kind`, for `Noise(kind, bound)` and `--noise KIND`.

    Use it as a class decorator. The class is constructed with a bound and shares, as `Signal` is.

    Raises:
        BadInput: another class has that kind.
    """
    words = signal.kind.split() if isinstance(signal.kind, str) else []
    if words != [signal.kind] or "+" in signal.kind or signal.kind == Signal.kind:
        raise BadInput(
            f"{signal.__name__} cannot be registered as {signal.kind!r}: give it a kind of one word, as "
            'kind = "walk"'
        )
    if signal.kind in (DELAY, HOLD, QUANTUM, LOG, *OF_RUNS):
        raise BadInput(
            f"{signal.__name__} cannot be registered: {signal.kind!r} means something else where noise is "
            "named, so choose another kind"
        )
    other = _KINDS.get(signal.kind, signal)
    if (other.__module__, other.__qualname__) != (signal.__module__, signal.__qualname__):
        raise BadInput(
            f"{signal.__name__} cannot be registered: noise {signal.kind!r} is already "
            f"{other.__module__}.{other.__qualname__}, so choose another kind"
        )
    _KINDS[signal.kind] = signal
    return signal


def noise_class(kind: str) -> type[Signal]:
    """Returns the class of a kind of noise; raises `BadInput` for a kind that is not registered."""
    if kind in OF_RUNS:
        raise BadInput(
            f"noise {kind!r} is another signal for each controller, which has to be found first: use hyrl-mj "
            f"simulate RUN --start ... --noise {kind}, or in Python Game(...).worst_noise(name, eps)"
        )
    if kind not in _KINDS:
        raise unknown("noise", kind, _KINDS)
    return _KINDS[kind]


def made(
    kind: str,
    bound: float,
    shares: np.ndarray,
    options: Mapping[str, float],
    task: Task,
    controller: Controller | None,
) -> Signal:
    """Returns the signal of a kind for one closed loop, with options as its attributes.

    Raises:
        BadInput: it cannot be used there, or has other bounds than are given.
    """
    signal = noise_class(kind)(bound, shares.copy())
    vars(signal).update(options)
    signal = signal.against(task, controller)
    limits, allowed = limits_of(signal), bound * np.abs(shares)
    if kind != SENSOR and not np.array_equal(limits, allowed):
        raise BadInput(
            f"{kind} noise of {bound:g} takes {limits} as its largest magnitudes, and is allowed {allowed}: "
            "leave its bound and shares as they are given"
        )
    return signal


def noise_kinds() -> tuple[str, ...]:
    """Returns the registered kinds of noise."""
    return tuple(_KINDS)


@register_noise
class NoNoise(Signal):
    """Exact measurements."""

    kind = "none"

    def sample(self, now: Sample) -> np.ndarray:
        return np.zeros_like(now.measurement)


@register_noise
class Uniform(Signal):
    """Noise drawn anew at every sample, uniformly between its bounds."""

    kind = "uniform"
    unseeing = True

    def sample(self, now: Sample) -> np.ndarray:
        return self.rng.uniform(-self.bound, self.bound, now.measurement.shape) * self.shares


@register_noise
class Alternating(Signal):
    """Noise +bound, -bound, +bound, ...: the paper's."""

    kind = "alternating"

    def sample(self, now: Sample) -> np.ndarray:
        return np.where(now.k % 2 == 0, self.bound, -self.bound)[:, None] * self.shares


@dataclass(eq=False)
class Recorded(Signal):
    """A recorded noise signal.

    Attributes:
        values: (K, n, p) noise on n simulations, in the unit of the measurement.
        bound: largest magnitude of the values, or of values / shares if shares are given.
        kind: name of the kind.
        after: what follows the last sample while a run goes on: "refuse" raises `BadInput`, "hold" keeps the
            last sample, "repeat" begins again with the first, and "none" adds no more noise.
        shares: (p,) how much of the bound acts on each column of the measurement; by default all of it.

    Raises:
        BadInput: values of another shape or type, not finite, or beyond the bound; or an unknown `after`.
    """

    values: np.ndarray
    bound: float
    kind: str = "recorded"
    after: After = "refuse"
    shares: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_bound(self.bound)
        if self.after not in get_args(After):
            raise unknown("way to go on after a recorded noise", self.after, get_args(After))
        values = np.asarray(self.values)
        single = values.dtype == np.float32
        if values.ndim != 3 or not values.size or values.dtype.kind not in "iuf":
            raise BadInput(
                f"a recorded noise of type {values.dtype} and shape {values.shape} cannot be used: give "
                "numbers of shape (samples, simulations, columns)"
            )
        columns = values.shape[2]
        shares = np.ones(columns) if self.shares is None else np.asarray(self.shares, dtype=float)
        if shares.shape != (columns,) or not np.isfinite(shares).all():
            raise BadInput(
                f"a recorded noise on {columns} columns has shares {shares}: give a number for each"
            )
        # Copies, because the arrays are their owner's, who may fill them anew.
        self.values, self.shares = values.astype(float), shares.copy()
        bad = ~within(values if single else self.values, self.limits)
        if bad.any():
            k, row, column = np.argwhere(bad)[0]
            raise too_large(self, k, row, column, self.values[k, row, column])
        if single:
            self.values = np.clip(self.values, -self.limits, self.limits)

    def reset(self, n: int, rng: np.random.Generator) -> None:
        if self.values.shape[1] != n:
            raise self._misfit(f"{n} simulations")

    def sample(self, now: Sample) -> np.ndarray:
        columns, samples = now.measurement.shape[1], len(self.values)
        if self.values.shape[2] != columns:
            raise self._misfit(f"{columns} columns of measurement")
        over = now.k >= samples
        if self.after == "refuse" and over.any():
            raise BadInput(
                f"the {self.kind} noise was recorded for {samples} samples, and a run goes on after them: "
                'record more, or give after="hold", "repeat" or "none"'
            )
        k = now.k % samples if self.after == "repeat" else np.minimum(now.k, samples - 1)
        values = self.values[k, now.rows]
        return np.where(over[:, None], 0.0, values) if self.after == "none" else values

    def _misfit(self, what: str) -> BadInput:
        return BadInput(
            f"a recorded noise of shape {self.values.shape} does not fit {what}: "
            "its shape is (samples, simulations, columns)"
        )


@dataclass(frozen=True)
class Noise:
    """A kind of measurement noise with its bound.

    Attributes:
        kind: "none"; "uniform", drawn anew at every sample from [-bound, bound]; "alternating", +bound,
            -bound, +bound, ... (the paper's); "adversarial", the noise that leads to the greatest danger
            soon after each sample; or another registered kind.
        bound: largest magnitude eps >= 0, in the unit of the measurement.
        everywhere: whether the noise acts on all columns of the measurement, not only on the noisy ones.
    """

    kind: str = "none"
    bound: float = 0.0
    everywhere: bool = False

    def __post_init__(self) -> None:
        noise_class(self.kind)
        check_bound(self.bound)

    def against(self, task: Task, controller: Controller | None) -> Signal:
        """Returns the signal of this kind for one closed loop, as `Signal.against`.

        Raises:
            BadInput: the kind needs a controller and there is none, or the bound hides the whole chart.
        """
        task.check_noise(self.bound, self.everywhere)
        if self.everywhere and self.kind == SENSOR:
            raise BadInput("a sensor tells where it acts: leave all coordinates out")
        noisy = task.noisy_everywhere().noisy if self.everywhere else task.noisy
        shares = np.array(noisy, dtype=float)
        return made(self.kind, self.bound, shares, {}, task, controller)


@runtime_checkable
class AnyNoise(Protocol):
    """What a closed loop takes as noise: a `Noise`, a `Sensor` or a `Signal`."""

    @property
    def kind(self) -> str:
        """The name of its kind."""

    @property
    def bound(self) -> float:
        """Its largest magnitude, in the unit of the measurement."""

    def against(self, task: Task, controller: Controller | None) -> Signal:
        """Returns the signal for one closed loop; see `Signal.against`."""


def signal_for(noise: AnyNoise | None, task: Task, controller: Controller | None) -> Signal:
    """Returns the signal for one closed loop, by default without noise.

    Raises:
        BadInput: `noise` has another type, or cannot be used here.
    """
    noise = Noise() if noise is None else noise
    if isinstance(noise, type) or not isinstance(noise, AnyNoise | Signal):
        raise BadInput(
            f'noise {noise!r:.80} cannot be used: give a hyrl_mj.Noise("uniform", 0.1), say'
        )
    signal = noise.against(task, controller)
    for one in (signal, *signal.noises):
        limits, p = limits_of(one), len(task.noisy)
        if limits.shape != (p,) or not (limits >= 0).all():
            raise BadInput(
                f"{one.kind} noise has {limits} as its largest magnitudes: give it a bound >= 0, and a share "
                f"for each of the columns of the measurement, of which {task.name} has {p}"
            )
        object.__setattr__(one, "_begun", limits.copy())  # a user's may be frozen
    return signal


def try_signal(signal: Signal, task: Task, n: int) -> None:
    """Raises `BadInput` if a user's signal on n simulations gives other noise with the same seed.

    A closed loop looks at that by itself; in an environment an agent closes the loop.
    """
    twins = [twin for _ in range(2) if (twin := twin_of(signal, task)) is not None]
    if len(twins) < 2:
        return
    for twin in twins:
        begin_signal(twin, n, 0)
    plant = task.placed(task.starts(n, np.random.default_rng(0)), np.random.default_rng(0))
    for k in range(8):
        samples, modes = np.full(n, k), np.full(n, NOT_STARTED)
        now = Sample(np.arange(n), samples, plant.measurement, modes, plant)
        noise = drawn(twins[0], now)
        if k == 0:
            play_and_begin(twins[1], now, n, 0)
        check_repeats(twins[0], noise, twins[1], now)
