"""The task: a robot with a problem, measurement noise, and ways that runs can go."""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from itertools import compress
from typing import Any, Self

import numpy as np

from hyrl_mj.errors import BadInput, check_bound
from hyrl_mj.files.artifacts import digest
from hyrl_mj.physics import mjcf
from hyrl_mj.tasks.description import Mirror, Scene
from hyrl_mj.tasks.guard import guard
from hyrl_mj.tasks.obstacles import (
    ANY,
    islands,
    number_of,
    pattern_of,
    sides_of_paths,
    way_name,
)
from hyrl_mj.tasks.problem import Problem


class Task(Problem):
    """A robot and its problem: the base class of the files in `hyrl_mj/tasks`.

    A task is stateless, and nothing writes to it. Its methods take batches: measurements (n, p), chart
    points (n, d), inputs (n, m), in the units of the MJCF. Read geometry and limits from the compiled model.

    An error in a method, or a result of a wrong shape, becomes a `BadInput` that names the method and the
    state; so does an observation or a chart point that is not finite.
    """

    #: the id in Gymnasium, by default `hyrl_mj/<class>-v0`
    env_id: str
    #: a text from which the task is made again, if it has neither a name nor a file
    spec: str = ""
    _digest: str = ""
    #: one line for `hyrl-mj list`
    description: str = ""
    #: the mirror symmetry of observation, inputs and reward, if there is one (paper, Section IV-B)
    mirror: Mirror | None = None
    #: what replays and figures show
    scene: Scene
    #: what its sensors do, as "uniform 0.05 + delay 1"; "" if they add noise of the bound alone
    sensor: str = ""
    #: shares (p,) of that noise on the columns of the measurement, where they are not those of `noisy`
    sensor_shares: tuple[float, ...] = ()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        guard(cls)

    def __repr__(self) -> str:
        coordinates, inputs = ", ".join(self.chart.names), ", ".join(self.inputs)
        return f"<Task {self.name}: chart ({coordinates}), inputs ({inputs})>"

    @cached_property
    def code(self) -> str:
        """SHA-256 of the files of a user's task, as they were read; "" for one of this package."""
        if self.source is None:
            return ""
        read = mjcf.origin(self.model)
        of_model = digest(self.model_path) if read is None else read[1]
        return f"{self._digest[:32]}{of_model[:32]}"

    def __copy__(self) -> Self:
        task = object.__new__(type(self))
        vars(task).update(vars(self))
        return task

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return copy(self)  # but for its own attributes nothing is written to

    def noise_in_chart(self, bound: float, everywhere: bool = False) -> np.ndarray:
        """Returns the largest error (d,) of a measured chart point, by coordinate."""
        d = self.chart.dimension
        return bound * (np.ones(d) if everywhere else np.array(self.noisy[:d], dtype=float))

    def for_mode(self, mode: int) -> Self:
        """Returns the task as stage 6 trains the policy of a mode on it, by default the task itself.

        A task whose reward can tell the ways apart returns a copy that rewards the way of the mode, wherever
        the robot is. Otherwise a mode earns its reward on its own part of the chart only.
        """
        return self

    def noisy_everywhere(self) -> Self:
        """Returns this task with noise of the whole bound on every column of the measurement."""
        return self.with_noise((True,) * len(self.noisy))

    def with_noise(self, shares: Sequence[float]) -> Self:
        """Returns this task with other shares (p,) of the noise bound on the columns of the measurement."""
        task = copy(self)
        task.noisy = tuple(shares)
        return task

    def with_sensor(self, sensor: str, shares: Sequence[float]) -> Self:
        """Returns this task with a sensor and shares (p,) of the noise bound that cover all that it does.

        The sensor's own noise keeps the shares that the noise has had so far; see `hyrl_mj.Sensor`.
        """
        task = self.with_noise(shares)
        task.sensor, task.sensor_shares = sensor, self.sensor_shares or tuple(self.noisy)
        return task

    def noise_on(self, everywhere: bool = False) -> tuple[str, str]:
        """Returns the chart coordinates that noise acts on, and their unit: "x and y", "m"."""
        noisy = self.noise_in_chart(1.0, everywhere) > 0
        units = dict.fromkeys(compress(self.chart.units, noisy))
        return " and ".join(compress(self.chart.names, noisy)), ", ".join(units)

    def check_noise(self, bound: float, everywhere: bool = False) -> float:
        """Returns the noise bound, if measurements can still tell states apart.

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

    #: the axes of the world (0 x, 1 y, 2 z) that span the plane of `where`
    plane: tuple[int, int] = (0, 1)

    def where(self, measured: np.ndarray) -> np.ndarray:
        """Returns the positions (n, 2) in the plane in which runs pass the obstacles [m].

        By default these are the first two coordinates of the chart.
        """
        return self.z(measured)[:, :2]

    @cached_property
    def obstacles(self) -> dict[str, int]:
        """The obstacles that runs pass, by name, each with the id of a geom; see `islands`."""
        return islands(self.model)

    @property
    def gives_direction(self) -> bool:
        """Whether the task says itself, by `direction`, which way runs go."""
        return type(self).direction is not Task.direction

    def direction(self, path: np.ndarray) -> np.ndarray:
        """Returns which way runs went: a task that defines this method numbers its ways itself.

        By default a way passes each obstacle between start and end on its left or on its right, as the
        angles tell through which runs turn about the obstacles. The stages follow these angles during the
        simulation; this method does so from a path of chart points, with all else at its usual values.

        Args:
            path: (K + 1, n, d) chart points over time, not wrapped; a run that ended stays put.

        Returns:
            (n,) int: the mode whose way the run went, -1 where there was nothing to decide.
        """
        z = path.reshape(-1, path.shape[2])
        plant = self.placed(z)
        places = self.where(plant.measurement).reshape(*path.shape[:2], 2)
        centres = plant.geom_positions(list(self.obstacles.values()))[..., list(self.plane)]
        if len(centres) == len(z):  # some of them move
            centres = centres.reshape(*path.shape[:2], -1, 2)
        pattern = sides_of_paths(places, centres)
        return np.where((pattern == ANY).all(axis=1), ANY, number_of(pattern))

    def mode_name(self, mode: int) -> str:
        """Returns the number of a mode with its name: "0 (left)", "1 (right of a, left of b)"."""
        names = [] if self.gives_direction else list(self.obstacles)
        if self.gives_direction or (self.scene.mode_names and len(names) == 1):
            return self.scene.mode_name(mode)
        return f"{mode} ({way_name(pattern_of(mode, len(names)), names)})"

    def colour_of(self, mode: int, modes: Sequence[int]) -> int:
        """Returns which of the colours replays draw a mode in: by default its place among all modes."""
        return sorted(modes).index(mode)

    def tinted(self, mode: int) -> tuple[str, ...]:
        """Returns the names of the geoms that replays draw in the colour of a mode, by default none."""
        return ()


def at_levels(task: Task, actions: np.ndarray) -> np.ndarray:
    """Returns the inputs (n, m) of a discrete task for the numbers of its levels (n,) int.

    Raises:
        BadInput: a number that is not an integer, or not of a level.
    """
    levels, actions = task.input_levels, np.asarray(actions)
    assert levels is not None
    integers = np.issubdtype(actions.dtype, np.integer)
    wrong = actions[(actions < 0) | (actions >= len(levels))] if integers else actions
    if wrong.size:
        allowed = f"{task.name} takes integers from 0 to {len(levels) - 1}"
        raise BadInput(f"action {wrong.flat[0]} cannot be used: {allowed}")
    return levels[actions]
