"""The modes of a field: the logic state (q, lambda) in one number."""

from __future__ import annotations

import numpy as np

# Modes of a post: two sides, with two senses of turning each.
MODES_OF_POST = 4


def encoded(focus: np.ndarray, side: np.ndarray, sense: np.ndarray) -> np.ndarray:
    """Returns the modes (n,) of posts in focus (n,), sides (n,) and senses of turning (n,)."""
    return MODES_OF_POST * focus + 2 * side + np.where(sense < 0, 1, 0)


def decoded(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns focus (n,), side (n,) and sense of turning (n,) of modes (n,); -1, -1 and 0 for no mode."""
    focus = np.floor(q / MODES_OF_POST)
    rest = q - MODES_OF_POST * focus
    side = np.floor(rest / 2)
    none = q < 0
    side, sense = np.where(none, -1, side), np.where(none, 0, 1 - 2 * (rest - 2 * side))
    return focus.astype(np.int64), side.astype(np.int64), sense.astype(np.int64)
