"""Activation functions between the layers of a network, in NumPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def relu(x: np.ndarray) -> np.ndarray:
    """max(x, 0), of any shape."""
    return np.maximum(x, 0)


def elu(x: np.ndarray) -> np.ndarray:
    """x, below 0 exp(x) - 1."""
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def leaky_relu(x: np.ndarray) -> np.ndarray:
    """x, below 0 a hundredth of it."""
    return np.where(x > 0, x, 0.01 * x)


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), in a form that never overflows."""
    return 0.5 * (1 + np.tanh(0.5 * x))


def silu(x: np.ndarray) -> np.ndarray:
    """x sigmoid(x)."""
    return x * sigmoid(x)


def gelu(x: np.ndarray) -> np.ndarray:
    """x times the standard normal distribution function of x, exact as torch has it by default."""
    from scipy.special import erf  # slow to import, and seldom needed

    return np.asarray(0.5 * x * (1 + erf(x / np.sqrt(np.float32(2)))))


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": relu,
    "tanh": np.tanh,
    "elu": elu,
    "leaky_relu": leaky_relu,
    "silu": silu,
    "gelu": gelu,
    "sigmoid": sigmoid,
}
# What the classes in `torch.nn` call them.
TORCH_NAMES = {
    "relu": "ReLU",
    "tanh": "Tanh",
    "elu": "ELU",
    "leaky_relu": "LeakyReLU",
    "silu": "SiLU",
    "gelu": "GELU",
    "sigmoid": "Sigmoid",
}
