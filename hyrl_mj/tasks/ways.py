"""Which way runs go past an obstacle in the plane."""

from __future__ import annotations

import numpy as np


def passing_side(path: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Returns the side on which runs pass an obstacle, seen along the line from start to nearest point.

    Args:
        path: (K + 1, n, 2) points in the plane over time; a run that ended stays put.
        centre: (2,) of the obstacle.

    Returns:
        (n,) int: 0 on its left, 1 on its right, -1 for runs that only leave it behind.
    """
    nearest = np.linalg.norm(path - centre, axis=2).argmin(axis=0)
    way = path[nearest, np.arange(path.shape[1])] - path[0]
    to_centre = centre - path[0]
    # A run that passes on the left has the obstacle on its right.
    right = way[:, 0] * to_centre[:, 1] - way[:, 1] * to_centre[:, 0] > 0
    return np.where(nearest == 0, -1, right.astype(int))
