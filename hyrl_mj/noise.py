"""Measurement noise: seeded signals, bounded by eps on the columns of the measurement that it hits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real

import numpy as np

from hyrl_mj.errors import BadInput, unknown

KINDS = ("none", "uniform", "alternating")


@dataclass(frozen=True)
class Noise:
    """A kind of measurement noise with its bound.

    Attributes:
        kind: "none"; "uniform", drawn anew at every sample from [-bound, bound]; or "alternating",
            +bound, -bound, +bound, ... (the paper's).
        bound: largest magnitude eps >= 0, in the unit of the measurement.
    """

    kind: str = "none"
    bound: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise unknown("noise", self.kind, KINDS)
        check_bound(self.bound)

    def sample(self, k: np.ndarray, columns: int, rng: np.random.Generator) -> np.ndarray:
        """The noise of n simulations at their samples k.

        Args:
            k: (n,) int, the number of each simulation's sample.
            columns: p, the number of columns of the measurement.
            rng: the generator that random noise is drawn from.

        Returns:
            (n, p), in the unit of the measurement.
        """
        shape = (len(k), columns)
        if self.kind == "uniform":
            return rng.uniform(-self.bound, self.bound, shape)
        if self.kind == "alternating":
            return np.broadcast_to(np.where(k % 2 == 0, self.bound, -self.bound)[:, None], shape)
        return np.zeros(shape)


def check_seed(seed: int) -> int:
    """The seed itself, if it is one.

    Raises:
        BadInput: it is not an integer from 0 to 2**32 - 1, what NumPy, torch and SB3 all take.
    """
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise BadInput(f"seed {seed!r} cannot be used: give an integer from 0 to 4294967295")
    return int(seed)


def check_bound(bound: float) -> float:
    """The noise bound itself, if it is one.

    Raises:
        BadInput: it is negative, infinite or not a number.
    """
    if not (isinstance(bound, Real) and math.isfinite(bound) and bound >= 0):
        raise BadInput(f"noise bound {bound!r} cannot be used: give a finite number >= 0")
    return float(bound)
