"""Which nodes a chart gets: square cells, cells by the noise, or a cloud."""

from __future__ import annotations

import math

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.sets.chart import Chart
from hyrl_mj.sets.clouds import MOST_NODES, Cloud
from hyrl_mj.sets.grids import Grid

# Charts of more dimensions have no nodes.
MOST_DIMENSIONS = 6
# A cloud has this power of the number of cells as nodes, in every dimension.
POWER = 4
# Cells along noisy coordinates are at most this share of the noise bound there.
SHARE = 0.5


def covering(chart: Chart, cells: int, noise: np.ndarray | None = None) -> Grid | Cloud:
    """Returns nodes that cover a chart.

    Up to two dimensions have square cells in scaled units. In three dimensions the same number of nodes is
    shared out so that cells are small along noisy coordinates. More dimensions have a cloud.

    Args:
        chart: the chart.
        cells: cells along the longest side, if they were square; a cloud has `cells`**4 nodes.
        noise: (d,) largest error of a measured chart point; by default none.

    Raises:
        BadInput: the chart has more than six dimensions, or there are too many nodes.
    """
    if chart.dimension > MOST_DIMENSIONS:
        raise BadInput(
            f"a chart of {chart.dimension} coordinates cannot be covered: give at most {MOST_DIMENSIONS}, "
            "those in which the decision is made"
        )
    if chart.dimension > 3:
        if cells**POWER > MOST_NODES:
            raise BadInput(
                f"{cells} cells make a cloud of {cells**POWER:,} nodes: give at most "
                f"{int(MOST_NODES ** (1 / POWER))}, for {MOST_NODES:,} nodes"
            )
        shares = np.zeros(chart.dimension) if noise is None else noise
        most = shares.max(initial=0.0)
        return Cloud.even(chart, max(cells**POWER, 100), shares / (most or 1.0))
    square = Grid.with_cells(chart, cells)
    return square if noise is None or chart.dimension <= 2 else _by_noise(square, noise)


def resolving(chart: Chart, cells: int, points: np.ndarray, noise: np.ndarray) -> Grid | Cloud:
    """Returns nodes that cover a chart and tell the sides of M* apart under noise.

    Half of a cloud's nodes cover the chart, the other half lie beside M*.

    Args:
        chart, cells: as in `covering`.
        points: (N, d) of M*.
        noise: (d,) largest error of a measured chart point; only its proportions count if it is tiny.
    """
    nodes = covering(chart, cells, noise)
    if isinstance(nodes, Grid) or not len(points):
        return nodes
    half = nodes.size // 2
    # Where there is hardly any noise, the cells of the chart say what is near.
    beside, farthest = 0.125, 3.0  # where nodes lie beside M* [noise bounds]
    reach = np.maximum(farthest * noise, nodes.cell * nodes.shares * chart.scale)
    away = float((reach / chart.scale).max()) / farthest
    return Cloud.even(chart, half, nodes.shares).beside(points, half, reach, beside * away)


def enough_cells(chart: Chart, noise: np.ndarray, least: int, most: int) -> int:
    """Returns the least number of cells for `covering` that are short enough for the noise (d,).

    They are at most half of the noise bound long on each noisy coordinate. There are at least `least` and at
    most `most` cells.
    """
    noisy = noise > 0
    for cells in range(least, most):
        nodes = covering(chart, cells, noise)
        if isinstance(nodes, Cloud):
            return least
        if (nodes.spacing[noisy] <= SHARE * noise[noisy] * (1 + 1e-9)).all():
            return cells
    return most


def coarseness(chart: Chart, cells: int, noise: np.ndarray) -> str | None:
    """Returns a sentence if cells of the sets are longer than the noise (d,) on some coordinate, or None."""
    nodes = covering(chart, cells, noise)
    if isinstance(nodes, Cloud):  # close together where it matters
        return None
    coarse = np.flatnonzero((noise > 0) & (nodes.spacing > noise * (1 + 1e-9)))
    if not len(coarse):
        return None
    where = " and ".join(
        f"{noise[i]:.3g} {chart.units[i]} of noise on {chart.names[i]} (cells of {nodes.spacing[i]:.3g})"
        for i in coarse
    )
    return (
        f"the cells of the sets are too long for {where}: the overlap may be up to a cell narrower or wider "
        f"than the noise needs; give more than {cells} cells (--set cells=...), or a larger eps"
    )


def _by_noise(square: Grid, noise: np.ndarray) -> Grid:
    """Returns a grid of about as many nodes as a square one, with smaller cells along noisy coordinates."""
    chart, most = square.chart, square.size
    noisy = noise > 0
    wanted = np.where(noisy, np.minimum(SHARE * noise, square.spacing), square.spacing)
    if not noisy.any() or noisy.all() or (wanted >= square.spacing).all():
        return square
    free = ~noisy

    def counts(coarser: float, finer: float) -> np.ndarray:
        """Returns the counts (d,) with free cells `coarser` times, noisy ones 1 / `finer` times as long."""
        side = np.where(free, square.spacing * coarser, wanted * finer)
        number = np.ceil(chart.sides / side - 1e-9).astype(int)
        return np.maximum(number, 2) + ~np.array(chart.periodic)

    longest = float((chart.sides / square.spacing)[free].max())
    coarsest = max(longest / 16, 1.0)  # at least so many cells along the longest side without noise
    for coarser in np.geomspace(1.0, coarsest, 50):
        if math.prod(counts(coarser, 1.0)) <= most:
            return Grid(chart, tuple(int(n) for n in counts(coarser, 1.0)))
    for finer in np.geomspace(1.0, 100.0, 500):
        if math.prod(counts(coarsest, finer)) <= most:
            return Grid(chart, tuple(int(n) for n in counts(coarsest, finer)))
    return square
