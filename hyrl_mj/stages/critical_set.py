"""Stage 2: the critical set M*, states from which nearby starts evolve in opposite directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hyrl_mj.artifacts import Saved
from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import LoopSettings, closed_loop, ways
from hyrl_mj.tasks import SEARCHES, Task

# Samples that the two ends of a rod run: long enough to part, too short to come round an obstacle.
SAMPLES = 5
# The ends part when they grow apart by this share of the way that both went: displacements of equal
# length that enclose 50 degrees do so by sin(25 degrees).
PARTING = 0.42
# Points belong to one piece if they are closer than this many grid cells.
LINK = 2.5


@dataclass(frozen=True)
class CriticalSet(Saved):
    """The critical set M*: its points and its connected pieces.

    Attributes:
        points: (N, d) chart points.
        component: (N,) which connected piece of M* each belongs to, from 0.
        resolution: length of the last rods, in chart units: M* is known to half of it.
        spacing: distance between the grid points that the search started from, in chart units.

    Raises:
        BadInput: the number of points and of components differ.
    """

    KIND: ClassVar[str] = "critical set"

    points: np.ndarray
    component: np.ndarray
    resolution: float
    spacing: float

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.component.shape != (len(self.points),):
            raise BadInput(
                f"points of shape {self.points.shape} and components of shape {self.component.shape} make "
                "no critical set: give points (N, d) and one component (N,) for each"
            )

    def __repr__(self) -> str:
        return f"CriticalSet({self._counts}, resolution {self.resolution:.3g})"

    @property
    def _counts(self) -> str:
        """How many pieces and points there are."""
        pieces = "1 piece" if self.pieces == 1 else f"{self.pieces} pieces"
        points = "1 point" if len(self.points) == 1 else f"{len(self.points)} points"
        return f"{pieces}, {points}"

    @property
    def pieces(self) -> int:
        """The number of connected pieces."""
        return int(self.component.max()) + 1 if len(self.component) else 0

    def sentence(self, task: Task) -> str:
        """Returns a one-line description."""
        if not len(self.points):
            return (
                f"no critical set found at this resolution (grid {self.spacing:.3g}, pairs down to "
                f"{self.resolution:.3g} {task.chart.units[0]})"
            )
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        ranges = ", ".join(
            f"{name} {a:.4g} to {b:.4g} {unit}"
            if b - a > self.resolution
            else f"{name} {(a + b) / 2:.4g} {unit}"
            for name, unit, a, b in zip(task.chart.names, task.chart.units, low, high, strict=True)
        )
        return f"critical set of {self._counts}, {ranges}"


def find_critical_set(
    task: Task, policy: Policy, cells: int, resolution: float, method: str = "rods"
) -> CriticalSet:
    """Searches for the critical set M*.

    With `rods` (paper, Step 2), two starts a small distance apart along one chart axis: both ends of a
    rod run the closed loop for a few samples. If they part, the rod is cut in two halves, and so on down
    to the resolution; the centres of the last rods that part are critical if the closed loop goes
    different ways from their ends for good.

    By `outcome`, neighbouring nodes of a grid from which the closed loop goes different ways: the way
    from the middle between them tells in which half to look on, down to the resolution. That takes
    whole runs, and finds a decision that shows late: of a plant with inertia, say.

    All runs of a level are one batch.

    Args:
        task: gives chart, plant, and the direction of a run.
        policy: closes the loop.
        cells: grid points along the longest side of the chart from which the search starts.
        resolution: length of the last rods, as a share of the first.
        method: "rods" or "outcome".

    Returns:
        The critical set; it may be empty.

    Raises:
        BadInput: an unknown method.
    """
    if method not in SEARCHES:
        raise unknown("method", method, SEARCHES)
    grid, d = Grid.with_cells(task.chart, cells), task.chart.dimension
    if method == "rods":
        centres = _by_rods(task, policy, grid, resolution)
    else:
        centres = critical_points(
            task, policy, grid.nodes, grid.neighbours(), grid.cell, resolution
        )
    points = np.unique(task.chart.wrap(centres), axis=0) if len(centres) else np.empty((0, d))
    return CriticalSet(
        points, _pieces(task, points, LINK * grid.cell), resolution * grid.cell, grid.cell
    )


def _by_rods(task: Task, policy: Policy, grid: Grid, resolution: float) -> np.ndarray:
    """Returns the centres (N, d) of the last rods that part."""
    d = task.chart.dimension
    centre = np.repeat(grid.nodes, d, axis=0)
    axis = np.tile(np.arange(d), len(grid.nodes))
    length = grid.spacing[axis]
    while True:
        parts = _part(task, policy, *_ends(task, centre, axis, length))
        centre, axis, length = centre[parts], axis[parts], length[parts]
        if not len(centre) or length.max() <= resolution * grid.cell:
            break
        offset = np.zeros((len(centre), d))
        offset[np.arange(len(centre)), axis] = length / 4
        centre = np.vstack([centre - offset, centre + offset])
        axis, length = np.tile(axis, 2), np.tile(length / 2, 2)
    return centre[_differ(task, policy, *_ends(task, centre, axis, length))]


def critical_points(
    task: Task,
    policy: Policy,
    nodes: np.ndarray,
    neighbours: tuple[np.ndarray, np.ndarray],
    cell: float,
    resolution: float,
) -> np.ndarray:
    """Searches by outcome: returns middles (N, d) between close starts whose runs go different ways.

    Args:
        task, policy, resolution: as in `find_critical_set`.
        nodes: (n, d) starts.
        neighbours: (k,), (k,) pairs of starts that lie next to each other.
        cell: the greatest distance between such two.
    """

    def way_from(z: np.ndarray) -> np.ndarray:
        if not len(z):
            return np.zeros(0, dtype=int)
        return ways(task, closed_loop(task, PolicyController(policy), z))

    at_node = way_from(nodes)
    first, second = neighbours
    pair = (at_node[first] != at_node[second]) & (at_node[first] >= 0) & (at_node[second] >= 0)
    first, second = first[pair], second[pair]
    a, way_a, way_b = nodes[first], at_node[first], at_node[second]
    b = a + task.chart.difference(nodes[second], a)
    length = cell
    while len(a) and length > resolution * cell * (1 + 1e-9):
        middle = (a + b) / 2
        way = way_from(middle)
        near_a = (way == way_a)[:, None]
        a, b = np.where(near_a, middle, a), np.where(near_a, b, middle)
        way_b = np.where(near_a[:, 0], way_b, way)
        # In the middle there may be nothing to decide.
        going, length = way >= 0, length / 2
        a, b, way_a, way_b = a[going], b[going], way_a[going], way_b[going]
    return ((a + b) / 2)[_go_apart(task, policy, a, b, cell)]


def _go_apart(task: Task, policy: Policy, a: np.ndarray, b: np.ndarray, far: float) -> np.ndarray:
    """Returns whether runs from a and b (n, d) get as far as that apart while both last: (n,) bool.

    Two runs that a pillar stops on either side of its middle go nowhere different, and neither do two
    that dither around the same point, a sample to and a sample fro.
    """
    n = len(a)
    if not n:
        return np.zeros(0, dtype=bool)
    rollout = closed_loop(task, PolicyController(policy), np.vstack([a, b]))
    moved = rollout.path - rollout.path[0]
    apart = np.linalg.norm(moved[:, :n] - moved[:, n:], axis=2)
    last = np.minimum(rollout.length[:n], rollout.length[n:])
    apart[np.arange(len(apart))[:, None] > last] = 0.0
    hop = np.linalg.norm(np.diff(rollout.path, axis=0), axis=2).max(axis=0)
    return np.asarray(apart.max(axis=0) > far + hop[:n] + hop[n:])


def _ends(
    task: Task, centre: np.ndarray, axis: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the two ends (n, d), (n, d) of rods, kept inside the chart."""
    offset = np.zeros_like(centre)
    # A hair longer than the grid: halves of a rod overlap, and M* cannot fall between them.
    offset[np.arange(len(centre)), axis] = length / 2 * (1 + 1e-9)
    low = np.where(task.chart.periodic, -np.inf, task.chart.low)
    high = np.where(task.chart.periodic, np.inf, task.chart.high)
    return np.clip(centre - offset, low, high), np.clip(centre + offset, low, high)


def _part(task: Task, policy: Policy, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns whether the runs from a and b (n, d) part: (n,) bool."""
    n = len(a)
    loop, settings = PolicyController(policy), LoopSettings(steps=SAMPLES)
    rollout = closed_loop(task, loop, np.vstack([a, b]), settings=settings)
    # A run that ends early, in a crash say, is compared with the other where both still ran.
    last = np.minimum(rollout.length[:n], rollout.length[n:])
    end = rollout.path[np.tile(last, 2), np.arange(2 * n)]
    moved = end - rollout.path[0]
    way = np.linalg.norm(moved[:n], axis=1) + np.linalg.norm(moved[n:], axis=1)
    rod = b - a
    apart = np.linalg.norm(rod + moved[n:] - moved[:n], axis=1) - np.linalg.norm(rod, axis=1)
    return apart > np.maximum(PARTING * way, 1e-9)


def _differ(task: Task, policy: Policy, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns whether the runs from a and b (n, d) go different ways in the end: (n,) bool."""
    n = len(a)
    if not n:
        return np.zeros(0, dtype=bool)
    rollout = closed_loop(task, PolicyController(policy), np.vstack([a, b]))
    way = ways(task, rollout)
    return (way[:n] != way[n:]) & (way[:n] >= 0) & (way[n:] >= 0)


def _pieces(task: Task, points: np.ndarray, reach: float) -> np.ndarray:
    """Numbers the pieces of a point set that are farther apart than `reach`: (N,) int."""
    from scipy.sparse.csgraph import connected_components  # slow to import

    if not len(points):
        return np.zeros(0, dtype=int)
    tree = task.chart.tree(points)
    near = tree.sparse_distance_matrix(tree, reach)
    return connected_components(near, directed=False)[1]


def check_points(task: Task, points: np.ndarray) -> np.ndarray:
    """Returns points of M* (N, d) as an array of numbers.

    Raises:
        BadInput: they are a `CriticalSet`, or do not fit the chart.
    """
    if isinstance(points, CriticalSet):
        raise BadInput(f"{points!r} cannot be used as points of M*: give its points (N, d)")
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != task.chart.dimension:
        raise BadInput(
            f"points of shape {points.shape} cannot lie on M* in the chart of {task.name}: give "
            f"(N, {task.chart.dimension}), none as (0, {task.chart.dimension})"
        )
    return points


def distance_to(task: Task, points: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Returns the distance (n,) of chart points z (n, d) to M*, in chart units; infinite if M* is empty.

    Args:
        task: gives the chart.
        points: (N, d) of M*.
        z: (n, d) chart points.
    """
    if not len(points):
        return np.full(len(z), np.inf)
    return task.chart.tree(points).query(task.chart.in_box(z))[0]
