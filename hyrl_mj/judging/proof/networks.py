"""Bounds of policies over boxes of measurements: which levels, or which inputs, they can give there.

The network is bounded layer by layer by linear relaxations (DeepZ: Singh et al., Fast and Effective
Robustness Certification, NeurIPS 2018), with the sides of the box as generators and an interval for the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.judging.proof.rules import Truth, as_form, bounds
from hyrl_mj.policies import ACTIVATIONS, BLAS, MlpPolicy, Policy, PreprocessedPolicy
from hyrl_mj.system import cores
from hyrl_mj.tasks import Task
from hyrl_mj.tracing import BATCH, Program, trace

# Relative rounding error of numbers of 32 bits, in which networks are computed.
ROUNDING = 2.0**-24


def method_of(task: Task, name: str) -> str:
    """Returns what messages call a method of a task."""
    return f"the method {name} of {task.name}"


def program_of(task: Task, name: str) -> Program:
    """Returns the operations of a method of a task that takes measurements (n, p).

    Raises:
        Unbounded: its operations cannot be followed.
    """
    z = task.chart.draw(BATCH, np.random.default_rng(0))
    try:
        return trace(getattr(task, name), {"measured": z}, method_of(task, name), "bounded")
    except BadInput as error:
        raise Unbounded(str(error)) from error


def bounds_of(program: Program, name: str, boxes: Affine) -> Affine | Truth:
    """Returns the result of a program over boxes; raises `Unbounded` with the name in its message."""
    try:
        return bounds(program, boxes)
    except Unbounded as error:
        raise Unbounded(f"{name} cannot be bounded: it {error}") from error


@dataclass(frozen=True)
class BoundedPolicy:
    """A policy whose answers are bounded over boxes.

    Attributes:
        network: its multilayer perceptron.
        observation: the operations from the measurement to the observation.
        normalization: those from the observation to what the network sees; None if it sees just that.
    """

    network: MlpPolicy
    observation: Program
    normalization: Program | None = None

    @staticmethod
    def from_policy(policy: Policy) -> BoundedPolicy:
        """Returns the bounded form of a policy.

        Raises:
            Unbounded: it is no network, has memory, or its task's observation cannot be followed.
        """
        inner, normalize = policy, None
        if type(policy) is PreprocessedPolicy and policy.preprocessing.n_stack == 1:
            inner, normalize = policy.policy, policy.preprocessing.normalization
        if type(inner) is not MlpPolicy:  # a class of its own may act otherwise
            raise Unbounded(f"a policy that is a {type(policy).__name__} cannot be bounded")
        observation = program_of(inner.task, "observation")
        if normalize is None:
            return BoundedPolicy(inner, observation)
        (result,) = observation.outputs
        seen = result.value.astype(np.float32)
        return BoundedPolicy(inner, observation, trace(normalize, {"x": seen}, "it", "bounded"))

    def levels(self, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """Returns which levels the policy may choose in boxes: (n, levels) bool.

        Args:
            centre: (n, d) middle of each box.
            half: (d,) half of its sides.
        """
        x = self._hidden(centre, half)
        weight, bias = self.network.layers[-1]
        k = len(bias)
        first, second = np.divmod(np.arange(k * k), k)
        # How much better the first level is than the second, at least.
        by = (weight[first] - weight[second]).T
        size = np.abs(x.centre) + np.abs(x.generators).sum(axis=0) + x.remainder
        error = _rounding(len(by)) * (np.abs(weight[first]) + np.abs(weight[second])).T
        offset = bias[first] - bias[second]
        least = x.centre @ by + offset - np.abs(x.generators @ by).sum(axis=0)
        least -= x.remainder @ np.abs(by)
        least -= size @ error + _rounding(1) * (np.abs(bias[first]) + np.abs(bias[second]))
        worse = (least > 0).reshape(-1, k, k).any(axis=1)
        return np.asarray(~worse)

    def inputs(self, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        """Returns the least and greatest inputs in boxes, as for `levels`: (n, 2, m)."""
        x = _linear(self._hidden(centre, half), *self.network.layers[-1])
        ends = np.stack([x.low, x.high], axis=1).astype(float)
        low, high = self.network.task.input_limits
        unknown = np.isnan(ends).any(axis=1)[:, None]
        ends = np.where(unknown, np.array([[-np.inf], [np.inf]]), ends)
        if self.network.output == "squash":
            ends = low + (np.tanh(ends) + 1) / 2 * (high - low)
        return np.clip(ends, low, high)

    def _hidden(self, centre: np.ndarray, half: np.ndarray) -> Affine:
        """Returns the last hidden layer in boxes, in the single precision of networks."""
        what = method_of(self.network.task, "observation")
        seen = bounds_of(self.observation, what, Affine.box(centre, half))
        seen = as_form(seen, centre.shape[1])
        if self.normalization is not None:
            # The network sees the observation in single precision.
            rounding = 2 * ROUNDING * (np.abs(seen.centre) + seen.radius)
            seen = seen.wider(rounding)
            seen = as_form(bounds_of(self.normalization, "VecNormalize", seen), centre.shape[1])
        if seen.wild.any() or seen.nan.any():
            why = "has no limit" if seen.wild.any() else "may be NaN"
            raise Unbounded(f"{what} cannot be bounded: it {why} near some states")
        parts = seen.centre, seen.generators, seen.remainder
        x = Affine(*(part.astype(np.float32) for part in parts))
        relax = RELAXATIONS[self.network.activation]
        for weight, bias in self.network.layers[:-1]:
            x = relax(_linear(x, weight, bias))
        return x


def in_chunks(
    work: Callable[[np.ndarray, np.ndarray], np.ndarray], centre: np.ndarray, half: np.ndarray
) -> np.ndarray:
    """Returns what some work does with boxes, some of them at a time, on all cores."""
    size = 2048  # boxes that go through a network at a time
    parts = [centre[i : i + size] for i in range(0, len(centre), size)]
    with BLAS.limit(limits=1, user_api="blas"), ThreadPoolExecutor(cores.count()) as pool:
        return np.concatenate(list(pool.map(lambda part: work(part, half), parts)))


def _rounding(terms: int) -> float:
    """Returns a bound of the relative error of a sum of products, of the policy's and of ours."""
    return 4 * (terms + 2) * ROUNDING


def _linear(x: Affine, weight: np.ndarray, bias: np.ndarray) -> Affine:
    """Returns a linear layer of weight (outputs, inputs); the remainder takes in the rounding errors."""
    size = np.abs(x.centre) + np.abs(x.generators).sum(axis=0)
    error = _rounding(weight.shape[1])
    rest = (x.remainder * (1 + error) + error * size) @ np.abs(weight).T + error * np.abs(bias)
    return Affine(x.centre @ weight.T + bias, x.generators @ weight.T, rest)


def _parallel(x: Affine, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> Affine:
    """Returns an activation that lies between slope * x + low and slope * x + high."""
    error = 8 * ROUNDING * (1 + np.abs(low) + np.abs(high))
    return Affine(
        slope * x.centre + (low + high) / 2,
        slope * x.generators,
        np.abs(slope) * x.remainder + (high - low) / 2 + error,
    )


def _kinked(leak: float) -> Callable[[Affine], Affine]:
    """Returns the relaxation of max(x, leak * x): its chord, and the parallel through the kink."""

    def relax(x: Affine) -> Affine:
        low, high = x.low, x.high
        across = (low < 0) & (high > 0)
        chord = (high - leak * low) / np.where(across, high - low, 1)
        slope = np.where(across, chord, np.where(high > 0, 1, leak)).astype(np.float32)
        return _parallel(x, slope, np.zeros_like(low), np.where(across, low * (leak - slope), 0))

    return relax


def _tanh(x: Affine) -> Affine:
    low, high = x.low, x.high
    at_low, at_high = np.tanh(low), np.tanh(high)
    # With the smallest slope between them, the distance from the line is greatest at the ends.
    slope = np.maximum(np.minimum(1 - at_low**2, 1 - at_high**2) - 8 * ROUNDING, 0)
    return _parallel(x, slope, at_low - slope * low, at_high - slope * high)


def _curved(name: str, curvature: float) -> Callable[[Affine], Affine]:
    """Returns the relaxation of an activation by its chord, from its values at points between the ends.

    Between neighbouring points it leaves their chord by the largest second derivative times their squared
    distance, over 8, at most.
    """
    activate = ACTIVATIONS[name]

    def relax(x: Affine) -> Affine:
        low, high = x.low, x.high
        width = high - low
        rise = activate(high) - activate(low)
        slope = np.where(width > 0, rise / np.where(width > 0, width, 1), 0)
        points = 9  # at which it is evaluated between the two ends
        shares = np.linspace(0, 1, points, dtype=np.float32).reshape(-1, *[1] * low.ndim)
        at = low + shares * width
        off = activate(at) - slope * at
        between = curvature * (width / (points - 1)) ** 2 / 8
        return _parallel(x, slope, off.min(axis=0) - between, off.max(axis=0) + between)

    return relax


# By activation; the numbers are the largest magnitudes of their second derivatives.
RELAXATIONS: dict[str, Callable[[Affine], Affine]] = {
    "relu": _kinked(0.0),
    "leaky_relu": _kinked(0.01),
    "tanh": _tanh,
    "elu": _curved("elu", 1.0),
    "silu": _curved("silu", 0.5),
    "gelu": _curved("gelu", 0.8),
    "sigmoid": _curved("sigmoid", 0.0963),
}
