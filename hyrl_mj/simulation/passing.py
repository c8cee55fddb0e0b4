"""How runs pass obstacles: by the angles through which they turn about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.tasks import wrapped

if TYPE_CHECKING:
    from hyrl_mj.physics.plant import Plant
    from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Passing:
    """How n runs pass K obstacles, seen in the task's plane.

    Attributes:
        first, last: (n, K) bearings of the robot from each obstacle, at the start and at the end [rad].
        turned: (n, K) angles through which the robot turns about each obstacle, counter-clockwise [rad]: the
            sum of the wrapped changes of the bearing, so that full turns count.
    """

    first: np.ndarray
    last: np.ndarray
    turned: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Passing:
        return Passing(self.first[rows], self.last[rows], self.turned[rows])


class Follower:
    """Follows the bearings of n robots from all obstacles, during their runs."""

    def __init__(self, task: Task, plant: Plant):
        self._task, self._plant = task, plant
        self._geoms = list(task.obstacles.values())
        self._first = self._bearings(np.arange(plant.n))
        self._last = self._first.copy()
        self._turned = np.zeros_like(self._first)

    def _bearings(self, rows: np.ndarray) -> np.ndarray:
        centres = self._plant.geom_positions(self._geoms)[..., list(self._task.plane)]
        if len(centres) > 1:  # they move
            centres = centres[rows]
        away = self._task.where(self._plant.truth(rows))[:, None] - centres
        return np.arctan2(away[..., 1], away[..., 0])

    def follow(self, active: np.ndarray) -> None:
        """Follows the runs `active` (k,) by one sample."""
        now = self._bearings(active)
        self._turned[active] += wrapped(now - self._last[active])
        self._last[active] = now

    @property
    def passing(self) -> Passing:
        """What has been seen so far."""
        return Passing(self._first, self._last, self._turned)


def windings(a: Passing, b: Passing) -> np.ndarray:
    """Returns how often loops wind about each obstacle: (n, K) int.

    A loop follows a run of `a`, goes straight to the end of the run of `b`, follows that back, and goes
    straight to the start of the first.
    """
    around = a.turned - b.turned + wrapped(b.last - a.last) + wrapped(a.first - b.first)
    return np.round(around / (2 * np.pi)).astype(int)
