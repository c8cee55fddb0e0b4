"""Stage 2 (paper, Step 2): the critical set M*, from which close starts evolve in opposite directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hyrl_mj.errors import LARGEST_NUMBER, BadInput, counted, unknown
from hyrl_mj.files.artifacts import Saved
from hyrl_mj.learning import WaySettings
from hyrl_mj.policies import Policy
from hyrl_mj.sets import Nodes, covering
from hyrl_mj.simulation import policy_runs, way_runs
from hyrl_mj.stages.meeting import ranges
from hyrl_mj.stages.search import critical_points
from hyrl_mj.tasks import SEARCHES, Task


@dataclass(frozen=True)
class CriticalSet(Saved):
    """The critical set M*.

    Attributes:
        points: (N, d) chart points.
        component: (N,) index of the connected piece of M* that each point belongs to.
        resolution: length of the shortest rods, in scaled units; M* is known to half of it.
        spacing: distance between the grid points that the search started from, in scaled units.
    """

    KIND: ClassVar[str] = "critical set"

    points: np.ndarray
    component: np.ndarray
    resolution: float
    spacing: float

    def __post_init__(self) -> None:
        fits = self.points.ndim == 2 and self.component.shape == (len(self.points),)
        if not fits or self.points.dtype.kind not in "if" or self.component.dtype.kind != "i":
            raise BadInput(
                f"points of shape {self.points.shape} and components of shape {self.component.shape} make "
                "no critical set: give points (N, d) and one component (N,) for each"
            )
        numbers = (self.points, self.resolution, self.spacing)
        if not all((np.abs(number) <= LARGEST_NUMBER).all() for number in numbers):
            raise BadInput("numbers of M* that are not finite make no critical set")

    def __repr__(self) -> str:
        return f"CriticalSet({self._counts}, resolution {self.resolution:.3g})"

    @property
    def _counts(self) -> str:
        counts = {"piece": self.pieces, "point": len(self.points)}
        return ", ".join(counted(n, name) for name, n in counts.items())

    @property
    def pieces(self) -> int:
        """The number of connected pieces."""
        return int(self.component.max(initial=-1)) + 1

    def sentence(self, task: Task) -> str:
        """Returns a one-line description."""
        if not len(self.points):
            return (
                f"no critical set found at this resolution (grid {self.spacing:.3g}, pairs down to "
                f"{self.resolution:.3g} {task.chart.unit})"
            )
        return f"critical set of {self._counts}, {ranges(task.chart, self.points, self.resolution)}"


def find_critical_set(
    task: Task,
    policy: Policy,
    cells: int,
    resolution: float,
    method: str = "rods",
    eps: float = 0.0,
    settings: WaySettings = WaySettings(),
) -> CriticalSet:
    """Searches for the critical set M*: property (*) and equation (8) of the paper.

    Method `rods` (paper, Step 2) simulates a few samples from both ends of rods along each chart axis. If
    the two runs part, it halves the rod, down to the resolution. The centres of the shortest rods whose
    ends the closed loop finally leaves in different ways are critical.

    Method `outcome` simulates whole runs from neighbouring nodes of a grid. Where they go different ways,
    it bisects between the two nodes by the way of the middle. It also finds a decision that shows late, as
    that of a plant with inertia.

    Args:
        task: gives chart, plant, and the way of a run.
        policy: closes the loop.
        cells: grid points along the longest side of the chart from which the search starts.
        resolution: length of the shortest rods, as a share of the first.
        method: "rods" or "outcome".
        eps: bound of the measurement noise; "outcome" finds M* across failures that are a few times
            as wide.
        settings: when runs part, and what is one piece of M*.

    Returns:
        The critical set; it may be empty.

    Raises:
        BadInput: an unknown method.
    """
    if method not in SEARCHES:
        raise unknown("method", method, SEARCHES)
    grid = covering(task.chart, cells)
    if method == "rods":
        centres = _by_rods(task, policy, grid, resolution, settings)
    else:
        pairs = grid.neighbours()
        centres = critical_points(
            task, policy, grid.nodes, pairs, grid.cell, resolution, eps, settings
        )
    points = np.unique(task.chart.wrap(centres), axis=0)
    component = _pieces(task, points, settings.link * grid.cell)
    return CriticalSet(points, component, resolution * grid.cell, grid.cell)


def _by_rods(
    task: Task, policy: Policy, grid: Nodes, resolution: float, settings: WaySettings
) -> np.ndarray:
    """Returns the centres (N, d) of the shortest rods that part."""
    d = task.chart.dimension
    centre = np.repeat(grid.nodes, d, axis=0)
    axis = np.tile(np.arange(d), len(grid.nodes))
    length = grid.spacing[axis]
    while True:
        a, b = _ends(task, centre, axis, length)
        part = _part(task, policy, a, b, settings)
        centre, axis, length = centre[part], axis[part], length[part]
        if not len(centre) or length.max() <= resolution * grid.cell:
            break
        offset = np.eye(d)[axis] * length[:, None] / 4
        centre = np.vstack([centre - offset, centre + offset])
        axis, length = np.tile(axis, 2), np.tile(length / 2, 2)
    if not len(centre):
        return centre
    ends = _ends(task, centre, axis, length).reshape(-1, d)
    runs, _ = way_runs(task, policy, ends)
    first, second = np.split(np.arange(2 * len(centre)), 2)
    works = runs.usable
    return centre[runs[first].differ(runs[second]) & works[first] & works[second]]


def _ends(task: Task, centre: np.ndarray, axis: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Returns the two ends (2, n, d) of rods, kept inside the chart."""
    chart = task.chart
    # Slightly longer than the grid's spacing: the halves of a rod overlap, so M* cannot lie between them.
    offset = np.eye(chart.dimension)[axis] * (length / 2 * (1 + 1e-9))[:, None]
    ends = np.stack([centre - offset, centre + offset])
    return np.where(chart.periodic, ends, np.clip(ends, chart.low, chart.high))


def _part(
    task: Task, policy: Policy, a: np.ndarray, b: np.ndarray, settings: WaySettings
) -> np.ndarray:
    """Returns whether the runs from a and b (n, d) part within a few samples: (n,) bool."""
    n = len(a)
    rollout = policy_runs(task, policy, np.vstack([a, b]), steps=settings.samples)
    # If one run ends early, by a crash for instance, the two are compared at its last sample.
    last = np.minimum(rollout.length[:n], rollout.length[n:])
    moved = rollout.path[np.tile(last, 2), np.arange(2 * n)] - rollout.path[0]
    moved = moved / task.chart.scale
    displacement = np.linalg.norm(moved[:n], axis=1) + np.linalg.norm(moved[n:], axis=1)
    rod = (b - a) / task.chart.scale
    growth = np.linalg.norm(rod + moved[n:] - moved[:n], axis=1) - np.linalg.norm(rod, axis=1)
    return growth > np.maximum(settings.parting * displacement, 1e-9)


def _pieces(task: Task, points: np.ndarray, reach: float) -> np.ndarray:
    """Numbers the pieces of a point set that are farther apart than `reach`: (N,) int."""
    from scipy.sparse.csgraph import connected_components  # slow to import

    if not len(points):
        return np.zeros(0, dtype=int)
    tree = task.chart.tree(points)
    near = tree.sparse_distance_matrix(tree, reach)
    return connected_components(near, directed=False)[1]
