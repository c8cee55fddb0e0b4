"""The closed loop of task, noise and controller, for many starts at once."""

from dataclasses import dataclass

import numpy as np

from hyrl_mj.plant import Plant
from hyrl_mj.policies import Asked, Controller, nothing_past, remembering
from hyrl_mj.progress import progress_bar
from hyrl_mj.simulation.noise import NOT_STARTED, AnyNoise, Sample, drawn, signal_for
from hyrl_mj.simulation.passing import Follower, Passing
from hyrl_mj.tasks import Outcome, Task


@dataclass(frozen=True)
class LoopSettings:
    """How the closed loop is run.

    Attributes:
        steps: number of samples, by default the task's limit.
        backward: simulate x' = -f(x, u); such runs end with the last sample only.
        passing: whether to follow how the runs pass the obstacles.
        record: whether to keep modes, measurements, inputs and states.
        vary: whether to draw the coordinates outside the chart at random, as in training.
        plant: n copies of the task's robot to use again; by default new ones.
        label: label of the progress bar.
        quiet: show no progress bar.
    """

    steps: int | None = None
    backward: bool = False
    passing: bool = False
    record: bool = False
    vary: bool = False
    plant: Plant | None = None
    label: str = "simulating"
    quiet: bool = False


@dataclass(frozen=True)
class Rollout:
    """Results of n closed-loop runs over at most K samples. A run that ended stays where it ended.

    Attributes:
        path: (K + 1, n, d) true chart points at the samples, periodic coordinates unwrapped.
        length: (n,) samples until the end of each run.
        outcome: (n,) `Outcome`.
        q0: (n,) modes at the start.
        before: (K, n) modes at each sample before a jump. Empty without `record`, like all that follow.
        q: (K, n) modes at each sample after a jump.
        measured: (K, n, p) noisy measurements.
        u: (K, n, m) inputs.
        state: (K + 1, n, nstate) MuJoCo's states.
        passing: how the runs pass the obstacles; None without `passing` in the settings.
    """

    path: np.ndarray
    length: np.ndarray
    outcome: np.ndarray
    q0: np.ndarray
    before: np.ndarray
    q: np.ndarray
    measured: np.ndarray
    u: np.ndarray
    state: np.ndarray
    passing: Passing | None = None


def closed_loop(
    task: Task,
    controller: Controller,
    z0: np.ndarray,
    noise: AnyNoise | None = None,
    q0: np.ndarray | None = None,
    seed: int = 0,
    settings: LoopSettings = LoopSettings(),
) -> Rollout:
    """Runs the closed loop from many starts at once.

    Args:
        task: the robot and its problem.
        controller: the controller that closes the loop.
        z0: (n, d) starts, chart points.
        noise: noise on the measurement; none by default.
        q0: (n,) start modes; where they are `NOT_STARTED`, which is the default, the controller picks them
            from the first measurement.
        seed: seed of the noise; the same seed and n give the same signals whatever the controller.
        settings: duration, direction and what to record.

    Raises:
        BadInput: the noise cannot be used, or the controller has a memory or draws at random.
    """
    limit = task.max_steps if settings.steps is None else settings.steps
    backward, record, n = settings.backward, settings.record, len(z0)
    plant = settings.plant or task.plant(n)
    rng_of_starts = np.random.default_rng([seed, 1]) if settings.vary else None
    plant.set_state(*task.state(z0, rng_of_starts))
    signal = signal_for(noise, task, controller)
    signal.reset(n, np.random.default_rng(seed))
    ask, measurement = Asked(task, controller), plant.measurement
    past = nothing_past(controller, n, measurement.shape[1])
    q = np.full(n, NOT_STARTED) if q0 is None else np.asarray(q0, dtype=int).copy()
    outcome = np.full(n, Outcome.RUNNING) if backward else task.outcome(measurement, plant.unstable)
    length = np.zeros(n, dtype=int)
    path = np.empty((limit + 1, n, task.chart.dimension))
    path[0] = task.chart.near(task.z(measurement), z0)
    first_mode = q.copy()
    shapes = {"before": (), "q": (), "measured": (len(task.noisy),), "u": (len(task.inputs),)}
    kept: dict[str, list[np.ndarray]] = {name: [] for name in shapes}
    states = [plant.state] if record else []
    follower = Follower(task, plant) if settings.passing else None
    for k in progress_bar(range(limit), settings.label, "samples", quiet=settings.quiet):
        active = np.flatnonzero(outcome == Outcome.RUNNING)
        if not len(active):
            break
        now = Sample(np.arange(n), np.full(n, k), measurement, q, plant, past)
        measured = measurement + drawn(signal, now)
        if k == 0 and (fresh := q == NOT_STARTED).any():
            q[fresh] = controller.initial_mode(measured[fresh])
            first_mode = q.copy()
        before, u = q.copy(), np.full((n, len(task.inputs)), np.nan)
        u[active], q[active] = ask(k, q[active], measured[active], past[active])
        past = remembering(past, measured)
        (plant.step_backward if backward else plant.step)(u[active], active)
        measurement, last, lost = plant.measurement, measurement, plant.unstable
        measurement[lost] = last[lost]  # the last one before the simulation became unstable
        path[k + 1] = task.chart.near(task.z(measurement), path[k])
        length[active] = k + 1
        if follower is not None:
            follower.follow(active[~lost[active]])
        if not backward:
            outcome[active] = task.outcome(measurement[active], lost[active])
        if record:
            for name, values in zip(shapes, (before, q.copy(), measured, u), strict=True):
                kept[name].append(values)
            states.append(np.where(lost[:, None], states[-1], plant.state))
    ask.again()
    if not backward:
        late = outcome == Outcome.RUNNING
        outcome[late] = task.verdict(measurement[late])
    arrays = {k: np.array(values).reshape(-1, n, *shapes[k]) for k, values in kept.items()}
    arrays |= {k: arrays[k].astype(int) for k in ("before", "q")}
    path = path[: length.max() + 1]
    passing = None if follower is None else follower.passing
    return Rollout(
        path, length, outcome, first_mode, **arrays, state=np.array(states), passing=passing
    )
