"""The robot of a task: its model, the plant that steps copies of it, its inputs and what it measures."""

from abc import ABC
from collections.abc import Sequence
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import mjcf
from hyrl_mj.physics.plant import Plant, input_limits
from hyrl_mj.tasks.description import Abilities, Learning


class Robot(ABC):
    """A robot: an MJCF with the inputs of a policy, and a measurement."""

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
        """Returns n copies of the robot, stepped by a number of threads, 0 for one on every core."""
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
        return type(self).control is not Robot.control

    def state(
        self, z: np.ndarray, rng: np.random.Generator | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Returns the full state of chart points (n, d): qpos (n, nq) and qvel (n, nv), None at rest.

        By default the chart points are the positions. `rng` draws the coordinates that the chart does not
        hold, as a start distribution would; without it they have their usual values.
        """
        return z, None
