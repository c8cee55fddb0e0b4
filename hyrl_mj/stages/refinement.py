"""Fine grids of slow plants: some nodes are simulated, and where these agree the others take after them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hyrl_mj.sets import Grid, Nodes, distance_to
from hyrl_mj.tasks import Task

# Along a noisy coordinate one in so many nodes is simulated.
THIN = 4
# Node indices (k,) -> what is known of these nodes (k, c).
Tell = Callable[[np.ndarray], np.ndarray]


def strides(task: Task, nodes: Nodes) -> np.ndarray:
    """Returns which nodes along each coordinate are simulated: one in so many (d,).

    Cells along noisy coordinates are short to tell apart what noise does. A plant with dynamics is too slow
    to be simulated from all of these nodes.
    """
    chart = nodes.chart
    fine = isinstance(nodes, Grid) and chart.dimension >= 3 and not task.kinematic
    thin = (task.noise_in_chart(1.0) > 0) & ~np.array(chart.periodic)
    return np.where(thin & fine, THIN, 1)


def thinned(task: Task, nodes: Nodes) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Returns the indices (k,) of the nodes that are simulated, and the places of neighbours in them."""
    stride = strides(task, nodes)
    if not isinstance(nodes, Grid) or (stride == 1).all():
        return np.arange(nodes.size), nodes.neighbours()
    axes = [np.unique([*range(0, n, k), n - 1]) for n, k in zip(nodes.counts, stride, strict=True)]
    rows = np.ravel_multi_index(np.ix_(*axes), nodes.counts).ravel()
    return rows, Grid(nodes.chart, tuple(map(len, axes))).neighbours()


def refined(
    task: Task,
    nodes: Nodes,
    wanted: np.ndarray,
    points: np.ndarray,
    reach: float,
    tell: Tell,
    agree: int,
) -> np.ndarray:
    """Returns what is known of nodes (N, c), 0 where it is not wanted; few of them are asked for.

    A node between simulated ones that agree takes after the nearest of them; so does one far from M*. All
    others are asked for themselves.

    Args:
        task, nodes: the robot, and the nodes of its chart.
        wanted: (N,) bool.
        points: (K, d) of M*.
        reach: distance from M* beyond which a node is far, in scaled units.
        tell: returns what is known of nodes; asked twice, with the nodes that are simulated first.
        agree: the first so many columns have to agree.
    """
    stride = strides(task, nodes)
    if not isinstance(nodes, Grid) or (stride == 1).all():
        return _filled(nodes.size, np.flatnonzero(wanted), tell)
    rows = np.flatnonzero(wanted)
    index = np.stack(np.unravel_index(rows, nodes.counts))
    below = index // stride[:, None] * stride[:, None]
    last = np.array(nodes.counts)[:, None] - 1
    above = np.minimum(np.where(below < index, below + stride[:, None], below), last)
    corners = np.indices((2,) * len(nodes.counts)).reshape(len(nodes.counts), -1, 1)
    at = np.ravel_multi_index(
        tuple(np.where(corners, above[:, None], below[:, None])), nodes.counts
    )
    known = _filled(nodes.size, np.unique(at), tell)
    differ = (known[at, :agree] != known[at[0], :agree]).any(axis=(0, 2))
    nearest = np.where(index - below <= above - index, below, above)
    known[rows] = known[np.ravel_multi_index(tuple(nearest), nodes.counts)]
    asked = rows[differ]
    asked = asked[distance_to(task.chart, points, nodes.nodes[asked]) <= reach]
    if len(asked):
        known[asked] = tell(asked)
    return known


def _filled(size: int, rows: np.ndarray, tell: Tell) -> np.ndarray:
    """Returns what is told of nodes `rows` (k,) in an array (size, c) of zeros."""
    told = tell(rows)
    known = np.zeros((size, told.shape[1]))
    known[rows] = told
    return known
