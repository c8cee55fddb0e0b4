"""Hybrid arcs: solutions of the hybrid closed loop, simulated in MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj import artifacts
from hyrl_mj.errors import BadInput, check_seed
from hyrl_mj.policies import Controller, Policy, PolicyController, as_controller, check_modes
from hyrl_mj.simulation.noise import Noise, Recorded
from hyrl_mj.simulation.rollout import AnyNoise, Rollout, closed_loop
from hyrl_mj.tasks import Outcome, Task

# The longest time that `simulate` records [s]: an hour.
LONGEST = 3600.0


@dataclass(frozen=True)
class HybridArc:
    """A solution of the hybrid closed loop on its hybrid time domain (paper, Section II-D).

    It has one row a sample and one more for every jump: a jump at time t gives two rows with the same
    t, the first with j and the old mode, the second with j + 1 and the new one.

    Attributes:
        task: name of the task.
        controller: "policy" or "hyrl", or what the caller calls it.
        t: (N,) time [s].
        j: (N,) number of jumps so far.
        z: (N, d) true chart points, periodic coordinates unwrapped.
        measured: (N, p) noisy measurements; not a number in the last row, which ends the arc.
        q: (N,) modes.
        u: (N, m) inputs applied from this row on; not a number where none is: in the last row, and
            in the first of the two rows of a jump.
        state: (N, nstate) MuJoCo's state (`mjSTATE_INTEGRATION`).
        outcome: "reached", "crashed", "out_of_bounds"; if none of them came, the task's verdict at the
            end: "reached" or "stalled" for a task of regulation, else "running".
        noise: kind of the measurement noise.
        bound: its bound eps.
    """

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

    def arrives(self, task: Task) -> bool:
        """Whether it reached the set-point; who crosses the finishing line elsewhere has not."""
        return self.outcome == "reached" and bool(task.arrived(self.z[-1:])[0])

    def at(self, t: float) -> int:
        """The last row at or before a time [s]."""
        return int(np.searchsorted(self.t, t + 1e-9, side="right") - 1)

    def save(self, path: Path) -> None:
        """Write the arc as npz."""
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        artifacts.write_arrays(path, arrays, kind="hybrid arc")

    @staticmethod
    def load(path: Path) -> HybridArc:
        """Read what `save` wrote.

        Raises:
            BadArtifact: the file is missing, truncated, or not a hybrid arc of this version.
        """
        arrays = artifacts.read_arrays(path, kind="hybrid arc")
        with artifacts.reading(path):
            values: dict[str, Any] = {f.name: arrays[f.name] for f in fields(HybridArc)}
            return HybridArc(**{k: v.item() if v.ndim == 0 else v for k, v in values.items()})


def simulate(
    task: Task,
    controller: Controller | Policy,
    z0: ArrayLike,
    noise: AnyNoise | None = None,
    q0: int | np.ndarray | None = None,
    horizon: float | None = None,
    seed: int = 0,
    name: str = "",
) -> HybridArc | list[HybridArc]:
    """Simulate the closed loop in MuJoCo.

    Args:
        task: the robot and its job.
        controller: a controller, or a policy.
        z0: one start (d,), or n starts (n, d), in the chart.
        noise: on the measurement; none by default.
        q0: the start mode, or one for each start; by default the controller picks it.
        horizon: time to simulate [s], by default the task's.
        seed: of the noise.
        name: what the arcs call the controller; by default "policy" for a policy, else "hyrl".

    Returns:
        One arc for one start, a list of arcs for several.

    Raises:
        BadInput: a start outside the chart, an unknown mode, modes that do not fit the starts, a bad
            seed, or a horizon that is not positive.
    """
    starts = task.check_state(z0)
    single = np.ndim(z0) < 2
    check_seed(seed)
    if not (noise is None or isinstance(noise, Noise | Recorded) or hasattr(noise, "choose")):
        raise BadInput(
            f'noise {noise!r} cannot be used: give a hyrl_mj.Noise("alternating", 0.1), say'
        )
    if isinstance(noise, Noise):
        task.check_noise(noise.bound, noise.everywhere)
    steps = None if horizon is None else samples(task, horizon)
    loop = as_controller(controller)
    if q0 is not None:
        q0 = np.asarray(q0)
        if q0.shape not in ((), (len(starts),)):
            raise BadInput(
                f"{len(starts)} starts need one q0 or {len(starts)}, got shape {q0.shape}"
            )
        q0 = check_modes(np.broadcast_to(q0, len(starts)), loop.modes)
    rollout = closed_loop(
        task, loop, starts, noise=noise, q0=q0, steps=steps, seed=seed, record=True
    )
    name = name or ("policy" if isinstance(loop, PolicyController) else "hyrl")
    arcs = [_arc(task, name, rollout, i, noise or Noise()) for i in range(len(starts))]
    return arcs[0] if single else arcs


def samples(task: Task, horizon: float) -> int:
    """How many samples a time [s] takes.

    Raises:
        BadInput: it is not positive, or longer than an hour.
    """
    if not (math.isfinite(horizon) and 0 < horizon <= LONGEST):
        raise BadInput(
            f"horizon {horizon:g} s cannot be used: give a time > 0 and <= {LONGEST:g} s"
        )
    return max(round(horizon / task.dt), 1)


def _arc(task: Task, name: str, rollout: Rollout, i: int, noise: AnyNoise) -> HybridArc:
    """Run i of a rollout as a hybrid arc."""
    end = rollout.length[i]
    before, after = rollout.before[:end, i], rollout.q[:end, i]
    jumped = before != after
    # One row a sample, a row more in front of it where there was a jump, and one for the end.
    rows = np.repeat(np.arange(end + 1), np.append(1 + jumped, 1))
    old = np.append(rows[1:] == rows[:-1], False)
    last_mode = after[-1:] if end else rollout.q0[i : i + 1]
    q = np.where(old, np.append(before, last_mode)[rows], np.append(after, last_mode)[rows])
    jumps = np.append(jumped.cumsum(), jumped.sum())
    u = _ended(rollout.u[:end, i])[rows]
    u[old] = np.nan
    return HybridArc(
        task=task.name,
        controller=name,
        t=rows * task.dt,
        j=jumps[rows] - old,
        z=rollout.path[rows, i],
        measured=_ended(rollout.measured[:end, i])[rows],
        q=q,
        u=u,
        state=rollout.state[rows, i],
        outcome=Outcome(rollout.outcome[i]).label,
        noise=noise.kind,
        bound=noise.bound,
    )


def _ended(values: np.ndarray) -> np.ndarray:
    """(K, c) with a last row that holds no numbers."""
    return np.vstack([values, np.full((1, values.shape[1]), np.nan)])
