"""Noise as a closed loop draws it: what a user's signal gives is checked, and it changes nothing else."""

from __future__ import annotations

from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrl_mj.errors import BadInput, brief
from hyrl_mj.system.generators import global_state
from hyrl_mj.tasks import read_only, writes

if TYPE_CHECKING:
    from hyrl_mj.simulation.noise import Sample, Signal


def drawn(signal: Signal, now: Sample) -> np.ndarray:
    """Returns the noise (n, p) of a signal at a sample; each loop draws its noise here.

    Raises:
        BadInput: it raises an error, changes what it is shown, gives another shape or type, or noise that is
            not finite or larger than its bound times the share of its column.
    """
    before = None if is_own(signal) else global_state()
    arrays = {
        name: read_only(getattr(now, name)) for name in ("rows", "k", "measurement", "q", "memory")
    }
    plant: Any = _Seen(now.plant)
    shown = replace(now, plant=plant, **arrays)
    try:
        noise = signal.sample(shown)
    except BadInput:
        raise
    except Exception as error:  # a user's code can raise anything
        if writes(error):
            raise BadInput(
                f"{signal.kind} noise writes to an array that it is shown: let it work on a copy"
            ) from error
        raise BadInput(f"{signal.kind} noise cannot be used: it raised {brief(error)}") from error
    if before is not None and global_state() != before:
        raise BadInput(
            f"{signal.kind} noise draws from a global generator, which no seed decides: let it draw from "
            "self.rng"
        )
    true, limits = now.measurement, limits_of(signal)
    if not isinstance(noise, np.ndarray) or noise.shape != true.shape or noise.dtype.kind != "f":
        given = np.asarray(noise)
        kind = given.dtype if isinstance(noise, np.ndarray) else f"a {type(noise).__name__}"
        raise BadInput(
            f"{signal.kind} noise gives {kind} of shape {given.shape}, where {true.shape} floats are "
            "needed: a row for each simulation, a column for each of the measurement"
        )
    begun = getattr(signal, "_begun", limits)
    if limits.shape != true.shape[1:] or not np.array_equal(limits, begun):
        raise BadInput(
            f"{signal.kind} noise has {limits} as its largest magnitudes at sample {now.k.max()} and had "
            f"{begun} at first: give one share a column, and let sample() leave bound and shares as they are"
        )
    bad = ~within(noise, limits, true)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise too_large(signal, now.k[row], now.rows[row], column, noise[row, column])
    return noise if noise.dtype == float else np.clip(noise.astype(float), -limits, limits)


def is_own(signal: Signal) -> bool:
    """Returns whether the class of a signal is of this package, and of all signals that it is made of."""
    own = type(signal).__module__.startswith("hyrl_mj.")
    return own and all(map(is_own, getattr(signal, "noises", ())))


def twin_of(signal: Signal, *kept: object) -> Signal | None:
    """Returns a copy of a signal of a user's class, which keeps some objects; None if it cannot be copied."""
    with suppress(Exception):  # a user's object can raise anything
        return None if is_own(signal) else deepcopy(signal, {id(one): one for one in kept})
    return None


def begin_signal(signal: Signal, n: int, seed: int | np.random.Generator) -> None:
    """Resets a signal for n simulations; raises `BadInput` if a user's raises an error."""
    try:
        signal.reset(n, np.random.default_rng(seed))
    except BadInput:
        raise
    except Exception as error:  # a user's code can raise anything
        raise BadInput(
            f"{signal.kind} noise cannot be used: its reset() raised {brief(error)}"
        ) from error


def play_and_begin(twin: Signal, now: Sample, n: int, seed: int) -> None:
    """Lets a twin play a sample and begin anew, as a signal does that has played before."""
    drawn(twin, now)
    begin_signal(twin, n, seed)


def check_repeats(signal: Signal, noise: np.ndarray, twin: Signal, now: Sample) -> None:
    """Raises `BadInput` unless a twin of a signal, begun with the same seed, gives the same noise."""
    if not np.array_equal(drawn(twin, now), noise):
        raise BadInput(
            f"{signal.kind} noise gives other values where it begins anew with the same seed: let it draw "
            "from self.rng alone, and remember in attributes that its reset() sets"
        )


class _Seen:
    """A plant that noise may look at; the simulation alone moves it."""

    def __init__(self, plant: Any):
        self._plant = plant

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # as Python asks where it copies
            raise AttributeError(name)
        if name in ("step", "step_backward", "set_state", "put", "observe", "end"):
            raise BadInput(
                f"noise calls {name}() of the plant that is simulated: look ahead with one of its own, made "
                "by task.plant(n)"
            )
        return getattr(self._plant, name)


def limits_of(signal: Signal) -> np.ndarray:
    """Returns `limits` of a signal, whose class may be a user's."""
    try:
        return np.asarray(signal.limits, dtype=float)
    except (AttributeError, TypeError, ValueError):
        raise BadInput(
            f"{signal.kind} noise has no bound and shares: call super().__init__(bound, shares) when made"
        ) from None


def within(noise: np.ndarray, limits: np.ndarray, measured: np.ndarray | None = None) -> np.ndarray:
    """Returns whether noise (..., p) is finite and within limits (p,), but for rounding, of each number."""
    largest = np.abs(noise)
    inside = largest <= limits
    if not inside.all():  # seldom, so that the usual case stays cheap
        scale = limits if measured is None else limits + np.abs(measured)
        eps = np.finfo(noise.dtype if noise.dtype.kind == "f" else float).eps
        # A few roundings of it, or of the measurement that it is the difference of.
        inside = largest <= limits + 8 * eps * np.where(limits > 0, scale, 0.0)
    return np.asarray(inside)


def too_large(signal: Signal, k: int, row: int, column: int, value: float) -> BadInput:
    """Returns the error for noise of a value on a column, at a sample k of a simulation."""
    allowed = limits_of(signal)[column]
    most = f"at most {allowed:g} in magnitude" if allowed else "none"
    return BadInput(
        f"{signal.kind} noise is {value:g} at sample {k} of simulation {row} in column {column} of the "
        f"measurement, where {most} is allowed: bound {signal.bound:g} times the column's share"
    )
