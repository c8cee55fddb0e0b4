"""Measurement noise: signals bounded by eps on the columns of the measurement that they act on.

`Noise` names a kind and its bound; a `Signal` disturbs one closed loop. To add a kind, write a class like
those below and register it where it is defined.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np

from hyrl_mj.errors import BadInput, check_bound, unknown
from hyrl_mj.plant import Plant
from hyrl_mj.policies import Controller
from hyrl_mj.tasks import Task

# The mode of a run before its first measurement, from which the controller picks its start mode.
NOT_STARTED = -1


@dataclass(frozen=True)
class Sample:
    """What a signal may know when it is sampled, for n of the simulations that it disturbs.

    Attributes:
        rows: (n,) int indices of the simulations.
        k: (n,) int sample numbers. Where k is 0 a run begins anew and a signal with memory has to restart.
        measurement: (n, p) true measurements.
        q: (n,) int modes; `NOT_STARTED` where none has been picked.
        plant: all simulations.
        past: (n, memory, p) past measurements, for a controller that takes them; None for others.
    """

    rows: np.ndarray
    k: np.ndarray
    measurement: np.ndarray
    q: np.ndarray
    plant: Plant
    past: np.ndarray | None = None


class Signal(ABC):
    """Measurement noise on one closed loop.

    Args:
        bound: largest magnitude eps >= 0, in the unit of the measurement.
        shares: (p,) how much of the bound acts on each column of the measurement.

    Attributes:
        kind: name of the kind.
        needs_controller: whether the signal acts against a controller.
        rng: the generator that random noise is drawn from, after `reset`.
    """

    kind: str
    needs_controller = False
    rng: np.random.Generator

    def __init__(self, bound: float, shares: np.ndarray):
        self.bound, self.shares = bound, shares

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

    def for_rows(self, rows: np.ndarray) -> Signal:
        """Returns the signal for the simulations `rows` (k,), which then are numbered from 0 on.

        A signal that holds something for each simulation returns that of these.
        """
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
    other = _KINDS.get(signal.kind, signal)
    if (other.__module__, other.__qualname__) != (signal.__module__, signal.__qualname__):
        raise BadInput(
            f"{signal.__name__} cannot be registered: noise {signal.kind!r} is already "
            f"{other.__module__}.{other.__qualname__}, so choose another kind"
        )
    _KINDS[signal.kind] = signal
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

    def sample(self, now: Sample) -> np.ndarray:
        return self.rng.uniform(-self.bound, self.bound, now.measurement.shape) * self.shares


@register_noise
class Alternating(Signal):
    """Noise +bound, -bound, +bound, ...: the paper's."""

    kind = "alternating"

    def sample(self, now: Sample) -> np.ndarray:
        return np.where(now.k % 2 == 0, self.bound, -self.bound)[:, None] * self.shares


@dataclass(frozen=True)
class Recorded(Signal):
    """A recorded noise signal; after its last sample there is no noise.

    Attributes:
        values: (K, n, p) noise on n simulations, in the unit of the measurement.
        bound: largest magnitude of the values.
        kind: name of the kind.
    """

    values: np.ndarray
    bound: float
    kind: str = "recorded"

    def for_rows(self, rows: np.ndarray) -> Signal:
        return replace(self, values=self.values[:, rows])

    def reset(self, n: int, rng: np.random.Generator) -> None:
        if self.values.shape[1] != n:
            raise self._misfit(f"{n} simulations")

    def sample(self, now: Sample) -> np.ndarray:
        columns = now.measurement.shape[1]
        if self.values.shape[2] != columns:
            raise self._misfit(f"{columns} columns of measurement")
        over = now.k >= len(self.values)
        values = self.values[np.minimum(now.k, len(self.values) - 1), now.rows]
        return np.where(over[:, None], 0.0, values)

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
        if self.kind not in _KINDS:
            raise unknown("noise", self.kind, _KINDS)
        check_bound(self.bound)

    def against(self, task: Task, controller: Controller | None) -> Signal:
        """Returns the signal of this kind for one closed loop, as `Signal.against`.

        Raises:
            BadInput: the kind needs a controller and there is none, or the bound hides the whole chart.
        """
        task.check_noise(self.bound, self.everywhere)
        shares = np.ones(len(task.noisy)) if self.everywhere else np.array(task.noisy, dtype=float)
        return _KINDS[self.kind](self.bound, shares).against(task, controller)


# The types that a closed loop takes as noise.
AnyNoise = Noise | Signal


def signal_for(noise: AnyNoise | None, task: Task, controller: Controller | None) -> Signal:
    """Returns the signal for one closed loop, by default without noise.

    Raises:
        BadInput: `noise` has another type, or cannot be used here.
    """
    noise = Noise() if noise is None else noise
    if not isinstance(noise, AnyNoise):
        raise BadInput(f'noise {noise!r} cannot be used: give a hyrl_mj.Noise("uniform", 0.1), say')
    return noise.against(task, controller)
