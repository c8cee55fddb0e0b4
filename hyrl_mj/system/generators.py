"""The global generators of random numbers, of NumPy and of Python."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


@contextmanager
def kept_generators() -> Iterator[None]:
    """Puts the global generators back after the block, in which resets seed them."""
    numpy_state, python_state = np.random.get_state(), random.getstate()
    try:
        yield
    finally:
        np.random.set_state(numpy_state)
        random.setstate(python_state)


def global_state() -> tuple[Any, ...]:
    """Returns how far the global generators are."""
    numpy_state: Any = np.random.get_state()
    # The place in a table of 624 words, and a word of it: it is filled anew at its end.
    return numpy_state[2], int(numpy_state[1][0]), random.getstate()
