"""The problem of a task: chart, observation, reward, end and starts of a robot."""

from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.sets import Chart
from hyrl_mj.tasks.anew import begins_anew
from hyrl_mj.tasks.description import Outcome
from hyrl_mj.tasks.effort import Effort
from hyrl_mj.tasks.moves import largest_moves
from hyrl_mj.tasks.robot import Robot


class Problem(Robot):
    """A robot with something to do: what it is told, what it gets for it, and when it is over."""

    #: coordinates of the critical set and of all sets
    chart: Chart
    #: samples after which an episode is truncated
    max_steps: int
    #: a lower bound of the reward; leaving a mode's extended set counts as this reward for ever
    worst_reward: float
    #: lower and upper corner of the box of starts, chart points (d,), (d,)
    start_low: tuple[float, ...]
    start_high: tuple[float, ...]
    #: largest distance from the set-point that is the policy's own error, not noise's [chart units]
    precision: float = np.inf
    #: distance from the set-point up to which a state counts as arrived [chart units]
    close: float = 0.2
    #: how much the stages try: `SPARING` where each sample runs Python code of an environment
    effort: Effort = Effort()
    #: bounds of the observation (k,), (k,), noise included
    observation_low: tuple[float, ...]
    observation_high: tuple[float, ...]
    #: the vectors of a Dict that, one after the other, are the observation: the number of columns of each, by
    #: its key; none of a plain vector
    observation_parts: Mapping[str, int] = {}
    #: the type of the numbers that the task's environments give in observations, such as "float64"; "" if any
    observation_dtype: str = ""

    @cached_property
    def kinematic(self) -> bool:
        """Whether the robot follows its inputs without inertia, so that it can be run backward.

        An inner loop must give the speeds from the inputs and the positions alone. Both are tried out.
        """
        if not self.plant(1).invertible:
            return False
        if self.has_inner_loop:
            rng = np.random.default_rng(0)
            z = self.chart.draw(50, rng)
            qpos, _ = self.state(z)
            u = self.draw_inputs(len(z), rng)
            qvel = rng.normal(size=qpos.shape)
            still = self.control(u, qpos, np.zeros_like(qvel))
            if not np.allclose(self.control(u, qpos, qvel), still, rtol=0, atol=1e-9):
                return False
        return begins_anew(self)

    @cached_property
    def chart_is_state(self) -> bool:
        """Whether one sample leads from chart point to chart point, so that nothing else tells what comes.

        That is tried out, too, by copies that are made anew at the chart point of others.
        """
        d = self.chart.dimension
        same = self.measurement_columns == d and self.model.nq == d
        return same and self.kinematic and begins_anew(self, of_chart=True)

    @cached_property
    def moves(self) -> np.ndarray:
        """The largest change (p,) of each column of the measurement in one sample, as runs show it."""
        return largest_moves(self)

    @cached_property
    def set_point(self) -> np.ndarray | None:
        """The goal, a chart point (d,), if it is a single one."""
        return None

    def z(self, measured: np.ndarray) -> np.ndarray:
        """Returns the chart points (n, d) of measurements (n, p), by default the first d columns."""
        return measured[:, : self.chart.dimension]

    def at(self, z: np.ndarray) -> np.ndarray:
        """Returns the measurements (n, p) of a robot at chart points z (n, d), without noise."""
        if self.measurement_columns == self.chart.dimension:
            return z
        return self.placed(z).measurement

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Returns measurements (n, p) changed so that their chart points are z (n, d)."""
        return np.hstack([z, measured[:, self.chart.dimension :]])

    def perturbed(self, measured: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Returns what would be measured (n, p) under noise (n, p), as far as a measurement (n, p) tells."""
        return measured + noise

    @abstractmethod
    def observation(self, measured: np.ndarray) -> np.ndarray:
        """Returns the network's inputs (n, k) for measurements (n, p)."""

    def measured(self, observation: np.ndarray) -> np.ndarray:
        """Returns the measurements (n, p) of observations (n, k): the inverse of `observation`.

        Columns that neither the chart nor the networks read may hold any value.

        Raises:
            BadInput: the task does not define it.
        """
        raise BadInput(
            f"{self.name} does not say how to invert observation(): give it a measured(observation)"
        )

    @abstractmethod
    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns the reward (n,) of a step.

        Args:
            measurement: (n, p) of the true state after the step.
            u: (n, m) inputs of the step, in the plant's units.
        """

    @abstractmethod
    def ending(self, measurement: np.ndarray) -> np.ndarray:
        """Returns the `Outcome` (n,) int of states that end an episode, RUNNING for the others."""

    def outcome(self, measurement: np.ndarray, unstable: np.ndarray) -> np.ndarray:
        """Returns the `Outcome` (n,) int of measurements (n, p), UNSTABLE where the physics is (n,)."""
        return np.where(unstable, Outcome.UNSTABLE, self.ending(measurement))

    def failed(self, measurement: np.ndarray) -> np.ndarray:
        """Returns (n,) bool: whether measurements (n, p) end an episode without success."""
        ending = self.ending(measurement)
        return np.asarray((ending != Outcome.RUNNING) & (ending != Outcome.REACHED))

    def goes_on(self, z: np.ndarray) -> np.ndarray:
        """Returns (n,) bool: whether episodes that begin at chart points z (n, d) do not end at once."""
        return np.asarray(self.ending(self.placed(z).measurement) == Outcome.RUNNING)

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        """Returns the `Outcome` (n,) int of episodes that still ran when they were truncated."""
        return np.where(self.arrived(self.z(measurement)), Outcome.REACHED, Outcome.STALLED)

    def arrived(self, z: np.ndarray) -> np.ndarray:
        """Returns (n,) bool: whether chart points (n, d) at the end of episodes are at the set-point."""
        return self.miss(z) <= self.close

    def miss(self, z: np.ndarray) -> np.ndarray:
        """Returns the distance (n,) of the last chart points (n, d) from the set-point [scaled units]."""
        if self.set_point is None:
            raise BadInput(f"{self.name} has no set_point: give it one, or a miss() of its own")
        return self.chart.distance(z, self.set_point)

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        """Returns the danger (n,) of measurements (n, p), which adversarial noise maximises.

        By default this is the negative reward, with inputs in the middle of their limits.
        """
        middle = np.mean(self.input_limits, axis=0)
        return -self.reward(measurement, np.tile(middle, (len(measurement), 1)))

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Returns n starts (n, d) drawn from the task's start distribution."""
        return rng.uniform(self.start_low, self.start_high, (n, self.chart.dimension))

    def may_start(self, z: np.ndarray) -> np.ndarray:
        """Returns (n,) bool: whether chart points (n, d) lie in the box of starts."""
        z, slack = self.chart.wrap(z), 1e-9
        inside = (z >= np.subtract(self.start_low, slack)) & (z <= np.add(self.start_high, slack))
        return np.asarray(inside.all(axis=1))
