"""The closed loop of task, noise and controller, for many starts at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.policies import Asked, Controller, memory_at_start
from hyrl_mj.simulation.checked_noise import (
    begin_signal,
    check_repeats,
    drawn,
    play_and_begin,
    twin_of,
)
from hyrl_mj.simulation.noise import (
    NOT_STARTED,
    AnyNoise,
    Sample,
    Signal,
    signal_for,
)
from hyrl_mj.simulation.passing import Passing
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Outcome

if TYPE_CHECKING:
    from hyrl_mj.physics.plant import Plant
    from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class LoopSettings:
    """How the closed loop is run.

    Attributes:
        steps: number of samples, of all runs or of each (n,); by default the task's limit.
        backward: simulate x' = -f(x, u); such runs end with the last sample only.
        passing: whether to follow how the runs pass the obstacles.
        record: whether to keep modes, measurements, inputs and states.
        states: whether to keep MuJoCo's states, too, if the others are kept.
        vary: whether to draw the coordinates outside the chart at random, as in training.
        plant: n copies of the task's robot to use again; by default new ones.
        label: label of the progress bar.
        quiet: show no progress bar.
    """

    steps: int | np.ndarray | None = None
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
        limit: (n,) samples after which each run is cut off.
        outcome: (n,) `Outcome`.
        q0: (n,) modes at the start.
        before: (K, n) modes at each sample before a jump. Empty without `record`, like all that follow.
        q: (K, n) modes at each sample after a jump.
        true: (K + 1, n, p) measurements without noise.
        measured: (K, n, p) noisy measurements.
        u: (K, n, m) inputs.
        noise: (K + 1, n, p) of the samples; of the last one, where the task looks at it, else any.
        state: (K + 1, n, nstate) MuJoCo's states.
        passing: how the runs pass the obstacles; None without `passing` in the settings.
    """

    path: np.ndarray
    length: np.ndarray
    limit: np.ndarray
    outcome: np.ndarray
    q0: np.ndarray
    before: np.ndarray
    q: np.ndarray
    true: np.ndarray
    measured: np.ndarray
    u: np.ndarray
    noise: np.ndarray
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
    backward, record, n = settings.backward, settings.record, len(z0)
    limit = np.broadcast_to(task.max_steps if settings.steps is None else settings.steps, n)
    # Where each run takes an environment of its own, the next one begins where one ends.
    most = n if task.abilities.side_by_side is None else task.abilities.side_by_side
    together = n <= most
    plant = settings.plant or task.plant(n)
    plant.set_state(*task.state(z0, settings.rng_of_starts(seed)))
    signal = signal_for(noise, task, controller)
    twin = twin_of(signal, task, controller)
    for one in (signal, twin):
        if one is not None:
            begin_signal(one, n, seed)
    ahead: list[np.ndarray] | None = [] if signal.unseeing and not together else None
    ask, measurement = Asked(task, controller), plant.measurement
    # A run backward has no past that could be remembered.
    memory = np.zeros((n, 0)) if backward else memory_at_start(controller, n)
    q = np.full(n, NOT_STARTED) if q0 is None else np.asarray(q0, dtype=int).copy()
    outcome = np.full(n, Outcome.RUNNING) if backward else task.outcome(measurement, plant.unstable)
    k, length, first_mode = np.zeros(n, dtype=int), np.zeros(n, dtype=int), q.copy()
    p, m, every = len(task.noisy), len(task.inputs), np.arange(n)
    shapes = {"before": (), "q": (), "measured": (p,), "u": (m,), "noise": (p,)}
    kept = {name: _Table(n, shape) for name, shape in shapes.items() if record}
    firsts = {"path": task.chart.near(task.z(measurement), z0)}
    if record:
        firsts |= {"true": measurement} | ({"state": plant.state} if settings.states else {})
    for name, values in firsts.items():
        kept[name] = _Table(n, values.shape[1:])
        kept[name].put(k, every, values)
    passing = Passing.begin(task, plant) if settings.passing else None
    ticks = range(int(limit.max(initial=0))) if together else count()
    for tick in progress_bar(ticks, settings.label, "samples", quiet=settings.quiet):
        active = np.flatnonzero((outcome == Outcome.RUNNING) & (k < limit))[:most]
        if not len(active):
            break
        rows = every if together else active
        now = Sample(rows, k[rows], measurement[rows], q[rows], plant, memory[rows])
        errors = _noise(signal, now, ahead, measurement)
        # Noise of a user's class is drawn twice at first, to see whether its seed decides it.
        if twin is not None and ahead is None and tick < 8:
            if tick == 0:
                play_and_begin(twin, now, n, seed)
            check_repeats(signal, errors, twin, now)
        measured = plant.observe(now.measurement, errors, rows)
        if plant.late:  # what the last step came to is known only now
            outcome[active] = task.outcome(plant.truth(active), plant.unstable[active])
            active = active[outcome[active] == Outcome.RUNNING]
        if (fresh := (now.k == 0) & (now.q == NOT_STARTED)).any():
            first_mode[rows[fresh]] = q[rows[fresh]] = controller.initial_mode(measured[fresh])
        before, on = q[rows], np.searchsorted(rows, active)
        u = np.full((len(rows), len(task.inputs)), np.nan)
        if len(active):
            now_asked = q[active], measured[on], memory[active]
            u[on], q[active], memory[active] = ask(tick, *now_asked)
            (plant.step_backward if backward else plant.step)(u[on], active)
        lost = plant.unstable
        stable = rows[~lost[rows]]  # the others keep the last one before they became unstable
        measurement[stable] = plant.truth(stable)
        path = task.chart.near(task.z(measurement[rows]), kept["path"].values[now.k, rows])
        k[rows] += 1
        kept["path"].put(k[rows], rows, path)
        length[active] = k[active]
        if passing is not None:
            passing.follow(task, plant, active[~lost[active]])
        if not backward:
            outcome[active] = task.outcome(measurement[active], lost[active])
            over = active[(outcome[active] == Outcome.RUNNING) & (k[active] == limit[active])]
            if plant.late and len(over):
                plant.observe(measurement[over], np.zeros_like(measurement[over]), over)
                measurement[over] = plant.truth(over)
                outcome[over] = task.outcome(measurement[over], lost[over])
                over = over[outcome[over] == Outcome.RUNNING]
            outcome[over] = task.verdict(measurement[over])
            plant.end(over)
        if record:
            for name, values in zip(shapes, (before, q[rows], measured, u, errors), strict=True):
                kept[name].put(now.k, rows, values)
            kept["true"].put(k[rows], rows, measurement[rows])
        if "state" in kept:
            was, state = kept["state"].values[now.k, rows], plant.state[rows]
            kept["state"].put(k[rows], rows, np.where(lost[rows, None], was, state))
    ask.again()
    plant.end()
    if not together:
        for name, table in kept.items():
            if name not in ("u", "noise"):
                _stay(table.values, length - (name in shapes))
    samples = length.max(initial=0)
    arrays = {name: np.empty((0, n, *shape)) for name, shape in shapes.items()}
    arrays |= {"true": np.empty(0), "state": np.empty(0)}
    for name, table in kept.items():
        arrays[name] = table.values[: samples + (name not in shapes or name == "noise")]
    for name in ("before", "q"):  # of runs that were over before they began, none
        arrays[name] = np.nan_to_num(arrays[name], nan=NOT_STARTED).astype(int)
    return Rollout(
        length=length, limit=limit, outcome=outcome, q0=first_mode, **arrays, passing=passing
    )


def _noise(
    signal: Signal, now: Sample, ahead: list[np.ndarray] | None, measurement: np.ndarray
) -> np.ndarray:
    """Returns the noise (k, p) of a sample.

    Args:
        signal: where it comes from.
        now: the sample.
        ahead: if the runs are at different samples, and the signal does not look at them, its noise so far,
            drawn for all of them; so that it does not depend on when a run begins.
        measurement: (n, p) of all runs.
    """
    if ahead is None:
        return drawn(signal, now)
    everyone, columns = np.arange(len(measurement)), np.flatnonzero(signal.limits)
    while len(ahead) <= now.k.max():
        k = np.full(len(everyone), len(ahead))
        ahead.append(
            drawn(signal, replace(now, rows=everyone, k=k, measurement=measurement))[:, columns]
        )
    noise = np.zeros_like(now.measurement)
    noise[:, columns] = [ahead[k][row] for k, row in zip(now.k, now.rows, strict=True)]
    return noise


class _Table:
    """Values (K, n, ...) of n runs, which may be at different samples; NaN where there are none.

    There is room for 64 samples at first; then it doubles.
    """

    def __init__(self, n: int, shape: tuple[int, ...]):
        self.values = np.full((64, n, *shape), np.nan)

    def put(self, k: np.ndarray, rows: np.ndarray, values: np.ndarray) -> None:
        """Takes values (r, ...) of the samples k (r,) of the runs `rows` (r,)."""
        if (more := int(k.max(initial=0)) + 1 - len(self.values)) > 0:
            shape = max(more, len(self.values)), *self.values.shape[1:]
            self.values = np.concatenate([self.values, np.full(shape, np.nan)])
        self.values[k, rows] = values


def _stay(values: np.ndarray, last: np.ndarray) -> None:
    """Repeats the values (K, n, ...) of each run after its `last` (n,) ones, in place."""
    for row, k in enumerate(last):
        values[k + 1 : last.max() + 1, row] = values[max(k, 0), row]
