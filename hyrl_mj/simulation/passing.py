"""How runs pass obstacles: by the angles through which they turn about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from hyrl_mj.tasks import wrapped

if TYPE_CHECKING:
    from hyrl_mj.physics.plant import Plant
    from hyrl_mj.tasks import Task


class Rows:
    """Base of dataclasses of arrays with a row for each of n runs, of other such classes, and of None."""

    def __getitem__(self, rows: np.ndarray | slice) -> Self:
        fields = vars(self).values()
        return type(self)(*(None if values is None else values[rows] for values in fields))

    def put(self, rows: np.ndarray, other: Self) -> None:
        """Takes over other runs (k,) as those of indices `rows` (k,)."""
        for name, values in vars(self).items():
            new = getattr(other, name)
            if isinstance(values, Rows):
                values.put(rows, new)
            elif values is not None:
                values[rows] = new


@dataclass(frozen=True)
class Passing(Rows):
    """How n runs pass K obstacles, seen in the task's plane.

    Attributes:
        first, last: (n, K) bearings of the robot from each obstacle, at the start and at the end [rad].
        turned: (n, K) angles through which the robot turns about each obstacle, counter-clockwise [rad]: the
            sum of the wrapped changes of the bearing, so that full turns count.
    """

    first: np.ndarray
    last: np.ndarray
    turned: np.ndarray

    @staticmethod
    def begin(task: Task, plant: Plant) -> Passing:
        """Returns that of n robots that have not moved yet."""
        first = _bearings(task, plant, np.arange(plant.n))
        return Passing(first, first.copy(), np.zeros_like(first))

    def follow(self, task: Task, plant: Plant, active: np.ndarray) -> None:
        """Follows the runs `active` (k,) by one sample."""
        now = _bearings(task, plant, active)
        self.turned[active] += wrapped(now - self.last[active])
        self.last[active] = now


def _bearings(task: Task, plant: Plant, rows: np.ndarray) -> np.ndarray:
    """Returns the bearings (k, K) of the robots `rows` (k,) from all obstacles [rad]."""
    centres = plant.geom_positions(list(task.obstacles.values()))[..., list(task.plane)]
    if len(centres) > 1:  # they move
        centres = centres[rows]
    away = task.where(plant.truth(rows))[:, None] - centres
    return np.arctan2(away[..., 1], away[..., 0])


def windings(a: Passing, b: Passing) -> np.ndarray:
    """Returns how often loops wind about each obstacle: (n, K) int.

    A loop follows a run of `a`, goes straight to the end of the run of `b`, follows that back, and goes
    straight to the start of the first.
    """
    around = a.turned - b.turned + wrapped(b.last - a.last) + wrapped(a.first - b.first)
    return np.round(around / (2 * np.pi)).astype(int)
