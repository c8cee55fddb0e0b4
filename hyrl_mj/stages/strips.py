"""The strips of a part beside M*: how wide one is for the set of the other mode to end there (stage 3).

A state from which nothing is left to decide belongs to every part. If the policy decides late, such states
lie close behind M*, and the set of the mode on the other side would reach over the strip between them. That
mode would then never end, and would itself have to decide where it turns back.
"""

from __future__ import annotations

import numpy as np

from hyrl_mj.tasks import Task


def width(task: Task, eps: float, hop: np.ndarray) -> float:
    """Returns the width that a strip needs, in scaled units.

    The set of the other mode reaches 2 eps and a hop over M*, and eps and a hop over the other edge of the
    strip. Between them a robot must not be able to pass unseen, which takes 2 eps and a hop. All of these act
    along each coordinate, so that they are longer where M* lies across several.

    Args:
        task: gives the noisy coordinates.
        eps: bound of the measurement noise.
        hop: (d,) longest hop in one sample.
    """
    bounds = task.noise_in_chart(eps)
    return float(np.linalg.norm((5 * bounds + 3 * hop) * (bounds > 0) / task.chart.scale))


def across(task: Task, nodes: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """Returns indices (2, k) of those of nodes (N, d) that lie opposite to each other across points of M*.

    Runs from adjacent nodes so close to M* often fail, so pairs are taken across M*.

    Args:
        task: gives the chart.
        nodes: (N, d).
        points: (K, d) of M*.
        reach: how far from a point both may lie, in scaled units.
    """
    chart = task.chart
    # Of many points of M* a few hundred show the same nodes.
    points = points[np.unique(np.linspace(0, len(points) - 1, 500).astype(int))]
    tree = chart.tree(nodes)
    close = tree.query_ball_point(chart.in_box(points), reach)
    first = np.concatenate([np.empty(0, dtype=int), *map(np.asarray, close)]).astype(int)
    over = np.repeat(points, [len(rows) for rows in close], axis=0)
    mirrored = chart.wrap(over + chart.difference(over, nodes[first]))
    return np.unique([first, tree.query(chart.in_box(mirrored))[1]], axis=1)


def around_walls(
    task: Task,
    nodes: np.ndarray,
    neighbours: tuple[np.ndarray, np.ndarray],
    free: np.ndarray,
    rows: np.ndarray,
    farthest: float,
) -> np.ndarray:
    """Returns the length of the shortest way from each node to the nearest of some: (N,) in scaled units.

    It is infinite where no way leads, or only one longer than `farthest`.

    Args:
        task: gives the chart.
        nodes: (N, d).
        neighbours: (k,), (k,) indices of nodes that lie next to each other; ways lead from one to the other.
        free: (N,) bool, the nodes that ways may lead through.
        rows: indices of the nodes where ways end.
        farthest: length beyond which ways are not followed, in scaled units.
    """
    from scipy.sparse import csr_array  # slow to import
    from scipy.sparse.csgraph import dijkstra

    a, b = (ends[free[neighbours[0]] & free[neighbours[1]]] for ends in neighbours)
    lengths = task.chart.distance(nodes[a], nodes[b])
    graph = csr_array((lengths, (a, b)), shape=(len(nodes), len(nodes)))
    return np.asarray(dijkstra(graph, directed=False, indices=rows, min_only=True, limit=farthest))
