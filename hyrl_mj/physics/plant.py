"""The physics of every task: n copies of a compiled model, stepped side by side."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import memory, mjcf, mujoco_log
from hyrl_mj.ranges import Integer
from hyrl_mj.system import cores, forked

# Sensor values (n, sensors) -> measurement (n, p).
Measure = Callable[[np.ndarray], np.ndarray]
# Inputs (n, m), positions (n, nq), velocities (n, nv) -> controls of all actuators (n, nu).
Control = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
MOST = 2**24  # copies


class Plant:
    """n copies of a MuJoCo model with named inputs, advanced by one controller sample at a time.

    A plant can be pickled and copied, with its states, and goes on in a forked process.

    Args:
        model: the compiled model; the plant keeps a copy of it.
        inputs: names of the actuators that the policy drives, in the order of the columns of u. The
            others hold the control of the model's first keyframe, or zero.
        n: number of copies.
        threads: threads of the physics, 0 for all cores. Results do not depend on it.
        measure: computes the measurement from the sensor values; by default the sensor values.
        mocap: computes the poses of the mocap bodies from the positions of the joints, see
            `mjcf.mocap_poses`, at every physics step; by default they stay where the MJCF puts them.
        control: inner loop that computes the controls of all actuators from u and the true state, at every
            physics step; they are clipped to each actuator's ctrlrange, as MuJoCo does. `inputs` are then
            names of MJCF numerics that hold the limits of u.
        steady: whether the inner loop depends on u alone, so that its controls hold for a whole sample.

    Raises:
        BadInput: the model has no such inputs, a sensor of it holds or delays its values, or this version of
            MuJoCo simulates it wrongly.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        inputs: Sequence[str],
        n: int,
        threads: int = 0,
        *,
        measure: Measure = lambda sensors: sensors,
        control: Control | None = None,
        mocap: mjcf.Mocap | None = None,
        steady: bool = False,
    ):
        if problem := memory.unusable(model):
            raise BadInput(problem)
        n = Integer(1, MOST).checked("the number of copies of a robot", n)
        self.n, self._threads, self._measure, self._control = n, threads, measure, control
        self._mocap = mocap if model.nmocap else None
        self._steady = control is None or steady
        self.model = copy.copy(model)
        # A bad state has to stay visible: MuJoCo would reset it and only count a warning. Inputs are
        # checked here, and clamping would prevent backward steps.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        self.substeps = mjcf.substeps(model)
        self.low, self.high = input_limits(model, inputs, of_actuators=control is None)
        self._columns = [] if control else actuator_columns(model, inputs)
        # MuJoCo clamps the other controls, unless its MJCF says no; without clamping it is done here.
        clamps = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        limited = model.actuator_ctrllimited.astype(bool)[:, None] & clamps
        ranges = np.where(limited, model.actuator_ctrlrange, [-np.inf, np.inf])
        self._ctrl_low, self._ctrl_high = ranges.T
        held = model.key_ctrl[0] if model.nkey else np.zeros(model.nu)
        self._held = np.clip(held, self._ctrl_low, self._ctrl_high)
        self._unstable = np.zeros(n, dtype=bool)
        # Some sensors are read from the state; MuJoCo has to compute others after each step.
        self._columns_of_state = mjcf.state_columns(self.model)
        self._quaternions = mjcf.quaternion_columns(self.model)
        self._stage = mujoco.mjtStage.mjSTAGE_NONE
        if self._columns_of_state is None:
            self._stage = mujoco.mjtStage(int(self.model.sensor_needstage.max()))
        self._open()
        self._drive(np.arange(n))
        if model.nkey:  # a clock measures the time
            self._batch.bind("time")[:] = model.key_time[0]
        if model.nkey and model.na:
            self._batch.bind("act")[:] = model.key_act[0]
        self._initial = self._batch.state[0].copy()

    def _open(self, state: np.ndarray | None = None) -> None:
        """Makes the copies of the model, in states (n, nstate), by default the initial one."""
        from mujoco.batch import Batch  # slow to import

        mujoco_log.install()
        try:
            self._batch = Batch(self.model, self.n, self._threads or cores.count())
        except ValueError as error:
            raise BadInput(
                f"MuJoCo cannot simulate copies of {mjcf.model_name(self.model)} side by side ({error}): "
                "leave that out of its MJCF"
            ) from error
        forked.own(self._batch)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl = self._batch.bind("ctrl")
        self._mocap_pos, self._mocap_quat = map(self._batch.bind, ("mocap_pos", "mocap_quat"))
        self._geom_positions: np.ndarray | None = None
        self._warned = np.zeros(self.n, dtype=int)  # how often of bad accelerations
        if self._columns_of_state is None:
            self._sensors = self._batch.bind("sensordata")
        if state is not None:
            self._batch.state[:] = state
            self._sense(None)

    def __getstate__(self) -> dict[str, Any]:
        of_batch = (
            "_batch", "_qpos", "_qvel", "_ctrl", "_sensors", "_mocap_pos", "_mocap_quat",
            "_geom_positions",
        )  # fmt: skip
        return {k: v for k, v in vars(self).items() if k not in of_batch} | {"_state": self.state}

    def __setstate__(self, values: dict[str, Any]) -> None:
        state = values.pop("_state")
        vars(self).update(values)
        self._open(state)

    @property
    def measurement(self) -> np.ndarray:
        """The current measurement without noise: (n, p), a copy."""
        return self._measure(self.sensors)

    @property
    def sensors(self) -> np.ndarray:
        """The current values of the sensors, of which `measure` makes the measurement: (n, s), a copy."""
        if self._columns_of_state is None:
            return self._sensors.copy()
        return self._batch.state[:, self._columns_of_state]

    def truth(self, ids: np.ndarray) -> np.ndarray:
        """Returns the `measurement` (k, p) of the copies `ids` (k,); environments tell them apart."""
        return self.measurement[ids]

    def observe(self, true: np.ndarray, noise: np.ndarray, ids: np.ndarray) -> np.ndarray:
        """Returns the noisy measurements (k, p) of true ones (k, p), of the copies `ids` (k,)."""
        return true + noise

    def end(self, ids: np.ndarray | None = None) -> None:
        """Ends the runs `ids` (k,), all by default; environments are told."""

    #: whether what a step came to is known only after `observe`, as where wrappers lie around an environment
    late = False

    @property
    def unstable(self) -> np.ndarray:
        """The copies (n,) bool whose simulation has diverged since `set_state`.

        These copies are reset to the model's initial state; the others are not affected.
        """
        return self._unstable.copy()

    @property
    def warnings(self) -> np.ndarray:
        """How often MuJoCo has warned about each copy: (n,) int."""
        return np.asarray(self._batch.warning[..., 1].sum(axis=1))

    @property
    def qpos(self) -> np.ndarray:
        """Generalised positions: (n, nq), a copy."""
        return self._qpos.copy()

    @property
    def qvel(self) -> np.ndarray:
        """Generalised velocities: (n, nv), a copy."""
        return self._qvel.copy()

    @property
    def state(self) -> np.ndarray:
        """MuJoCo's whole state, rows of `mjSTATE_INTEGRATION`: (n, nstate), a copy."""
        return self._batch.state.copy()

    def resume(self, state: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Lets the copies `ids` (k,), all by default, go on from rows of `state` (k, nstate)."""
        self._wake()
        rows = self._rows(ids)
        self._batch.state[rows] = state
        self._unstable[rows] = False
        self._sense(ids)

    def geom_positions(self, ids: Sequence[int]) -> np.ndarray:
        """Returns the positions of geoms in the world: (n, k, 3) [m], or (1, k, 3) if none of them moves."""
        ids = list(ids)
        if not mjcf.geoms_move(self.model, ids):
            return mjcf.geom_positions(self.model, ids)[None]
        if self._geom_positions is None:  # from now on they are computed after each step
            self._geom_positions = self._batch.bind("geom_xpos")
            if self._stage == mujoco.mjtStage.mjSTAGE_NONE:
                self._stage = mujoco.mjtStage.mjSTAGE_POS
            self._sense(None)
        return self._geom_positions[:, ids]

    def set_state(
        self, qpos: np.ndarray, qvel: np.ndarray | None = None, ids: np.ndarray | None = None
    ) -> None:
        """Sets the state of the copies `ids` (k,), ascending, all by default, and updates their sensors.

        Args:
            qpos: (k, nq) generalised positions.
            qvel: (k, nv) generalised velocities; zero by default.
            ids: indices of the copies.

        Raises:
            BadInput: a wrong shape or a value that is not finite.
        """
        self._wake()
        rows = self._rows(ids)
        qvel = np.zeros((len(rows), self.model.nv)) if qvel is None else qvel
        qpos = checked("qpos", qpos, self.model.nq, rows)
        qvel = checked("qvel", qvel, self.model.nv, rows)
        self._batch.state[rows] = self._initial  # time, activations and warm starts, too
        self._qpos[rows], self._qvel[rows] = qpos, qvel
        for columns in self._quaternions:
            norm = np.linalg.norm(qpos[:, columns], axis=1, keepdims=True)
            if (np.abs(norm - 1) > 1e-9).any():  # MuJoCo takes quaternions of any length
                self._qpos[rows, columns] = qpos[:, columns] / np.maximum(norm, mujoco.mjMINVAL)
        self._ctrl[rows] = self._held
        self._unstable[rows] = False
        self._drive(rows)
        self._sense(ids)

    def step(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Advances the copies `ids` (k,), ascending, all by default, by one sample under inputs u (k, m).

        Raises:
            BadInput: a wrong shape, a value that is not finite, or one outside the input limits.
        """
        self._sample(u, ids)

    def step_backward(self, u: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Reverses `step`: one sample of x' = -f(x, u), for plants with kinematic actuators only.

        Raises:
            BadInput: as `step`, or the plant cannot be run backward.
        """
        if not self.invertible:
            raise BadInput(
                f"the plant {mjcf.model_name(self.model)} cannot be run backward: that takes a "
                "velocity actuator with kv >= 1e6 on every degree of freedom, one to one"
            )
        self._sample(u, ids, sign=-1)

    def coast(self) -> None:
        """Advances all copies by one sample with controls of zero, as an inner loop could give them."""
        self._wake()
        self._advance(np.zeros((self.n, self.model.nu)), None, self.substeps)

    @property
    def invertible(self) -> bool:
        """Whether each degree of freedom has its own velocity actuator, strong and without a memory.

        An inner loop may give these their speeds, from the inputs and the positions. Whether they follow
        depends on the masses, too: `Task.kinematic` tries it.
        """
        model = self.model
        driven = sorted(model.actuator_trnid[:, 0])
        one_to_one = model.nq == model.nv and driven == list(range(model.njnt))
        joints = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)).all()
        follows = -model.actuator_biasprm[:, 2] >= 1e6
        return bool(one_to_one and joints and follows.all() and not memory.remembers(model))

    def _wake(self) -> None:
        """Makes new copies in a forked process: MuJoCo's threads are in the other one."""
        if forked.is_left(self._batch):
            self._open(self._batch.state)

    def _rows(self, ids: np.ndarray | None) -> np.ndarray:
        return np.arange(self.n) if ids is None else ids

    def _sample(self, u: np.ndarray, ids: np.ndarray | None, sign: int = 1) -> None:
        """Advances the copies by one sample; sign -1 reverses all controls."""
        self._wake()
        u = checked_inputs(u, self.low, self.high, self._rows(ids), "the MJCF")
        if self._steady and self._mocap is None:
            self._advance(sign * self._controls(u, ids), ids, self.substeps)
            return
        for left in reversed(range(self.substeps)):
            self._advance(sign * self._controls(u, ids), ids, 1, sense=not left)

    def _controls(self, u: np.ndarray, ids: np.ndarray | None) -> np.ndarray:
        """Returns the controls of all actuators (k, nu) for inputs (k, m)."""
        if self._control is None:
            ctrl = np.tile(self._held, (len(u), 1))
            ctrl[:, self._columns] = u
            return ctrl
        rows = self._rows(ids)
        ctrl = self._control(u, self._qpos[rows], self._qvel[rows])
        ctrl = checked("control", ctrl, self.model.nu, rows)
        return np.clip(ctrl, self._ctrl_low, self._ctrl_high)

    def _drive(self, rows: np.ndarray) -> None:
        """Puts the mocap bodies of the copies `rows` (k,) where their joints' positions say."""
        if self._mocap is not None:
            poses = mjcf.mocap_poses(self.model, self._mocap, self._qpos[rows])
            self._mocap_pos[rows], self._mocap_quat[rows] = poses[..., :3], poses[..., 3:]

    def _advance(
        self, ctrl: np.ndarray, ids: np.ndarray | None, substeps: int, sense: bool = True
    ) -> None:
        self._ctrl[self._rows(ids)] = ctrl
        # Sensors are computed only where they will be read, and after the mocap bodies have moved.
        sense_now = sense and self._mocap is None
        self._batch.step(ids, substeps, self._stage if sense_now else mujoco.mjtStage.mjSTAGE_NONE)
        mujoco_log.say()
        # MuJoCo's own criteria of a bad state, which it would reset: a position or a velocity that is NaN,
        # infinite, or beyond mjMAXVAL, or such an acceleration, of which only the warning tells.
        warned = self._batch.warning[:, int(mujoco.mjtWarning.mjWARN_BADQACC), 1]
        bad = warned != self._warned
        for values in (self._qpos, self._qvel):
            bad |= ~(np.abs(values) <= mujoco.mjMAXVAL).all(axis=1)
        if bad.any():
            self._warned, rows = warned.copy(), np.flatnonzero(bad)
            self._unstable[rows] = True
            self._batch.state[rows] = self._initial
            self._sense(rows)
        if self._mocap is not None:
            self._drive(self._rows(ids))
            if sense:
                self._sense(ids)

    def _sense(self, ids: np.ndarray | None) -> None:
        """Computes what MuJoCo has to compute for sensors of the copies `ids` (k,), None for all."""
        if self._stage != mujoco.mjtStage.mjSTAGE_NONE:
            self._batch.forward(ids, self._stage)


def actuator_columns(model: mujoco.MjModel, names: Sequence[str]) -> list[int]:
    """Returns the columns of ctrl that the named actuators have.

    Raises:
        BadInput: the model has no such actuator, or one has several controls, as a pid or one on a ball may.
    """
    ids = [mjcf.object_id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name) for name in names]
    for name, actuator in zip(names, ids, strict=True):
        if (count := int(model.actuator_ctrlnum[actuator])) != 1:
            raise BadInput(
                f"actuator {name} of {mjcf.model_name(model)} has {count} controls, and an input is one: "
                "give it a single one, or let the task's control() give them, with a numeric as the input"
            )
    return [int(model.actuator_ctrladr[actuator]) for actuator in ids]


def input_limits(
    model: mujoco.MjModel, inputs: Sequence[str], of_actuators: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper limits (m,), (m,) of the inputs, from the MJCF.

    Args:
        model: the compiled model.
        inputs: names of actuators with a `ctrlrange`, or of custom numerics with two values.
        of_actuators: whether the names are those of actuators.

    Raises:
        BadInput: the model has no such actuator or numeric, or it has no limits.
    """
    if of_actuators:
        columns = actuator_columns(model, inputs)
        for name, column in zip(inputs, columns, strict=True):
            if not model.actuator_ctrllimited[column]:
                raise BadInput(f"actuator {name} needs a ctrlrange in the MJCF: its input limits")
        ranges = model.actuator_ctrlrange[columns]
    else:
        ranges = np.array([mjcf.numeric(model, name, 2) for name in inputs])
    return ranges[:, 0], ranges[:, 1]


def checked_inputs(
    u: np.ndarray, low: np.ndarray, high: np.ndarray, rows: np.ndarray, whose: str
) -> np.ndarray:
    """Returns the inputs (k, m) of the copies `rows` (k,), clipped to their limits (m,), which `whose` has.

    Raises:
        BadInput: a wrong shape, a value that is not finite, or one outside the limits.
    """
    u = checked("input", u, len(low), rows)
    excess = 1e-6  # that is tolerated: float32 policies have rounding errors
    wrong = (u < low - excess) | (u > high + excess)
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise BadInput(
            f"input {u[row, column]:g} of simulation {rows[row]} is outside the limits "
            f"[{low[column]:g}, {high[column]:g}] of {whose}"
        )
    return np.clip(u, low, high)


def checked(name: str, values: np.ndarray, columns: int, rows: np.ndarray) -> np.ndarray:
    """Returns the values (k, columns) of the copies `rows` (k,), if they are finite and have that shape."""
    values, shape = np.asarray(values, dtype=float), (len(rows), columns)
    if values.shape != shape:
        raise BadInput(f"{name} has shape {values.shape}, it must be {shape}")
    bad = ~np.isfinite(values)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise BadInput(
            f"{name}[{column}] of simulation {rows[row]} is {values[row, column]}, it must be finite"
        )
    return values
