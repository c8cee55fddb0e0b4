"""The global generators of random numbers, of NumPy, of Python and of torch."""

from __future__ import annotations

import ctypes
import random
import sys
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
    """Returns how far the global generators are, also that of torch where it has been imported."""
    torch = sys.modules.get("torch")
    others = b"" if torch is None else torch.get_rng_state().numpy().tobytes()
    generator: Any = np.random.get_bit_generator()  # type: ignore[attr-defined]
    if not isinstance(generator, np.random.MT19937):  # one that its user has set
        return repr(generator.state), random.getstate(), others
    # A table of 624 words of 4 bytes, and the place in it: `get_state` copies them one by one, fifty times
    # as slowly, and this is asked twice a step.
    return ctypes.string_at(generator.ctypes.state_address, 4 * 625), random.getstate(), others
