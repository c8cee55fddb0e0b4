"""The task: a robot with a problem, measurement noise, and ways that runs can go."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from itertools import compress, product
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput, check_bound, listed
from hyrl_mj.files.artifacts import digest
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.plant import Plant, input_limits
from hyrl_mj.sets import Chart
from hyrl_mj.tasks.description import Abilities, Effort, FullState, Learning, Mirror, Outcome, Scene
from hyrl_mj.tasks.guard import guard
from hyrl_mj.tasks.motion import begins_anew, ends_well, largest_moves
from hyrl_mj.tasks.obstacles import (
    ANY,
    islands,
    number_of,
    pattern_of,
    sides_of_paths,
    way_name,
)


class Task(ABC):
    """A robot and its problem: the base class of the files in `hyrl_mj/tasks`.

    A task is stateless, and nothing writes to it. Its methods take batches: measurements (n, p), chart
    points (n, d), inputs (n, m), in the units of the MJCF. Read geometry and limits from the compiled model.

    An error in a method, or a result of a wrong shape, becomes a `BadInput` that names the method and the
    state; so does an observation or a chart point that is not finite.
    """

    #: the task's name, also that of its MJCF `models/<name>.xml`
    name: str
    #: the file that defines the task, None for one of this package
    source: Path | None = None
    #: names of the actuators that the policy drives
    inputs: tuple[str, ...]
    #: units of the inputs; none of them if empty
    input_units: tuple[str, ...] = ()
    #: share of the noise bound that acts on each column of the measurement: 0 or False, 1 or True, or
    #: another number where a column has another unit. The first d columns are those of the chart
    noisy: tuple[float, ...]
    #: whether `control` depends on the inputs alone: it is then asked once for all physics steps of a sample
    steady_control: bool = False
    #: what its plant can do
    abilities: Abilities = Abilities()
    #: what trains it by default
    learning: Learning = Learning()
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

    # ---- the robot

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled MJCF (shared: do not write to it)."""
        return mjcf.load(self.model_path)

    @property
    def model_path(self) -> Path:
        """The MJCF, `<name>.xml`: beside the file that defines the task, else in `models`."""
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
        """The inputs of a discrete task, (levels, m); None for continuous inputs.

        With several inputs these are all combinations of their levels; the last input varies fastest.
        """
        levels = self.learning.levels
        if levels is None:
            return None
        axes = [
            np.linspace(low, high, levels) for low, high in zip(*self.input_limits, strict=True)
        ]
        return np.array(list(product(*axes)))

    def draw_inputs(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Returns random inputs (n, m) within their limits."""
        return rng.uniform(*self.input_limits, (n, len(self.inputs)))

    @property
    def measurement_columns(self) -> int:
        """p, the number of columns of the measurement."""
        return len(self.noisy)

    def plant(self, n: int, threads: int = 0) -> Plant:
        """Returns n copies of the robot, stepped by a number of threads, 0 for one on every core.

        A task whose plant is something else returns that here, with the public methods of `Plant`.
        """
        control = self.control if self.has_inner_loop else None
        return Plant(
            self.model, self.inputs, n, threads,
            measure=self.measure, control=control, mocap=self.mocap, steady=self.steady_control,
        )  # fmt: skip

    def placed(self, z: np.ndarray, rng: np.random.Generator | None = None) -> Plant:
        """Returns a copy of the robot at each chart point z (n, d), in the full states of `state`."""
        plant = self.plant(len(z))
        plant.set_state(*self.state(z, rng))
        return plant

    def tabulating(self, n: int) -> Any:
        """Returns n copies of the robot that are put to states, for a sample or a few from each."""
        return self.plant(n)

    def verify(  # noqa: B027 - most plants are what they are taken for
        self, z0: np.ndarray, runs: Any, rows: Sequence[int] | np.ndarray
    ) -> None:
        """Plays runs again on the real thing, where the plant is only thought to be like it.

        Args:
            z0: (n, d) starts.
            runs: a recorded `Rollout` of n runs.
            rows: numbers (k,) of the runs that are played again.

        Raises:
            BadInput: a run goes another way there; the message names quantity, sample and both values.
        """

    def check_measurement(self, measured: np.ndarray) -> np.ndarray:
        """Returns a measurement as a float array (n, p).

        Raises:
            BadInput: wrong shape or not finite.
        """
        measured = np.asarray(measured, dtype=float)
        if measured.ndim != 2 or measured.shape[1] != self.measurement_columns:
            raise BadInput(
                f"a measurement of {self.name} has shape (n, {self.measurement_columns}), "
                f"got {measured.shape}"
            )
        # For the single measurement of a robot at work `all()` takes three times as long.
        finite = np.isfinite(measured)
        if np.count_nonzero(finite) < measured.size:
            row, column = np.argwhere(~finite)[0]
            value = measured[row, column]
            raise BadInput(f"measurement[{row}, {column}] is {value}, it must be finite")
        return measured

    def measure(self, sensors: np.ndarray) -> np.ndarray:
        """Returns the measurement (n, p) of the sensors' values (n, sensors), by default these."""
        return sensors

    def control(self, u: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Returns the controls (n, nu) of all actuators: the inner loop, at the rate of the physics.

        It sees the policy's inputs u (n, m) and the true state qpos (n, nq), qvel (n, nv). By default there
        is none. A task that has one gives names of MJCF numerics as `inputs`; they hold the limits.
        """
        return u

    def mocap(self, qpos: np.ndarray) -> np.ndarray:
        """Returns where the k mocap bodies are while the joints are at positions qpos (n, nq).

        These are positions (n, k, 3) [m], or poses (n, k, 7) that end in a quaternion, in the order of the
        MJCF. By default the bodies stay. A body that moves by itself follows a joint that a constant rate
        turns, as a clock; `state` sets this joint, and a sensor measures it.
        """
        frames = mjcf.mocap_frames(self.model)
        return np.broadcast_to(frames, (len(qpos), *frames.shape))

    @property
    def has_inner_loop(self) -> bool:
        """Whether the task defines `control`, between the policy and the actuators."""
        return type(self).control is not Task.control

    def state(self, z: np.ndarray, rng: np.random.Generator | None = None) -> FullState:
        """Returns the full state of chart points (n, d): qpos (n, nq) and qvel (n, nv), None at rest.

        By default the chart points are the positions. `rng` draws the coordinates that the chart does not
        hold, as a start distribution would; without it they have their usual values.
        """
        return z, None

    # ---- the problem

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
        return largest_moves(self, inertia=not self.kinematic)

    @cached_property
    def ends_well(self) -> bool:
        """Whether `ending` calls some states REACHED, on the chart or beside it."""
        return ends_well(self)

    @property
    def tells_arrival(self) -> bool:
        """Whether an episode ends where it arrives, so that how long it lasts tells when that was."""
        return self.abilities.arrival_ends and (
            type(self).plant is not Task.plant or self.ends_well
        )

    @cached_property
    def set_point(self) -> np.ndarray | None:
        """The goal, a chart point (d,), if it is a single one."""
        return None

    def z(self, measured: np.ndarray) -> np.ndarray:
        """Returns the chart points (n, d) of measurements (n, p), by default the first d columns."""
        return measured[:, : self.chart.dimension]

    def at(self, z: np.ndarray) -> np.ndarray:
        """Returns the measurements (n, p) of a robot at chart points z (n, d), without noise."""
        if self.measurement_columns == self.chart.dimension:  # nothing else is measured
            return self.with_z(z, z)
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
        """Returns the `Outcome` (n,) int of episodes that still ran when they were truncated.

        By default those at the set-point are REACHED, and none where `ending` says which have arrived: before
        its goal line a robot may be `close` by a `miss` that only looks to the side.
        """
        if self.ends_well:
            return np.full(len(measurement), Outcome.STALLED)
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
        """Returns (n,) bool: whether chart points (n, d) lie in the box of starts, or whole turns off it."""
        low, high, slack = np.array(self.start_low), np.array(self.start_high), 1e-9
        middle = (low + high) / 2
        off = np.abs(self.chart.difference(z, middle))
        return np.asarray((off <= (high - low) / 2 + slack).all(axis=1))

    # ---- what tells it from others, and its noise

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
        """Returns the chart coordinates that noise acts on, and the unit of its bound: "x and y", "m"."""
        shares = self.noise_in_chart(1.0, everywhere)
        whole = shares == (1 if (shares == 1).any() else shares.max())
        units = dict.fromkeys(compress(self.chart.units, whole))
        return listed([*compress(self.chart.names, shares > 0)]), ", ".join(units)

    def noise_text(self, bound: float, everywhere: bool = False) -> str:
        """Returns what noise of a bound does to the chart, as "0.1 m on x and y, 0.05 rad on heading"."""
        shares = self.noise_in_chart(1.0, everywhere)
        names: dict[str, list[str]] = {}
        for share, unit, name in zip(shares, self.chart.units, self.chart.names, strict=True):
            if share:
                names.setdefault(f"{bound * share:g} {unit}", []).append(name)
        return ", ".join(f"{size} on {listed(on)}" for size, on in names.items())

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
                f"give an eps below {limits.min():.3g} {self.chart.units[int(limits.argmin())]}"
            )
        return float(bound)

    # ---- the ways that runs can go

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
