"""Where on M* which modes meet, and how much room there is for noise."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from hyrl_mj.sets import Chart, Cloud, GridSet, Nodes

# The room is found to this share of what the noise needs.
STEP = 0.02


def meet(inside: np.ndarray) -> np.ndarray:
    """Returns which parts meet at points of M*: (N, Q, Q) bool, symmetric.

    Two parts meet at a point if each holds a state around it that the other does not hold. Parts that are the
    same there, or of which one holds all that the other does, leave nothing to decide between them.

    Args:
        inside: (N, Q, k) bool, as `around` returns it.
    """
    alone = [(inside[:, [i]] & ~inside).any(axis=2) for i in range(inside.shape[1])]
    return np.stack(alone, axis=1) & np.stack(alone, axis=2)


def around(points: np.ndarray, parts: Sequence[GridSet]) -> np.ndarray:
    """Returns whether parts hold the states around points (N, d) of M*: (N, Q, k) bool."""
    z = (points[:, None] + _steps(parts[0].grid)).reshape(-1, points.shape[1])
    return np.stack([part.contains(z).reshape(len(points), -1) for part in parts], axis=1)


def _steps(grid: Nodes) -> np.ndarray:
    """Returns the steps (k, d) from a point to those around it: of a cloud, along each noisy coordinate."""
    d, cells = grid.chart.dimension, 1.5
    if isinstance(grid, Cloud):
        along = np.diag(cells * grid.cell * grid.shares * grid.chart.scale)
        return np.vstack([np.zeros(d), along, -along])
    return cells * grid.spacing * np.array(list(product((-1, 0, 1), repeat=d)))


def rooms(
    points: np.ndarray, grid: Nodes, winning: Sequence[np.ndarray], eps: np.ndarray
) -> np.ndarray:
    """Returns the room (N, Q) of each mode around points (N, d) of M*, as a share of 2 eps; at most 1.

    The room is the distance to either side along the noisy coordinates over which the mode wins. It does not
    end where no mode wins, as in a wall: there is nothing to switch to.

    Args:
        points: of M*.
        grid: the nodes.
        winning: (M,) bool over the nodes for each mode, from where it wins.
        eps: (d,) noise bound on each coordinate.
    """
    shares = np.arange(0.0, 1.0 + 1e-9, STEP)
    room = np.ones((len(points), len(winning)))
    nobody = ~np.any(winning, axis=0)
    directions = np.vstack([np.diag(2 * eps), -np.diag(2 * eps)])
    for direction in directions[directions.any(axis=1)]:
        line = grid.nearest((points[:, None] + shares[:, None] * direction).reshape(-1, len(eps)))
        for k, wins in enumerate(winning):
            succeeds = (wins | nobody)[line].reshape(len(points), -1)
            first_loss = np.where(succeeds.all(axis=1), len(shares), succeeds.argmin(axis=1))
            room[:, k] = np.minimum(room[:, k], np.maximum(first_loss - 1, 0) * STEP)
    return room


def least_room(
    points: np.ndarray, parts: Sequence[GridSet], winning: Sequence[np.ndarray], eps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns where modes meet of which one wins, and the two that have the least room there.

    Args:
        points: (N, d) of M*.
        parts: M_i of each mode.
        winning: as in `rooms`.
        eps: (d,) noise bound on each coordinate.

    Returns:
        The rows (K,) of the points, the indices (K, 2) of the two modes, and the lesser room (K,) of them, as
        a share of 2 eps.
    """
    if not len(points) or len(parts) < 2:
        return np.empty(0, dtype=int), np.empty((0, 2), dtype=int), np.empty(0)
    grid = parts[0].grid
    wins = np.stack([wins[grid.nearest(points)] for wins in winning], axis=1)
    inside = around(points, parts)
    pairs = meet(inside) & (wins[:, :, None] | wins[:, None])
    rows = np.flatnonzero(pairs.any(axis=(1, 2)))
    if not len(rows):
        return rows, np.empty((0, 2), dtype=int), np.empty(0)
    room = rooms(points[rows], grid, winning, eps)
    best = room.copy()
    # Modes whose parts are the same around a point are one there, with the room of the best of them.
    inside = inside[rows]
    for i in range(len(parts)):
        same = (inside == inside[:, [i]]).all(axis=2)
        best[:, i] = np.where(same, room, 0.0).max(axis=1)
    of_pair = np.where(pairs[rows], np.minimum(best[:, :, None], best[:, None]), np.inf)
    # Of pairs with the same room that whose parts have most in common, with its modes in order.
    masks = np.stack([part.mask for part in parts])
    of_pair -= STEP / 2 * (masks[:, None] == masks).mean(axis=2)
    least = of_pair.reshape(-1, len(parts) ** 2).argmin(axis=1)
    pair = np.stack(np.divmod(least, len(parts)), axis=1)
    return rows, pair, np.take_along_axis(best, pair, axis=1).min(axis=1)


def where(chart: Chart, points: np.ndarray, narrow: np.ndarray) -> str:
    """Returns the place of the narrow (N,) ones of points (N, d): "from x = 0.4 m on"."""
    if narrow.all():
        return f"at all of {ranges(chart, points, 1e-3)}"
    axis = int((np.ptp(points, axis=0) / chart.scale).argmax())
    along, name, unit = points[:, axis], chart.names[axis], chart.units[axis]
    first, last = along[narrow].min(), along[narrow].max()
    if not chart.periodic[axis] and (narrow == (along >= first)).all():
        return f"from {name} = {first:.3g} {unit} on"
    if not chart.periodic[axis] and (narrow == (along <= last)).all():
        return f"up to {name} = {last:.3g} {unit}"
    return f"in places at {ranges(chart, points[narrow], 1e-3)}"


def ranges(chart: Chart, points: np.ndarray, resolution: float) -> str:
    """Returns the range of points (N, d) along each coordinate: "x 0 to 0.45 m, y 0.1 m".

    That of a periodic coordinate is the shortest one: it may end beyond the chart.
    """
    points = points.copy()
    for i in np.flatnonzero(chart.periodic):
        turn, along = chart.sides[i], np.sort(points[:, i])
        gaps = np.diff(along, append=along[0] + turn)
        if gaps.max() > gaps[-1] + resolution:
            begin = along[gaps.argmax() + 1]
            points[:, i] = begin + (points[:, i] - begin) % turn
    ends = zip(chart.names, chart.units, points.min(axis=0), points.max(axis=0), strict=True)
    fine = resolution / 100 or 1e-12  # what is hardly off 0 is 0
    return ", ".join(
        f"{name} {a:.4g} to {b:.4g} {unit}"
        if b - a > resolution
        else f"{name} {round((a + b) / 2 / fine) * fine + 0.0:.4g} {unit}"
        for name, unit, a, b in ends
    )
