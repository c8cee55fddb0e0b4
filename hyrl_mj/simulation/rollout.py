"""The closed loop of task, noise and controller, for many starts at once."""

from dataclasses import dataclass, replace
from typing import Any

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
        states: whether to keep MuJoCo's states, too, if the others are kept.
        vary: whether to draw the coordinates outside the chart at random, as in training.
        plant: n copies of the task's robot to use again; by default new ones.
        label: label of the progress bar.
        quiet: show no progress bar.
    """

    steps: int | None = None
    backward: bool = False
    passing: bool = False
    record: bool = False
    states: bool = True
    vary: bool = False
    plant: Plant | None = None
    label: str = "simulating"
    quiet: bool = False

    def rng_of_starts(self, seed: int) -> np.random.Generator | None:
        """Returns the generator of the coordinates outside the chart, None if they are not drawn."""
        return np.random.default_rng([seed, 1]) if self.vary else None


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
        true: (K + 1, n, p) measurements without noise.
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
    true: np.ndarray
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
    if task.side_by_side is not None and len(z0) > task.side_by_side:
        return _in_turns(task, controller, z0, noise, q0, seed, settings)
    limit = task.max_steps if settings.steps is None else settings.steps
    backward, record, n = settings.backward, settings.record, len(z0)
    plant = settings.plant or task.plant(n)
    plant.set_state(*task.state(z0, settings.rng_of_starts(seed)))
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
    true = [measurement] if record else []
    states = [plant.state] if record and settings.states else []
    follower = Follower(task, plant) if settings.passing else None
    for k in progress_bar(range(limit), settings.label, "samples", quiet=settings.quiet):
        active = np.flatnonzero(outcome == Outcome.RUNNING)
        if not len(active):
            break
        now = Sample(np.arange(n), np.full(n, k), measurement, q, plant, past)
        measured = plant.observe(measurement, drawn(signal, now), np.arange(n))
        if plant.late:  # what the last step came to is known only now
            outcome[active] = task.outcome(plant.truth[active], plant.unstable[active])
            active = np.flatnonzero(outcome == Outcome.RUNNING)
            if not len(active):
                break
        if k == 0 and (fresh := q == NOT_STARTED).any():
            q[fresh] = controller.initial_mode(measured[fresh])
            first_mode = q.copy()
        before, u = q.copy(), np.full((n, len(task.inputs)), np.nan)
        u[active], q[active] = ask(k, q[active], measured[active], past[active])
        past = remembering(past, measured)
        (plant.step_backward if backward else plant.step)(u[active], active)
        measurement, last, lost = plant.truth, measurement, plant.unstable
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
            true.append(measurement)
        if states:
            states.append(np.where(lost[:, None], states[-1], plant.state))
    if plant.late and not backward:
        going = outcome == Outcome.RUNNING
        outcome[going] = task.outcome(plant.measurement[going], plant.unstable[going])
        measurement = plant.truth
    ask.again()
    if not backward:
        late = outcome == Outcome.RUNNING
        outcome[late] = task.verdict(measurement[late])
    plant.end()
    arrays = {k: np.array(values).reshape(-1, n, *shapes[k]) for k, values in kept.items()}
    arrays |= {k: arrays[k].astype(int) for k in ("before", "q")}
    path = path[: length.max() + 1]
    passing = None if follower is None else follower.passing
    return Rollout(
        path, length, outcome, first_mode, **arrays,
        true=np.array(true), state=np.array(states), passing=passing,
    )  # fmt: skip


def _in_turns(
    task: Task,
    controller: Controller,
    z0: np.ndarray,
    noise: AnyNoise | None,
    q0: np.ndarray | None,
    seed: int,
    settings: LoopSettings,
) -> Rollout:
    """Runs the closed loop from some starts after the other, as many at once as the task can."""
    n, size = len(z0), task.side_by_side
    assert size is not None
    parts, signal = [], signal_for(noise, task, controller)
    # Those that are over before they begin come last: they take no time.
    order = np.argsort(~task.goes_on(z0), kind="stable")
    turns = range(0, n, size)
    for first in progress_bar(turns, settings.label, "turns", quiet=settings.quiet):
        rows = order[first : first + size]
        begun = None if q0 is None else np.asarray(q0)[rows]
        quiet = replace(settings, quiet=True, plant=None)
        some = signal.for_rows(rows)
        own = seed if not first else int(np.random.SeedSequence([seed, first]).generate_state(1)[0])
        parts.append(closed_loop(task, controller, z0[rows], some, begun, own, quiet))
    return _joined(parts, np.argsort(order))


def _joined(parts: list[Rollout], order: np.ndarray) -> Rollout:
    """Returns the runs of several rollouts as one, in an order (n,)."""
    found: dict[str, Any] = {}
    for name in ("path", "before", "q", "measured", "u", "true", "state"):
        arrays = [getattr(part, name) for part in parts]
        if arrays[0].ndim < 2:  # not recorded
            found[name] = arrays[0]
            continue
        samples = max(map(len, arrays))
        found[name] = np.concatenate([_lasting(a, samples) for a in arrays], axis=1)[:, order]
    for name in ("length", "outcome", "q0"):
        found[name] = np.concatenate([getattr(part, name) for part in parts])[order]
    seen = [part.passing for part in parts if part.passing is not None]
    return Rollout(**found, passing=Passing.joined(seen)[order] if seen else None)


def _lasting(values: np.ndarray, samples: int) -> np.ndarray:
    """Returns values (k, n, ...) of runs, the last ones repeated, for so many samples."""
    more = samples - len(values)
    last = values[-1:] if len(values) else np.zeros((1, *values.shape[1:]), values.dtype)
    return np.concatenate([values, np.repeat(last, more, axis=0)])
