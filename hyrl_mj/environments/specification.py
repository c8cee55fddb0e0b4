"""What is known of an environment: the values that a task is made of, and when an episode is a success."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.chart import Chart
from hyrl_mj.environments.coordinates import Coordinate
from hyrl_mj.environments.expressions import Expression, Path
from hyrl_mj.environments.instance import Recipe
from hyrl_mj.errors import BadInput
from hyrl_mj.tasks import Outcome

TERMINATED = "terminated"
FORMS = '"terminated and reward >= 1", \'info["solved"]\' or "distance(fingertip, target) <= 0.05"'


@dataclass(frozen=True)
class Criterion:
    """When an episode is a success, and when a failure.

    Both are asked at every sample. A success that asks for `terminated` or for `info` ends the episode; any
    other one has to hold at the end of the episode.

    Attributes:
        name: of the environment, for messages.
        success: the condition of success.
        failure: the condition of failure; by default the environment ends the episode without success.
    """

    name: str
    success: Expression
    failure: Expression | None = None

    @property
    def ends(self) -> bool:
        """Whether a success ends the episode."""
        asks_end = re.search(r"\bterminated\b", self.success.text) is not None
        return bool(self.success.keys) or asks_end

    @property
    def keys(self) -> tuple[Path, ...]:
        """The entries of `info` that it needs."""
        return tuple(dict.fromkeys(key for one in self._conditions for key in one.keys))

    @property
    def places(self) -> tuple[tuple[str, str], ...]:
        """The pairs of names whose distance it needs."""
        return tuple(dict.fromkeys(pair for one in self._conditions for pair in one.places))

    @property
    def _conditions(self) -> tuple[Expression, ...]:
        return (self.success,) if self.failure is None else (self.success, self.failure)

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
        if self.success.text.strip() == TERMINATED and (touches & terminated).any():
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
    """What is known of an environment; `inspect` finds it.

    Attributes:
        recipe: how instances are made, and what they report.
        chart: the coordinates of the decision.
        coordinates: where they lie in MuJoCo's state.
        state: MuJoCo's state (S,) from which runs begin, but for the positions of the chart.
        qpos, qvel: the places (nq,), (nv,) of positions and velocities in a state.
        parts: the number of columns of each part of a Dict, in the order of its space; none of a vector.
        observation_low, observation_high: limits (o,).
        moves: (o,) bool, the columns of an observation at rest that follow the chart.
        affine: a matrix (d + 1, o) that gives what is observed at rest at z from (z, 1), if one does.
        wrapped: whether wrappers lie around the environment.
        low, high: limits (m,) of the inputs.
        inputs: their names.
        levels: number of a discrete action's values; None of continuous ones.
        criterion: of success and failure.
        depth: how deep the robot may be inside of something at a start, as it is in sampled runs [m].
        start_low, start_high: corners (d,) of the box of starts.
        noisy: (d,) share of the noise bound on each coordinate.
        max_steps: samples of an episode.
        dt: time of a sample [s].
        worst_reward: the least reward of sampled runs.
        islands: what can be passed on both sides, by name, each with the id of a geom.
        tracked: the name of what goes farthest in sampled runs.
        memoryless: whether MuJoCo's state is all that runs depend on, as far as trials show.
        found: what was filled in, with the reason, by name.
    """

    recipe: Recipe
    chart: Chart
    coordinates: tuple[Coordinate, ...]
    state: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    parts: Mapping[str, int]
    observation_low: np.ndarray
    observation_high: np.ndarray
    moves: np.ndarray
    affine: np.ndarray | None
    wrapped: bool
    low: np.ndarray
    high: np.ndarray
    inputs: tuple[str, ...]
    levels: int | None
    criterion: Criterion
    depth: float
    start_low: tuple[float, ...]
    start_high: tuple[float, ...]
    noisy: tuple[float, ...]
    max_steps: int
    dt: float
    worst_reward: float
    islands: Mapping[str, int]
    tracked: str
    memoryless: bool
    found: Mapping[str, str]

    @property
    def dimension(self) -> int:
        """d, the number of the chart's coordinates."""
        return len(self.coordinates)

    @property
    def columns(self) -> int:
        """o, the number of columns of an observation."""
        return len(self.observation_low)

    @property
    def name(self) -> str:
        """The name of the environment."""
        return self.recipe.description.name

    def z(self, state: np.ndarray) -> np.ndarray:
        """Returns the chart points (n, d) of MuJoCo's states (n, S)."""
        return state[:, list(self.recipe.noisy)] + self.recipe.offset

    def state_at(self, z: np.ndarray) -> np.ndarray:
        """Returns MuJoCo's states (n, S) in which runs begin at chart points (n, d)."""
        states = np.tile(self.state, (len(z), 1))
        states[:, list(self.recipe.noisy)] = z - self.recipe.offset
        return states
