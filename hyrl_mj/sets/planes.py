"""Planes through scattered points, which stand for surfaces and edges in many dimensions."""

from __future__ import annotations

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.sets.chart import Chart

# The weight of the size of a plane's normal in its fit.
RIDGE = 1e-4


def batches(n: int) -> list[slice]:
    """Returns slices that cover n rows, so short that what is worked on at once fits into the memory."""
    size = 4_096
    return [slice(first, first + size) for first in range(0, n, size)]


def closeness(distance: np.ndarray) -> np.ndarray:
    """Returns weights (n, k) of points at sorted distances (n, k): 1 near by, almost 0 for the farthest."""
    return np.asarray((1 - (distance / (1.05 * distance[:, -1:] + 1e-300)) ** 2) ** 2)


def slopes(x: np.ndarray, rises: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Returns the slopes (n, d) that fit rises (n, k) over offsets x (n, k, d) best, by weights (n, k)."""
    weighted = np.swapaxes(x * weight[..., None], 1, 2)
    matrix = weighted @ x
    ridge = RIDGE * np.trace(matrix, axis1=1, axis2=2)[:, None, None] + 1e-300
    found = np.linalg.solve(matrix + ridge * np.eye(x.shape[2]), weighted @ rises[..., None])
    return np.asarray(found[..., 0])


def separating(
    x: np.ndarray, sign: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Separates points of sign -1 from points of sign +1 by the planes with the widest margin.

    These are support vector machines with squared hinge loss, solved by Newton's method.

    Args:
        x: (n, k, d) offsets of the points from n origins, of the order of 1.
        sign: (n, k) their signs.
        weight: (n, k) how much each point counts.

    Returns:
        The signed distances (n,) of the origins from the planes, and the unit normals (n, d).
    """
    x = np.concatenate([x, np.ones((*sign.shape, 1))], axis=2)
    size = np.full(x.shape[2], RIDGE)
    size[-1] = 1e-9  # where the plane lies costs nothing
    theta, active = np.zeros((len(x), x.shape[2])), np.ones(sign.shape, dtype=bool)
    for _ in range(12):
        used = np.swapaxes(x * (weight * active)[..., None], 1, 2)
        theta = np.linalg.solve(used @ x + np.diag(size), used @ sign[..., None])[..., 0]
        active = sign * (x @ theta[..., None])[..., 0] < 1
    length = np.maximum(np.linalg.norm(theta[:, :-1], axis=1), 1e-300)
    return theta[:, -1] / length, theta[:, :-1] / length[:, None]


def check_points(chart: Chart, points: np.ndarray, owner: str) -> np.ndarray:
    """Returns points (N, d) of M* as an array of floats; raises `BadInput` if they do not fit a chart."""
    try:
        points = np.asarray(points, dtype=float)
    except (TypeError, ValueError):
        raise BadInput(
            f"{points!r:.80} cannot be used as points of M*: give its points (N, d)"
        ) from None
    if points.ndim != 2 or points.shape[1] != chart.dimension:
        raise BadInput(
            f"points of shape {points.shape} cannot lie on M* in the chart of {owner}: give "
            f"(N, {chart.dimension}), none as (0, {chart.dimension})"
        )
    return points


def distance_to(chart: Chart, points: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Returns the distance (n,) of z (n, d) to points (N, d) of M*, in scaled units; inf without points.

    In charts of more than three dimensions M* is the surface through its points.
    """
    if not len(points):
        return np.full(len(z), np.inf)
    if chart.dimension > 3:
        return _surface_distance(chart, points, z)
    return chart.nearest(points, z)[0]


def _surface_distance(chart: Chart, points: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Returns the distance (n,) of z (n, d) from the surface through points (N, d), in scaled units.

    Points of a surface in many dimensions lie far apart: the nearest ones are joined by a plane. Beyond the
    rim of the surface the distance is that from the nearest point.
    """
    count = min(2 * chart.dimension, len(points))
    tree, found = chart.tree(points), np.empty(len(z))
    for part in batches(len(z)):
        distance, index = tree.query(chart.in_box(z[part]), count)
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        if count <= chart.dimension:
            found[part] = distance[:, 0]
            continue
        x = chart.difference(points[index], z[part, None]) / chart.scale
        middle = x.mean(axis=1)
        spread = x - middle[:, None]
        _, axes = np.linalg.eigh(np.swapaxes(spread, 1, 2) @ spread)
        across = np.abs((middle * axes[:, :, 0]).sum(axis=1))
        aside = np.sqrt(np.maximum((middle**2).sum(axis=1) - across**2, 0))
        width = np.sqrt((spread**2).sum(axis=2).max(axis=1))
        found[part] = np.where(aside <= width, np.minimum(across, distance[:, 0]), distance[:, 0])
    return found
