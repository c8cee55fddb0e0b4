"""The real thing as judge: episodes are played again by plain MuJoCo, which nothing of the plant touches."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import mjcf
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation.rollout import LoopSettings, Rollout, closed_loop
from hyrl_mj.tasks import Outcome, Task

# Largest difference of a value, of values below 1, else as a share of them. The same code of MuJoCo computes
# both; but the plant reads some sensors from the state, in which quaternions may be 1e-9 too long or short,
# and NumPy rounds the methods of a task otherwise in batches of another size. Nothing that lags, leaks or is
# held is as near as this. How episodes end has no tolerance.
ROUNDING = 1e-8
# The longest duration of episodes that are tried [samples].
SAMPLES = 40


def judge(
    task: Task,
    run: Rollout,
    start: tuple[np.ndarray, np.ndarray | None],
    rows: Sequence[int] | np.ndarray | None = None,
) -> int:
    """Plays recorded inputs again in MuJoCo, and compares each sample with what the plant made of them.

    The model is compiled anew from the task's MJCF. Each episode has the simulation for itself, while the
    plant simulated it among others. Measurement, observation, reward and end are compared; the task is asked
    about whole episodes, and about single samples, while the closed loop asked it about all episodes at once.

    Args:
        task: a task whose robot is an MJCF.
        run: n episodes that were recorded.
        start: qpos (n, nq) and qvel (n, nv) at the starts, None at rest, as `Task.state` gives them.
        rows: the episodes that are judged, by default all.

    Returns:
        The number of episodes that were judged.

    Raises:
        BadInput: something differs; the message names the quantity, the sample, and both values.
    """
    model = fresh_model(task)
    data = mujoco.MjData(model)
    judged = np.arange(len(run.length)) if rows is None else np.asarray(rows, dtype=int)
    seen = _seen(task, run, judged)
    for number, row in enumerate(judged):
        k, outcome = int(run.length[row]), Outcome(run.outcome[row])
        qpos, qvel = (None if values is None else values[row] for values in start)
        assert qpos is not None
        mine, broke = _played(task, model, data, qpos, qvel, run.u[:k, row])
        if broke != (k if outcome == Outcome.UNSTABLE else None):
            lasted = "runs on" if broke is None else "becomes unstable"
            raise _differs(task, run, row, "the end", broke or k, outcome.label, lasted)
        theirs = tuple(values[: k + 1, number] for values in seen)
        # The first two are shown to the task sample by sample, and not whole.
        _compare(task, run, row, theirs, mine, alone=number < 2)
    return len(judged)


@dataclass(frozen=True)
class _AnyInputs:
    """A policy that draws its inputs, between the limits or among the levels of a task."""

    task: Task
    rng: np.random.Generator
    draws: bool = True

    def act(self, measured: np.ndarray) -> np.ndarray:
        levels, shape = self.task.input_levels, (len(measured), len(self.task.inputs))
        if levels is not None:
            return levels[self.rng.integers(len(levels), size=len(measured))]
        return self.rng.uniform(*self.task.input_limits, shape)


def judge_task(task: Task) -> int:
    """Judges episodes under random inputs from starts of a task, before anything is made of it.

    Returns:
        The number of episodes that were judged; 0 of a task whose robot is no MJCF.

    Raises:
        BadInput: something differs, as in `judge`.
    """
    if type(task).plant is not Task.plant:
        return 0
    rng = np.random.default_rng(0)
    z = task.starts(50, rng)
    settings = LoopSettings(
        min(task.max_steps, SAMPLES), record=True, states=False, vary=True, quiet=True
    )
    run = closed_loop(task, PolicyController(_AnyInputs(task, rng)), z, settings=settings)
    start = task.state(z, settings.rng_of_starts(0))
    return judge(task, run, start, np.arange(len(z))[::-1])


def judge_beginning(
    task: Task, run: Rollout, start: tuple[np.ndarray, np.ndarray | None], rows: np.ndarray
) -> None:
    """Judges the first samples of some of the episodes (k,), in which nothing has grown from a rounding.

    Raises:
        BadInput: something differs, as in `judge`.
    """
    cut = run.length > SAMPLES
    beginning = replace(
        run,
        length=np.minimum(run.length, SAMPLES),
        limit=np.where(cut, 10**9, run.limit),  # longer than any episode
        outcome=np.where(cut, Outcome.RUNNING, run.outcome),
        true=run.true[: SAMPLES + 1],
        u=run.u[:SAMPLES],
    )
    judge(task, beginning, start, rows)


def fresh_model(task: Task) -> mujoco.MjModel:
    """Returns the task's MJCF compiled anew, or if no file holds its model a copy of that."""
    read = mjcf.origin(task.model)
    if read is None:
        return copy.copy(task.model)
    path, digest = read
    if not path.is_file() or mjcf.file_digest(path) != digest:
        raise BadInput(
            f"{path} has changed since the task {task.name} was made of it: make the task again"
        )
    return mujoco.MjModel.from_xml_path(str(path))


def _played(
    task: Task,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    qpos: np.ndarray,
    qvel: np.ndarray | None,
    inputs: np.ndarray,
    wary: bool = False,
) -> tuple[np.ndarray, int | None]:
    """Plays inputs (K, m) from a start.

    Only if `wary` each sample is looked at for a bad state, which takes as long as the sample itself: an
    episode in which MuJoCo met one is played again so.

    Returns:
        The measurements (K + 1, p), and the sample at which the simulation diverges, None if it does not.
    """
    mujoco.mj_resetData(model, data)
    data.qpos[:] = qpos
    data.qvel[:] = 0.0 if qvel is None else qvel
    mujoco.mj_normalizeQuat(model, data.qpos)
    if model.nkey:
        data.time = model.key_time[0]
        data.ctrl[:] = model.key_ctrl[0]
        data.act[:] = model.key_act[0]
    loop = task.has_inner_loop
    columns = (
        [] if loop else [model.actuator_ctrladr[model.actuator(name).id] for name in task.inputs]
    )
    steps = mjcf.substeps(model)
    _move_mocap(task, model, data)
    sensed = [_sensed(model, data)]
    for k, u in enumerate(np.clip(inputs, *task.input_limits)):
        for _ in range(steps):
            if loop:
                state = data.qpos[None].copy(), data.qvel[None].copy()
                data.ctrl[:] = task.control(u[None].copy(), *state)
            else:
                data.ctrl[columns] = u
            mujoco.mj_step(model, data)
            _move_mocap(task, model, data)
        if wary and _is_bad(data):
            return task.measure(np.array(sensed)), k + 1
        sensed.append(_sensed(model, data))
    if not wary and _is_bad(data):
        return _played(task, model, data, qpos, qvel, inputs, wary=True)
    return task.measure(np.array(sensed)), None


def _move_mocap(task: Task, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    if model.nmocap:
        (poses,) = mjcf.mocap_poses(model, task.mocap, data.qpos[None].copy())
        data.mocap_pos[:], data.mocap_quat[:] = poses[:, :3], poses[:, 3:]


def _sensed(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Returns what the sensors measure in the present state, without a trace of having asked."""
    before = data.qacc_warmstart.copy()
    mujoco.mj_forward(model, data)
    data.qacc_warmstart[:] = before  # the next step begins its search where it would have begun
    return data.sensordata.copy()


def _is_bad(data: mujoco.MjData) -> bool:
    """Returns whether MuJoCo calls the state bad, or has reset one because it was."""
    good = all((np.abs(values) <= mujoco.mjMAXVAL).all() for values in (data.qpos, data.qvel))
    kinds = mujoco.mjtWarning
    resets = kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC
    return not good or any(data.warning[int(kind)].number for kind in resets)


def _seen(task: Task, run: Rollout, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns what the closed loop sees of some episodes (r,), which it asks for all at once, by sample.

    Returns:
        Measurements (K + 1, r, p), observations (K + 1, r, k), and rewards (K + 1, r) of the samples before;
        the last two are NaN after the end of an episode, and there is no reward at the start.
    """
    true = run.true[:, rows]
    samples, r = true.shape[:2]
    observations = np.full((samples, r, len(task.observation_low)), np.nan)
    rewards = np.full((samples, r), np.nan)
    broken = run.outcome[rows] == Outcome.UNSTABLE
    for k in range(samples):
        at = np.flatnonzero(k <= run.length[rows] - broken)
        if len(at):
            observations[k, at] = task.observation(true[k, at])
        if k and len(at):
            rewards[k, at] = task.reward(true[k, at], run.u[k - 1, rows[at]])
    return true, observations, rewards


def _compare(
    task: Task,
    run: Rollout,
    row: int,
    theirs: tuple[np.ndarray, ...],
    mine: np.ndarray,
    alone: bool,
) -> None:
    """Compares what the closed loop saw of an episode with its measurements (k + 1, p) in plain MuJoCo."""
    (measured, observed, rewards), k = (values[: len(mine)] for values in theirs), len(mine) - 1
    _check(task, run, row, "measurement", measured, mine)
    _check(task, run, row, "observation", observed, _asked(task.observation, alone, mine))
    if k:
        mine_rewards = _asked(task.reward, alone, mine[1:], run.u[:k, row])
        _check(task, run, row, "reward", rewards[1:], mine_rewards, first=1)
    ends = _asked(task.ending, alone, mine)
    if k == run.limit[row] and ends[-1] == Outcome.RUNNING:  # the episode was cut off
        ends[-1] = task.verdict(mine[-1:])[0]
    expected = np.full(k + 1, Outcome.RUNNING)
    if k == run.length[row]:  # otherwise the simulation diverged after that
        expected[-1] = run.outcome[row]
    if (wrong := np.flatnonzero(ends != expected)).size:
        at = int(wrong[0])
        ended, real = (Outcome(values[at]).label for values in (expected, ends))
        raise _differs(task, run, row, "the end", at, ended, real)


def _asked(method: Callable[..., np.ndarray], alone: bool, *values: np.ndarray) -> np.ndarray:
    """Returns what a method of a task gives for rows of arrays, all at once, or each alone."""
    if not alone:
        return method(*values)
    return np.concatenate(
        [method(*(rows[i : i + 1] for rows in values)) for i in range(len(values[0]))]
    )


def _check(
    task: Task,
    run: Rollout,
    row: int,
    name: str,
    theirs: np.ndarray,
    mine: np.ndarray,
    first: int = 0,
) -> None:
    """Raises `BadInput` where values (k, ...) of an episode differ by more than rounding."""
    theirs, mine = (np.reshape(values, (len(mine), -1)) for values in (theirs, mine))
    near = np.abs(theirs - mine) <= ROUNDING * np.maximum(np.abs(mine), 1.0)
    if not near.all():
        k, column = np.argwhere(~near)[0]
        what = f"{name}[{column}]" if mine.shape[1] > 1 else f"the {name}"
        values = (f"{float(v[k, column]):.12g}" for v in (theirs, mine))
        raise _differs(task, run, row, what, int(k) + first, *values)


def _differs(
    task: Task, run: Rollout, row: int, what: str, sample: int, ours: str, real: str
) -> BadInput:
    start = task.chart.format(task.z(run.true[0, [row]])[0])
    return BadInput(
        f"{task.name} is not simulated as MuJoCo alone simulates it: from {start} {what} at sample {sample} "
        f"is {ours}, and {real} where the same inputs are played again in a simulation of its own; something "
        "keeps a memory between episodes or copies, depends on the others of a batch, or has written to the "
        "model"
    )
