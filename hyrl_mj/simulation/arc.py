"""Hybrid arcs: solutions of the hybrid closed loop, simulated in MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar, overload

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.errors import BadInput, check_seed, counted
from hyrl_mj.files.artifacts import Saved
from hyrl_mj.policies import Controller, Policy, PolicyController, as_controller, check_modes
from hyrl_mj.simulation.noise import AnyNoise, Noise, signal_for
from hyrl_mj.simulation.real import judge_beginning
from hyrl_mj.simulation.rollout import LoopSettings, Rollout, closed_loop
from hyrl_mj.tasks import Outcome, Task, get_task, task_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The longest time that `simulate` records [s]: an hour.
LONGEST = 3600.0


@dataclass(frozen=True)
class HybridArc(Saved):
    """A solution of the hybrid closed loop on its hybrid time domain (paper, Section II-D).

    An arc has one row a sample and one more for every jump: a jump at time t gives two rows with the same
    t, the first with j and the old mode, the second with j + 1 and the new one.

    Attributes:
        task: name of the task.
        controller: "policy" for a policy alone, else "hyrl".
        t: (N,) time [s].
        j: (N,) number of jumps so far.
        z: (N, d) true chart points, periodic coordinates unwrapped.
        measured: (N, p) noisy measurements; NaN in the last row, which ends the arc.
        q: (N,) modes.
        u: (N, m) inputs applied from this row on; NaN in the last row and in the first row of a jump.
        state: (N, nstate) MuJoCo's state (`mjSTATE_INTEGRATION`).
        outcome: label of the `Outcome` that ended the run, or of the task's verdict at the time limit.
        noise: kind of the measurement noise.
        bound: its bound eps.
    """

    KIND: ClassVar[str] = "hybrid arc"

    task: str
    controller: str
    t: np.ndarray
    j: np.ndarray
    z: np.ndarray
    measured: np.ndarray
    q: np.ndarray
    u: np.ndarray
    state: np.ndarray
    outcome: str
    noise: str
    bound: float

    def __post_init__(self) -> None:
        rows = len(np.atleast_1d(self.t))
        tables = {"z": self.z, "measured": self.measured, "u": self.u, "state": self.state}
        fits = all(np.shape(a) == (rows,) for a in (self.t, self.j, self.q))
        fits = fits and all(np.ndim(a) == 2 and len(a) == rows for a in tables.values())
        numbers = all(np.asarray(a).dtype.kind in "iuf" for a in (self.t, *tables.values()))
        counts = all(np.issubdtype(np.asarray(a).dtype, np.integer) for a in (self.q, self.j))
        if not (rows and fits and numbers and counts and np.isfinite(self.t).all()):
            raise BadInput("these arrays make no arc: give numbers in one row for each sample")
        rises = self.t[0] >= 0 and np.all(np.diff(self.t) >= 0)
        if not (rises and self.j[0] == 0 and np.isin(np.diff(self.j), (0, 1)).all()):
            raise BadInput(
                "these arrays make no arc: t must not fall, and j counts jumps from 0 on"
            )

    @property
    def columns(self) -> tuple[int, int, int]:
        """The numbers of columns of z, of the measurement, and of the inputs: d, p, m."""
        return self.z.shape[1], self.measured.shape[1], self.u.shape[1]

    def __repr__(self) -> str:
        return f"HybridArc({self.task}, {self._summary})"

    @property
    def _summary(self) -> str:
        noise = f"{self.noise} noise of {self.bound:g}" if self.bound else "no noise"
        return (
            f"{self.controller}: {self.outcome} after {self.t[-1]:.2f} s, "
            f"{counted(self.j[-1], 'jump')}, {noise}"
        )

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Draws the chart coordinates over time, coloured by mode, with jumps as dashed lines.

        Args:
            ax: matplotlib's axes, one for each coordinate, or one for all; by default those of a new figure.

        Returns:
            The figure.

        Raises:
            BadInput: there are as many axes as neither of these.
        """
        from matplotlib.axes import Axes  # slow to import

        from hyrl_mj.system.picture import Picture

        labels = self._axis_labels()
        if ax is None:
            figure = Picture(figsize=(6.4, 1.4 + 1.6 * len(labels)), layout="constrained")
            ax = list(figure.subplots(len(labels), sharex=True, squeeze=False)[:, 0])
            figure.suptitle(f"{self.task}, {self._summary}", fontsize="medium")
        panels = list(np.ravel(np.asarray(ax, dtype=object)))
        if len(panels) not in (1, len(labels)) or not all(isinstance(p, Axes) for p in panels):
            raise BadInput(
                f"ax {ax!r:.80} cannot be used: give one of matplotlib's Axes, or {len(labels)}, as those of "
                f"plt.subplots({len(labels)})"
            )
        jumps = np.flatnonzero(np.diff(self.j))
        flows = np.split(np.arange(len(self.t)), jumps + 1)
        for i, (label, z) in enumerate(zip(labels, self.z.T, strict=True)):
            panel = panels[i % len(panels)]
            for rows in flows:
                mode = self.q[rows[0]]
                alone = self.controller == "policy"
                name, colour = ("policy", "0.2") if alone else (f"mode {mode}", f"C{mode}")
                panel.plot(self.t[rows], z[rows], color=colour, label=name)
            for t in self.t[jumps]:
                panel.axvline(t, color="0.6", linestyle="--", linewidth=0.8, zorder=0)
            if len(panels) < len(labels):
                looks: dict[str, Any] = {"textcoords": "offset points", "va": "center"}
                panel.annotate(label, (self.t[-1], z[-1]), (4, 0), **looks)
            else:
                panel.set_ylabel(label)
        panels[-1].set_xlabel("t [s]")
        lines, names = panels[0].get_legend_handles_labels()
        by_label = dict(zip(names, lines, strict=True))
        panels[0].legend(by_label.values(), by_label)
        return panels[0].figure

    def _axis_labels(self) -> list[str]:
        """Returns "x [m]" for each coordinate, or "z[0]" if the task is not registered."""
        d = self.z.shape[1]
        if self.task in task_names() and (chart := get_task(self.task).chart).dimension == d:
            return [f"{n} [{unit}]" for n, unit in zip(chart.names, chart.units, strict=True)]
        return [f"z[{axis}]" for axis in range(d)]

    def arrives(self, task: Task) -> bool:
        """Returns whether the arc ends at the set-point, not elsewhere on the finishing line."""
        return self.outcome == "reached" and bool(task.arrived(self.z[-1:])[0])

    def ending(self, task: Task) -> str:
        """Returns the outcome; "missed" if the arc ends on the finishing line off the set-point."""
        missed = self.outcome == "reached" and not self.arrives(task)
        return "missed" if missed else self.outcome

    def at(self, t: float) -> int:
        """Returns the last row at or before a time [s]."""
        return int(np.searchsorted(self.t, t + 1e-9, side="right") - 1)


@overload
def simulate(
    task: Task,
    controller: Controller | Policy,
    z0: Sequence[float],
    noise: AnyNoise | None = None,
    q0: int | np.ndarray | None = None,
    horizon: float | None = None,
    seed: int = 0,
) -> HybridArc: ...


@overload
def simulate(
    task: Task,
    controller: Controller | Policy,
    z0: Sequence[Sequence[float]],
    noise: AnyNoise | None = None,
    q0: int | np.ndarray | None = None,
    horizon: float | None = None,
    seed: int = 0,
) -> list[HybridArc]: ...


@overload
def simulate(
    task: Task,
    controller: Controller | Policy,
    z0: ArrayLike,
    noise: AnyNoise | None = None,
    q0: int | np.ndarray | None = None,
    horizon: float | None = None,
    seed: int = 0,
) -> HybridArc | list[HybridArc]: ...


def simulate(
    task: Task,
    controller: Controller | Policy,
    z0: ArrayLike,
    noise: AnyNoise | None = None,
    q0: int | np.ndarray | None = None,
    horizon: float | None = None,
    seed: int = 0,
) -> HybridArc | list[HybridArc]:
    """Simulates the closed loop in MuJoCo.

    Args:
        task: the robot and its problem.
        controller: a controller, or a policy.
        z0: one start (d,), or n starts (n, d), in the chart.
        noise: on the measurement; none by default.
        q0: the start mode, or one for each start; by default the controller picks it.
        horizon: time to simulate [s], by default the task's.
        seed: of the noise.

    Returns:
        A `HybridArc` for one start, a list of them for several.

    Raises:
        BadInput: a start outside the chart, an unknown mode, modes that do not fit the starts, a noise or
            a seed that cannot be used, or a horizon that is not positive.
    """
    arcs = simulate_batch(task, controller, z0, noise, q0, horizon, seed)
    return arcs[0] if np.ndim(z0) < 2 else arcs


def simulate_batch(
    task: Task,
    controller: Controller | Policy,
    z0: ArrayLike,
    noise: AnyNoise | None = None,
    q0: int | np.ndarray | None = None,
    horizon: float | None = None,
    seed: int = 0,
) -> list[HybridArc]:
    """Simulates the closed loop from n starts (n, d), or from one, as `simulate`, and returns a list."""
    task = get_task(task)
    starts = task.chart.check(z0, task.name)
    check_seed(seed)
    loop, n = as_controller(controller), len(starts)
    if q0 is not None:
        q0 = np.asarray(q0)
        if q0.shape not in ((), (n,)):
            raise BadInput(f"{n} starts need one q0 or {n}, got shape {q0.shape}")
        q0 = check_modes(np.broadcast_to(q0, n), loop.modes)
    noise = Noise() if noise is None else noise
    bound = signal_for(noise, task, loop).bound  # of a sensor with all that it does
    steps = None if horizon is None else samples(task, horizon)
    settings = LoopSettings(steps=steps, record=True)
    rollout = closed_loop(task, loop, starts, noise, q0, seed, settings)
    task.verify(starts, rollout, range(n))
    if task.source is not None and type(task).plant is Task.plant:
        judge_beginning(task, rollout, task.state(starts), np.arange(min(n, 4)))
    name = "policy" if isinstance(loop, PolicyController) else "hyrl"
    return [_arc(task, name, rollout, i, noise.kind, bound) for i in range(n)]


def samples(task: Task, horizon: float) -> int:
    """Returns the number of samples in a time [s].

    Raises:
        BadInput: the time is not positive, or longer than an hour.
    """
    if not (isinstance(horizon, Real) and math.isfinite(horizon) and 0 < horizon <= LONGEST):
        given = f"{horizon:g} s" if isinstance(horizon, Real) else repr(horizon)
        raise BadInput(f"horizon {given} cannot be used: give a time > 0 and <= {LONGEST:g} s")
    return max(round(horizon / task.dt), 1)


def _arc(task: Task, name: str, rollout: Rollout, i: int, noise: str, bound: float) -> HybridArc:
    end = rollout.length[i]
    before, after = rollout.before[:end, i], rollout.q[:end, i]
    jumped = before != after
    # One row a sample, a row more in front of it where there was a jump, and one for the end.
    rows = np.repeat(np.arange(end + 1), np.append(1 + jumped, 1))
    old = np.append(rows[1:] == rows[:-1], False)
    last_mode = after[-1:] if end else rollout.q0[i : i + 1]
    q = np.where(old, np.append(before, last_mode)[rows], np.append(after, last_mode)[rows])
    jumps = np.append(jumped.cumsum(), jumped.sum())
    measured, u = (
        np.pad(values[:end, i], ((0, 1), (0, 0)), constant_values=np.nan)[rows]
        for values in (rollout.measured, rollout.u)
    )
    u[old] = np.nan
    return HybridArc(
        task=task.name,
        controller=name,
        t=rows * task.dt,
        j=jumps[rows] - old,
        z=rollout.path[rows, i],
        measured=measured,
        q=q,
        u=u,
        state=rollout.state[rows, i],
        outcome=Outcome(rollout.outcome[i]).label,
        noise=noise,
        bound=bound,
    )
