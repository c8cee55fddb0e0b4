"""The way that is left to the goal, around what ends episodes: a reward that leads there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hyrl_mj.errors import HyrlError
from hyrl_mj.gym_export import Pay
from hyrl_mj.sets import GridSet, covering, shortest_ways
from hyrl_mj.tasks import Outcome, Task, largest_moves


class NoWay(HyrlError):
    """No way leads from the starts of a task to its goal."""


class WayToGo:
    """How long the shortest way to the goal is, at the nodes of a grid over the chart.

    Ways lead along nodes at which an episode goes on, in any direction of the chart: what the robot cannot
    do, such as driving sideways, is not known to them. They lead a training out of dead ends, in which a
    reward for being close to the goal ends.

    A state is worth 0 at the end of the longest way, and 1 at the goal. Who fails gets no more than that, and
    who arrives gets what it is worth to stay: to put off an arrival does not pay.

    Args:
        task: the robot and its problem.
        gamma: discount factor of the training.
        inside: (n, d) -> (n,) bool, where ways may lead; by default everywhere.

    Raises:
        NoWay: no start has a way, or no node of the chart counts as arrived.
    """

    def __init__(
        self,
        task: Task,
        gamma: float,
        inside: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        chart = task.chart
        # About 2 ** 16 nodes are asked whether an episode goes on there.
        nodes = covering(chart, round(2 ** (16 / np.clip(chart.dimension, 2, 4))))
        z = nodes.nodes
        plant = task.placed(z)
        measurement = plant.measurement
        outcome = task.outcome(measurement, plant.unstable)
        runs = outcome == Outcome.RUNNING
        if inside is not None:
            runs &= inside(z)
        goal = (outcome == Outcome.REACHED) | (runs & task.arrived(z))
        if not goal.any() and task.set_point is not None:  # closer than a node
            goal[nodes.nearest(np.array([task.set_point]))] = True
        free = runs | goal
        hop = float(np.linalg.norm(largest_moves(task)[: chart.dimension] / chart.scale))
        # Where a training that tries out inputs may fail in two samples, the way counts up to twice: the
        # shortest one grazes each corner, before which a policy learns to stop.
        room = -GridSet.from_mask(nodes, free).values
        weight = 1 + np.clip(1 - room / (2 * hop), 0, 1)
        pairs, ends = nodes.neighbours(), np.flatnonzero(goal)
        ways = shortest_ways(chart, z, pairs, free, ends, weight=weight)
        leads = np.isfinite(ways)
        # As many starts as tell whether stage 1 arrives.
        starts = task.starts(1_000, np.random.default_rng(0))
        if not leads[nodes.nearest(starts)].any():
            what = "leads from its starts to its goal" if goal.any() else "has a goal to lead to"
            raise NoWay(
                f"no way {what} on {nodes} of the chart of {task.name}: see whether its `ending` and "
                "`arrived` leave one"
            )
        longest = max(float(ways[leads].max()), hop)
        self._near = nodes.evaluation(np.where(leads, 1 - ways / longest, 0.0))
        self._task, self._follow = task, task.max_steps if gamma == 1 else 1 / (1 - gamma)

    @property
    def pay(self) -> Pay:
        """What episodes are paid for: `reward`, which is 0 at least."""
        return Pay(self.reward, 0.0)

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns how near states (n, p) are to the goal, from 0 to 1, and more where they have arrived."""
        outcome = self._task.ending(measurement)
        near = np.where(outcome == Outcome.RUNNING, self._near(self._task.z(measurement)), 0.0)
        return np.where(outcome == Outcome.REACHED, self._follow, near)
