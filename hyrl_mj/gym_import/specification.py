"""What is known of an environment: the values that a task is made of, and when an episode is a success."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import combinations
from typing import Any, Literal, NamedTuple

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.expressions import Expression, Path
from hyrl_mj.gym_import.opening import Description
from hyrl_mj.sets import Chart
from hyrl_mj.tasks import Outcome

# By how much coordinates are moved to see what follows them, as a share of the side of the chart.
MOVED = 1e-3
# What derived quantities are, as what is observed after a step shows them: as at the end of the step; as a
# step of the physics before; or neither.
Derived = Literal["now", "earlier", "unknown"]
_none = partial(np.zeros, 0)  # of what is not known yet


@dataclass(frozen=True)
class Coordinate:
    """A coordinate of a chart.

    Attributes:
        name: in figures and messages.
        kind: "qpos" or "qvel".
        index: of the position or the velocity.
        offset: what the coordinate is greater by.
        joint: id of the joint.
        axis: the axis of the world, 0 to 2, along which it moves most; None if it turns.
    """

    name: str
    kind: str
    index: int
    offset: float
    joint: int
    axis: int | None

    @property
    def unit(self) -> str:
        """The unit: "m", "rad", "m/s" or "rad/s"."""
        return ("rad" if self.axis is None else "m") + "/s" * (self.kind == "qvel")

    def described(self) -> str:
        """Returns what it stands for: "qpos[0]"."""
        return f"{self.kind}[{self.index}]"


class Axis(NamedTuple):
    """The axis of the world along which a coordinate of the chart moves the robot.

    The robot is at `sign` times the coordinate plus `shift` [m] on the axis `number`, 0 to 2.
    """

    number: int
    sign: float
    shift: float

    def world(self, z: np.ndarray) -> np.ndarray:
        """Returns places on the axis [m] for values of the coordinate."""
        return self.sign * z + self.shift

    def interval(self, low: float, high: float) -> tuple[float, float]:
        """Returns the ends of the coordinate between two places on the axis [m]."""
        ends = sorted(self.sign * (end - self.shift) for end in (low, high))
        return ends[0], ends[1]


@dataclass(frozen=True)
class Criterion:
    """When an episode is a success, and when a failure.

    Both are asked at every sample. A success that needs `terminated`, or asks for `info`, ends the episode;
    any other one, such as "not terminated", has to hold at the end of the episode.

    Attributes:
        name: of the environment, for messages.
        success: the condition of success.
        failure: the condition of failure; by default the environment ends the episode without success.
        points: the pairs of names whose distance is needed, each as a kind and an index for both, as
            `mjcf.point_of` gives them.
    """

    name: str = ""
    success: Expression = field(default_factory=lambda: Expression(""))
    failure: Expression | None = None
    points: tuple[tuple[tuple[str, int], tuple[str, int]], ...] = ()

    @property
    def ends(self) -> bool:
        """Whether a success ends the episode."""
        of_info = any(name[0] == "info" for name in self.success.asked)
        return of_info or self.success.needs("terminated")

    @cached_property
    def asked(self) -> tuple[Any, ...]:
        """The names that its conditions need; see `Expression`."""
        failure = () if self.failure is None else self.failure.asked
        return tuple(dict.fromkeys((*self.success.asked, *failure)))

    @cached_property
    def keys(self) -> tuple[Path, ...]:
        """The entries of `info` that it needs."""
        return tuple(name[1] for name in self.asked if name[0] == "info")

    @cached_property
    def places(self) -> tuple[tuple[str, str], ...]:
        """The pairs of names whose distance it needs."""
        return tuple(name[1:] for name in self.asked if name[0] == "distance")

    def verdict(self, success: np.ndarray) -> np.ndarray:
        """Returns the `Outcome` (n,) of episodes that are cut off where `success` (n,) holds or not."""
        holds = success & (not self.ends)
        return np.where(holds, Outcome.REACHED, Outcome.STALLED)

    def judged(self, report: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns whether reports (k, r) are successes, (k,) bool, and the `Outcome` (k,) of their samples.

        Raises:
            BadInput: "terminated" alone is the success, and an episode ended in touch with something.
        """
        names: list[Any] = ["reward", "terminated", "truncated", "touch"]
        names += [("info", key) for key in self.keys]
        names += [("distance", *pair) for pair in self.places]
        values = dict(zip(names, report.T, strict=True))
        success = self.success.holds(values)
        terminated, truncated, touches = (report[:, 1:4] > 0).T
        if self.success.text.strip() == "terminated" and (touches & terminated).any():
            raise BadInput(
                f"{self.name}: an episode ended where the robot touches what it does not touch elsewhere, "
                'and "terminated" counts that as a success: say which ends are successes, as "terminated '
                'and reward >= 1"'
            )
        failure = terminated & ~success
        if self.failure is not None:
            failure = self.failure.holds(values)
            if (success & failure).any():
                raise BadInput(
                    f"{self.name}: at the same sample it is a success ({self.success.text}) and a failure "
                    f"({self.failure.text}): let one of the conditions exclude the other"
                )
        reached = success & (terminated | truncated | self.ends)
        outcome = np.select(
            [failure, reached, terminated | truncated],
            [Outcome.CRASHED, Outcome.REACHED, Outcome.STALLED],
            Outcome.RUNNING,
        )
        return success, outcome.astype(int)


@dataclass(frozen=True)
class EnvironmentSpec:
    """What is known of an environment; `inspect` finds it, a part after the other.

    Attributes:
        description: what the user says of it.
        qpos, qvel: the places (nq,), (nv,) of positions and velocities in a state of MuJoCo.
        observation_low, observation_high: limits (o,) of an observation.
        parts: the number of columns of each part of a Dict, in the order of its space; none of a vector.
        low, high: limits (m,) of the inputs.
        inputs: their names.
        levels: number of a discrete action's values; None of continuous ones.
        wrapped: whether wrappers lie around the environment.
        observers: the names of what computes the observation, of those that `observers` gives.
        coordinates: of the decision.
        noisy: (d,) share of the noise bound on each coordinate.
        solid: (ngeom,) bool, the geoms of the robot.
        dt: time of a sample [s].
        worst_reward: the least reward of sampled runs.
        depth: how deep the robot may be inside of something at a start, as it is in sampled runs [m].
        harmless: geoms that the robot has touched without an end of the episode.
        tracked: the name of what goes farthest in sampled runs.
        memoryless: whether MuJoCo's state is all that runs depend on, as far as trials show.
        criterion: of success and failure.
        chart: the coordinates with their bounds.
        state: MuJoCo's state (S,) from which runs begin, but for the positions of the chart.
        start_low, start_high: corners (d,) of the box of starts.
        max_steps: samples of an episode.
        islands: what can be passed on both sides, by name, each with the id of a geom.
        plane: the axes of the world that the first two coordinates follow; none if they do not.
        recalled: (o,) bool, the columns of the innermost observation that episodes change apart from the
            state, whatever their places.
        led: how runs that are judged are led to their starts; None where resets note nothing.
        derived: `Derived`.
        moves: (o,) bool, the columns of an observation at rest that follow the chart.
        at_rest: a matrix (t, o) that gives what is observed at rest at z from `terms` of z, if one does.
        found: what was filled in, with the reason, by name.
    """

    description: Description
    qpos: np.ndarray = field(default_factory=_none)
    qvel: np.ndarray = field(default_factory=_none)
    observation_low: np.ndarray = field(default_factory=_none)
    observation_high: np.ndarray = field(default_factory=_none)
    parts: Mapping[str, int] = field(default_factory=dict)
    low: np.ndarray = field(default_factory=_none)
    high: np.ndarray = field(default_factory=_none)
    inputs: tuple[str, ...] = ()
    levels: int | None = None
    wrapped: bool = False
    observers: tuple[str, ...] = ()
    coordinates: tuple[Coordinate, ...] = ()
    noisy: tuple[float, ...] = ()
    solid: np.ndarray = field(default_factory=_none)
    dt: float = 0.0
    worst_reward: float = 0.0
    depth: float = 0.0
    harmless: frozenset[int] = frozenset()
    tracked: str = ""
    memoryless: bool = False
    criterion: Criterion = field(default_factory=Criterion)
    chart: Chart = field(default_factory=lambda: Chart((), (), (), (), ()))
    state: np.ndarray = field(default_factory=_none)
    start_low: tuple[float, ...] = ()
    start_high: tuple[float, ...] = ()
    max_steps: int = 1
    islands: Mapping[str, int] = field(default_factory=dict)
    plane: tuple[Axis, ...] = ()
    recalled: np.ndarray = field(default_factory=_none)
    led: Any = None
    derived: Derived = "unknown"
    moves: np.ndarray = field(default_factory=_none)
    at_rest: np.ndarray | None = None
    found: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name of the environment."""
        return self.description.name

    @property
    def dimension(self) -> int:
        """d, the number of the chart's coordinates."""
        return len(self.coordinates)

    @property
    def columns(self) -> int:
        """o, the number of columns of an observation."""
        return len(self.observation_low)

    @cached_property
    def places(self) -> np.ndarray:
        """Where the coordinates of the chart are in a state of MuJoCo: (d,) int."""
        kinds = {"qpos": self.qpos, "qvel": self.qvel}
        return np.array([kinds[c.kind][c.index] for c in self.coordinates], dtype=int)

    @cached_property
    def offset(self) -> np.ndarray:
        """What the coordinates of the chart are greater by than these entries of a state: (d,)."""
        return np.array([c.offset for c in self.coordinates])

    @cached_property
    def nudge(self) -> np.ndarray:
        """By how much coordinates with noise are moved to see what follows them: (d,)."""
        return MOVED * self.chart.sides * (np.array(self.noisy) > 0)

    def anywhere(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Returns chart points (n, d) at random, of those where runs begin."""
        return rng.uniform(self.start_low, self.start_high, (n, self.dimension))

    def z(self, state: np.ndarray) -> np.ndarray:
        """Returns the chart points (n, d) of MuJoCo's states (n, S)."""
        return state[:, self.places] + self.offset

    def terms(self, z: np.ndarray) -> np.ndarray:
        """Returns terms (n, t) of chart points (n, d), of which much that follows the place is a sum."""
        turns = [i for i, c in enumerate(self.coordinates) if c.unit == "rad"]
        waves = [wave(z[:, i]) for i in turns for wave in (np.sin, np.cos)]
        products = [a * b for a, b in combinations(waves, 2)]
        return np.column_stack([np.ones(len(z)), z, (z**2).sum(axis=1), *waves, *products])

    def state_at(self, z: np.ndarray) -> np.ndarray:
        """Returns MuJoCo's states (n, S) in which runs begin at chart points (n, d)."""
        states = np.tile(self.state, (len(z), 1))
        states[:, self.places] = z - self.offset
        return states
