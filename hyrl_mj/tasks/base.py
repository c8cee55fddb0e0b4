"""What a task is: a plant with a measurement, a chart, an observation, a reward, an end and starts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj import mjcf
from hyrl_mj.chart import Chart
from hyrl_mj.errors import BadInput, check_bound
from hyrl_mj.plant import Plant, input_limits

# How a critical set can be searched for.
SEARCHES = ("rods", "outcome")


class Outcome(IntEnum):
    """How an episode stands, or ended. RUNNING at its end means that it was cut off on its way."""

    RUNNING = 0
    REACHED = 1
    CRASHED = 2
    OUT_OF_BOUNDS = 3
    STALLED = 4
    UNSTABLE = 5

    @property
    def label(self) -> str:
        """The name for people and for `info`: "reached", "crashed", ..."""
        return self.name.lower()


@dataclass(frozen=True)
class Mirror:
    """A mirror symmetry: mirrored observations call for mirrored inputs and earn the same reward.

    Attributes:
        observation: (k,) +1 or -1, what the mirror does to each column of the observation.
        inputs: (m,) +1 or -1, what it does to each input.
    """

    observation: tuple[int, ...]
    inputs: tuple[int, ...]


class Task(ABC):
    """A robot with a job: the base of the files in `hyrl_mj/tasks`.

    A task is stateless. Its methods take batches: measurements (n, p), chart points (n, d), inputs
    (n, m), in the units of the MJCF. Geometry and limits are read from the compiled model.
    """

    #: the task's name, also that of its MJCF `models/<name>.xml`
    name: str
    #: the id under which Gymnasium knows it, by default `hyrl_mj/<class>-v0`
    env_id: str
    #: the file that defines it, if that is not one of this package
    source: Path | None = None
    #: whether another installed package offers it: its name finds it then
    installed: bool = False
    #: one line for `hyrl-mj list`
    description: str = ""
    #: coordinates of the critical set and of all sets
    chart: Chart
    #: names of the actuators that the policy drives
    inputs: tuple[str, ...]
    #: their units; none of them where it is left empty
    input_units: tuple[str, ...] = ()
    #: None for a continuous input; else the number of equally spaced levels of each single input
    levels: int | None = None
    #: how much of the noise bound acts on each column of the measurement: 0 or False, 1 or True, or a
    #: share, where one column has another unit. The first d are those of the chart
    noisy: tuple[float, ...]
    #: samples after which an episode is truncated
    max_steps: int
    #: horizon T of the backward propagation [s]
    horizon: float
    #: the reward that no state is worse than; leaving a mode's extended set counts as this for ever
    worst_reward: float
    #: lower and upper corner of the box that starts come from, chart points (d,), (d,)
    start_low: tuple[float, ...]
    start_high: tuple[float, ...]
    #: how far off the set-point a policy may be because of itself, not of noise [chart units]
    precision: float = np.inf
    #: how far from the set-point counts as there [chart units]
    close: float = 0.2
    #: the paper's replay starts (k, d), and how long they are watched [s]
    replay_starts: tuple[tuple[float, ...], ...]
    replay_time: float
    #: the starts (k, d) of the paper's picture of the policy, by default the replay starts
    policy_starts: tuple[tuple[float, ...], ...] = ()
    #: what the runs of each mode do, in the order of the modes
    mode_names: tuple[str, ...]
    #: how its critical set is searched for: by "rods" or by "outcome"; see `find_critical_set`
    search: str = "outcome"
    #: what trains it by default: an algorithm of SB3, as "ppo", or "module:Class"
    algorithm: str
    #: the hyperplane with respect to which its reward is symmetric, if any (paper, Section IV-B)
    mirror: Mirror | None = None
    #: bounds of the observation (k,), (k,), noise included
    observation_low: tuple[float, ...]
    observation_high: tuple[float, ...]

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled MJCF (shared: do not write to it)."""
        return mjcf.load(self.model_path)

    @property
    def reference(self) -> str:
        """What `get_task` finds it by in another process: its name, or the file that defines it."""
        return self.name if self.source is None or self.installed else str(self.source)

    @property
    def model_path(self) -> Path:
        """Its MJCF, `<name>.xml`: beside the user's file that defines the task, else in `models`."""
        inside = mjcf.models_dir() / f"{self.name}.xml"
        return inside if self.source is None else self.source.with_name(inside.name)

    @cached_property
    def dt(self) -> float:
        """Sample time of the controller [s]."""
        return mjcf.sample_time(self.model)

    @cached_property
    def input_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit of the inputs (m,), (m,), from the MJCF."""
        return input_limits(self.model, self.inputs, of_actuators=not self.has_inner_loop)

    @cached_property
    def input_levels(self) -> np.ndarray | None:
        """The inputs of a discrete task, (levels, m), else None."""
        low, high = self.input_limits
        return None if self.levels is None else np.linspace(low, high, self.levels)

    def at_levels(self, actions: np.ndarray) -> np.ndarray:
        """Inputs (n, m) of a discrete task for the numbers of its levels (n,) int.

        Raises:
            BadInput: a number that is not an integer, or not of a level.
        """
        levels, actions = self.input_levels, np.asarray(actions)
        assert levels is not None
        whole = np.issubdtype(actions.dtype, np.integer)
        wrong = actions if not whole else actions[(actions < 0) | (actions >= len(levels))]
        if wrong.size:
            raise BadInput(
                f"action {wrong.flat[0]} cannot be used: {self.name} takes integers from 0 to "
                f"{len(levels) - 1}"
            )
        return levels[actions]

    @cached_property
    def set_point(self) -> np.ndarray | None:
        """Where it is to go, a chart point (d,), if that is a single one."""
        return None

    @property
    def measurement_columns(self) -> int:
        """p, the number of columns of the measurement."""
        return len(self.noisy)

    def mode_name(self, mode: int) -> str:
        """A mode for people: "0 (left)"."""
        known = 0 <= mode < len(self.mode_names)
        return f"{mode} ({self.mode_names[mode]})" if known else str(mode)

    def plant(self, n: int, threads: int = 0) -> Plant:
        """n copies of the robot."""
        control = self.control if self.has_inner_loop else None
        return Plant(self.model, self.inputs, n, threads, measure=self.measure, control=control)

    @cached_property
    def kinematic(self) -> bool:
        """Whether the robot simply follows its inputs, so that it can be run backward."""
        return self.plant(1).invertible

    def check_state(self, z: ArrayLike) -> np.ndarray:
        """Chart points as a float array (n, d).

        Raises:
            BadInput: wrong shape, not finite, or outside the chart.
        """
        try:
            z = np.atleast_2d(np.asarray(z, dtype=float))
        except (TypeError, ValueError):
            raise BadInput(
                f"a state of {self.name} is {self.chart.dimension} numbers, got {z!r}"
            ) from None
        if z.ndim != 2 or z.shape[1] != self.chart.dimension or not len(z):
            raise BadInput(
                f"a state of {self.name} is {self.chart.dimension} number(s) "
                f"({', '.join(self.chart.names)}), got shape {z.shape}"
            )
        bad = ~(np.isfinite(z).all(axis=1) & self.chart.contains(z))
        if bad.any():
            arena = ", ".join(
                f"{low:g} <= {name} <= {high:g} {unit}"
                for name, unit, low, high, periodic in zip(
                    self.chart.names,
                    self.chart.units,
                    self.chart.low,
                    self.chart.high,
                    self.chart.periodic,
                    strict=True,
                )
                if not periodic
            )
            raise BadInput(
                f"state {np.argmax(bad)} ({self.chart.format(z[bad][0])}) is outside {self.name}: "
                f"{arena or 'give finite numbers'}"
            )
        return z

    def check_measurement(self, measured: np.ndarray) -> np.ndarray:
        """A measurement as a float array (n, p).

        Raises:
            BadInput: wrong shape or not finite.
        """
        measured = np.asarray(measured, dtype=float)
        if measured.ndim != 2 or measured.shape[1] != self.measurement_columns:
            raise BadInput(
                f"a measurement of {self.name} has shape (n, {self.measurement_columns}), "
                f"got {measured.shape}"
            )
        # A robot asks for one measurement at a time; `all()` takes three times as long for it.
        finite = np.isfinite(measured)
        if np.count_nonzero(finite) < measured.size:
            row, column = np.argwhere(~finite)[0]
            raise BadInput(
                f"measurement[{row}, {column}] is {measured[row, column]}, it must be finite"
            )
        return measured

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        """The measurement (n, p) of what the sensors give (n, sensors), by default just that."""
        return sensors

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """An inner loop, at the rate of the physics and from the true state; by default there is none.

        A task that has one gives names of MJCF numerics as `inputs`; they hold the limits.

        Args:
            u: (n, m) inputs of the policy.
            qpos, qvel: (n, nq), (n, nv) positions and velocities.

        Returns:
            (n, nu) controls of all actuators.
        """
        return u

    @property
    def has_inner_loop(self) -> bool:
        """Whether `control` is there, between the policy and the actuators."""
        return type(self).control is not Task.control

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The full state that belongs to chart points, by default these as positions, at rest.

        Args:
            z: (n, d) chart points.
            rng: draws the coordinates that the chart does not hold, as a start distribution would have
                them; without it they have their usual values.

        Returns:
            qpos (n, nq) and qvel (n, nv), None at rest.
        """
        return z, None

    def qpos(self, z: np.ndarray) -> np.ndarray:
        """The full position (n, nq) that belongs to chart points z (n, d)."""
        return self.state(z)[0]

    def z(self, measured: np.ndarray) -> np.ndarray:
        """Chart points (n, d) of measurements (n, p)."""
        return measured

    def with_z(self, measured: np.ndarray, z: np.ndarray) -> np.ndarray:
        """The measurements (n, p) changed so that their chart points are z (n, d)."""
        return z

    @abstractmethod
    def observation(self, measured: np.ndarray) -> np.ndarray:
        """What the network is fed: (n, k)."""

    def measured(self, observation: np.ndarray) -> np.ndarray:
        """Measurements (n, p) of observations (n, k): `observation` undone, if a task can do that.

        Columns that neither the chart nor the networks read may hold any value.

        Raises:
            BadInput: the task does not say how.
        """
        raise BadInput(
            f"{self.name} does not say which measurement an observation belongs to: "
            "give it a measured(observation)"
        )

    @abstractmethod
    def reward(self, measurement: np.ndarray) -> np.ndarray:
        """Reward (n,) of the true state after the step."""

    @abstractmethod
    def ending(self, measurement: np.ndarray) -> np.ndarray:
        """`Outcome` (n,) int of states that end an episode, RUNNING where it goes on."""

    def outcome(self, measurement: np.ndarray, unstable: np.ndarray) -> np.ndarray:
        """`Outcome` (n,) int of measurements (n, p), UNSTABLE where the simulation broke down (n,)."""
        return np.where(unstable, Outcome.UNSTABLE, self.ending(measurement))

    def failed(self, measurement: np.ndarray) -> np.ndarray:
        """(n,) bool, states that end an episode without success."""
        ending = self.ending(measurement)
        return np.asarray((ending != Outcome.RUNNING) & (ending != Outcome.REACHED))

    def verdict(self, measurement: np.ndarray) -> np.ndarray:
        """`Outcome` (n,) int of episodes that still ran when their time was up."""
        return np.where(self.arrived(self.z(measurement)), Outcome.REACHED, Outcome.STALLED)

    def arrived(self, z: np.ndarray) -> np.ndarray:
        """Whether chart points (n, d) at the end of an episode are close to the set-point: (n,) bool."""
        return self.miss(z) <= self.close

    def miss(self, z: np.ndarray) -> np.ndarray:
        """How far chart points (n, d) at the end of an episode are off the set-point: (n,), chart units."""
        if self.set_point is None:
            raise BadInput(f"{self.name} has no set_point: give it one, or a miss() of its own")
        return np.asarray(np.linalg.norm(self.chart.difference(z, self.set_point), axis=1))

    def danger(self, measurement: np.ndarray) -> np.ndarray:
        """How dangerous states are, the greater the worse: (n,). What adversarial noise works towards."""
        return -self.reward(measurement)

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """n starts drawn from the task's start distribution: (n, d)."""
        return rng.uniform(self.start_low, self.start_high, (n, self.chart.dimension))

    def may_start(self, z: np.ndarray) -> np.ndarray:
        """Whether chart points (n, d) lie in the box that starts come from: (n,) bool."""
        z, slack = self.chart.wrap(z), 1e-9
        inside = (z >= np.subtract(self.start_low, slack)) & (z <= np.add(self.start_high, slack))
        return np.asarray(inside.all(axis=1))

    def noise_in_chart(self, bound: float, everywhere: bool = False) -> np.ndarray:
        """How far a measured chart point may be from the true one, by coordinate: (d,)."""
        d = self.chart.dimension
        return bound * (np.ones(d) if everywhere else np.array(self.noisy[:d], dtype=float))

    def noise_on(self, everywhere: bool = False) -> tuple[str, str]:
        """The chart coordinates that noise acts on, and their unit, for people: "x and y", "m"."""
        hit = self.noise_in_chart(1.0, everywhere) > 0
        names = [name for name, h in zip(self.chart.names, hit, strict=True) if h]
        units = [unit for unit, h in zip(self.chart.units, hit, strict=True) if h]
        return " and ".join(names), ", ".join(dict.fromkeys(units))

    def check_noise(self, bound: float, everywhere: bool = False) -> float:
        """The noise bound itself, if measurements still tell something about this task.

        Raises:
            BadInput: it is not a number >= 0, or so large that it hides the whole chart.
        """
        check_bound(bound)
        share = self.noise_in_chart(1.0, everywhere)
        with np.errstate(divide="ignore"):
            limits = self.chart.sides / (2 * share)
        if bound >= limits.min():
            raise BadInput(
                f"noise bound {bound:g} hides the whole state space of {self.name}: "
                f"give one below {limits.min():.3g} {self.chart.units[int(limits.argmin())]}"
            )
        return float(bound)

    def direction(self, path: np.ndarray) -> np.ndarray:
        """Which way runs went, by default on which side of the geom "obstacle" they passed.

        The first two coordinates of the chart are then where the robot is in the plane.

        Args:
            path: (K + 1, n, d) chart points over time, not wrapped; a run that ended stays put.

        Returns:
            (n,) int: the mode whose way the run went, -1 where there was nothing to decide; by default 0
            for the left and 1 for the right side.
        """
        return passing_side(path[..., :2], mjcf.geom_pos(self.model, "obstacle")[:2])


def passing_side(path: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """On which side runs pass an obstacle, as seen on the way from their start to where they are nearest.

    Args:
        path: (K + 1, n, 2) points in the plane over time; a run that ended stays put.
        centre: (2,) of the obstacle.

    Returns:
        (n,) int: 0 on its left, 1 on its right, -1 for runs that only leave it behind.
    """
    nearest = np.linalg.norm(path - centre, axis=2).argmin(axis=0)
    way = path[nearest, np.arange(path.shape[1])] - path[0]
    to_centre = centre - path[0]
    # The obstacle lies to the right of who passes on the left.
    right = way[:, 0] * to_centre[:, 1] - way[:, 1] * to_centre[:, 0] > 0
    return np.where(nearest == 0, -1, right.astype(int))
