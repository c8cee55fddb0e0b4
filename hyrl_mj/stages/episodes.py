"""Noisy episodes in bulk: statistics for charts and plants of any kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput, check_seed
from hyrl_mj.policies import Controller
from hyrl_mj.progress import Progress
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import Noise, closed_loop
from hyrl_mj.stages.critical_set import CriticalSet, distance_to
from hyrl_mj.tasks import Outcome, Task

# Episodes that are simulated together: memory does not grow with their number.
BATCH = 4_096
# After so many starts, none of which lies near M*, there are none.
RARE = 100_000


def noisy_episodes(
    task: Task,
    critical: CriticalSet,
    controllers: Mapping[str, Controller],
    noises: tuple[Noise, ...],
    count: int,
    seed: int = 0,
    winnable: tuple[Grid, np.ndarray] | None = None,
    near: bool = False,
) -> list[dict[str, Any]]:
    """Noisy episodes in bulk: outcomes by noise, controller and start region.

    All controllers meet the same starts; signals that do not look at the loop are the same, too.

    Args:
        task: what is played, from its start distribution.
        critical: M*; starts within twice the noise bound of it are a region of their own.
        controllers: by name.
        noises: kinds and bounds.
        count: episodes for each noise and controller.
        seed: of starts and noise.
        winnable: a grid and which of its nodes can be won; starts that cannot are a region of their own.
        near: whether all episodes start within twice the noise bound of M*.

    Returns:
        One record for each noise, controller and region: how many episodes had each outcome, and the
        share that reached the set-point with its 95% interval (Wilson).

    Raises:
        BadInput: no episodes, a noise bound that hides the state space, or no starts near M*.
    """
    check_seed(seed)
    if count < 1:
        raise BadInput(f"{count} episodes cannot be simulated: give at least 1")
    for noise in noises:
        task.check_noise(noise.bound, noise.everywhere)
    progress = Progress("noisy episodes", count * len(noises) * len(controllers), "episodes")
    records, done = [], 0
    # New ones for each batch would leave more and more holes in the memory.
    plants = {n: task.plant(n) for n in {min(BATCH, count), count % BATCH} - {0}}
    for noise in noises:
        for name, controller in controllers.items():
            counts: dict[str, np.ndarray] = {}
            for first in range(0, count, BATCH):
                n = min(BATCH, count - first)
                draw, signal = np.random.SeedSequence([seed, first]).generate_state(2)
                z0 = _starts(task, critical, noise, n, np.random.default_rng(draw), near)
                rollout = closed_loop(
                    task,
                    controller,
                    z0,
                    noise=noise,
                    seed=int(signal),
                    quiet=True,
                    vary=True,
                    plant=plants[n],
                )
                for region, inside in _regions(task, critical, noise.bound, winnable, z0).items():
                    counts.setdefault(region, np.zeros(len(Outcome), dtype=int))
                    counts[region] += np.bincount(rollout.outcome[inside], minlength=len(Outcome))
                done += n
                progress.update(done)
            records += [
                _record(noise, name, region, found)
                for region, found in counts.items()
                if found.any()
            ]
    progress.close()
    return records


def _starts(
    task: Task,
    critical: CriticalSet,
    noise: Noise,
    n: int,
    rng: np.random.Generator,
    near: bool,
) -> np.ndarray:
    """n starts (n, d) from the task's distribution; if asked for, of those near M*."""
    z = task.starts(n, rng)
    if not near:
        return z
    if not len(critical.points):
        raise BadInput(
            "no critical set was found, so nothing starts near it: leave --near-critical out"
        )
    kept, drawn = np.empty((0, z.shape[1])), 0
    while len(kept) < n:
        kept = np.vstack([kept, z[_near(task, critical, noise.bound, z)]])
        drawn += n
        if not len(kept) and drawn >= RARE:
            raise BadInput(
                f"of {drawn:,} starts of {task.name} none lies within {2 * noise.bound:g} of its critical "
                "set: leave --near-critical out, or start elsewhere"
            )
        z = task.starts(n, rng)
    return kept[:n]


def _near(task: Task, critical: CriticalSet, bound: float, z: np.ndarray) -> np.ndarray:
    """Whether starts (n, d) lie within twice the noise bound of M*: (n,) bool."""
    return np.asarray(distance_to(task, critical, z) <= 2 * bound)


def _regions(
    task: Task,
    critical: CriticalSet,
    bound: float,
    winnable: tuple[Grid, np.ndarray] | None,
    z0: np.ndarray,
) -> dict[str, np.ndarray]:
    """The start regions: which of the starts (n, d) lie in each, (n,) bool."""
    near = _near(task, critical, bound, z0)
    if winnable is None:
        return {"near M*": near, "elsewhere": ~near}
    grid, can = winnable
    open_ = can[grid.nearest(z0)]
    return {"near M*": near & open_, "elsewhere": ~near & open_, "not winnable": ~open_}


def _record(noise: Noise, name: str, region: str, counts: np.ndarray) -> dict[str, Any]:
    from scipy.stats import binomtest  # slow to import, and seldom needed

    reached, total = int(counts[Outcome.REACHED]), int(counts.sum())
    interval = binomtest(reached, total).proportion_ci(0.95, method="wilson")
    return {
        "noise": noise.kind,
        "eps": noise.bound,
        "everywhere": noise.everywhere,
        "controller": name,
        "region": region,
        "episodes": total,
        "outcomes": {Outcome(i).label: int(c) for i, c in enumerate(counts) if c},
        "reached": reached / total,
        "interval": [float(interval.low), float(interval.high)],
    }
