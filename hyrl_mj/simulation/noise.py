"""Measurement noise: seeded signals, bounded by eps on the columns of the measurement that it hits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrl_mj.errors import BadInput, check_bound, unknown

# Those that are signals of their own, and those that look at the closed loop.
SIGNALS = ("none", "uniform", "alternating")
KINDS = (*SIGNALS, "adversarial")


@dataclass(frozen=True)
class Noise:
    """A kind of measurement noise with its bound.

    Attributes:
        kind: "none"; "uniform", drawn anew at every sample from [-bound, bound]; "alternating", +bound,
            -bound, +bound, ... (the paper's); or "adversarial", at each sample the one that leads to
            the greatest danger soon after.
        bound: largest magnitude eps >= 0, in the unit of the measurement.
        everywhere: whether it acts on every column of the measurement, not only on the task's noisy ones.
    """

    kind: str = "none"
    bound: float = 0.0
    everywhere: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise unknown("noise", self.kind, KINDS)
        check_bound(self.bound)

    def acts_on(self, noisy: Sequence[float]) -> np.ndarray:
        """How much of the bound acts on each column (p,) of a measurement: the task's shares, or all."""
        return np.ones(len(noisy)) if self.everywhere else np.array(noisy, dtype=float)

    def sample(self, k: np.ndarray, columns: int, rng: np.random.Generator) -> np.ndarray:
        """A signal of its own for n simulations at their samples k.

        Args:
            k: (n,) int, the number of each simulation's sample.
            columns: p, the number of columns of the measurement.
            rng: the generator that random noise is drawn from.

        Returns:
            (n, p), in the unit of the measurement.

        Raises:
            BadInput: the noise is adversarial, which takes a closed loop to look at.
        """
        if self.kind not in SIGNALS:
            raise BadInput(f"{self.kind} noise needs a controller to act against: use simulate()")
        shape = (len(k), columns)
        if self.kind == "uniform":
            return rng.uniform(-self.bound, self.bound, shape)
        if self.kind == "alternating":
            return np.broadcast_to(np.where(k % 2 == 0, self.bound, -self.bound)[:, None], shape)
        return np.zeros(shape)


@dataclass(frozen=True)
class Recorded:
    """A noise signal that is given sample by sample; after its end there is none.

    Attributes:
        values: (K, n, p) noise of n simulations, in the unit of the measurement.
        bound: the bound that it keeps.
        kind: its name.
    """

    values: np.ndarray
    bound: float
    kind: str = "recorded"
    everywhere: bool = True

    def acts_on(self, noisy: Sequence[float]) -> np.ndarray:
        """As `Noise.acts_on`."""
        return np.ones(len(noisy))

    def sample(self, k: np.ndarray, columns: int, rng: np.random.Generator) -> np.ndarray:
        """As `Noise.sample`."""
        if self.values.shape[1:] != (len(k), columns):
            raise BadInput(
                f"a recorded noise of shape {self.values.shape} does not fit {len(k)} simulations "
                f"with {columns} columns of measurement"
            )
        over = k >= len(self.values)
        values = self.values[np.minimum(k, len(self.values) - 1), np.arange(len(k))]
        return np.where(over[:, None], 0.0, values)
