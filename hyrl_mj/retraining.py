"""Stage 6: one policy for each extended set, trained there and nowhere else."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hyrl_mj.envs.core import Domain
from hyrl_mj.extended_sets import ExtendedSets
from hyrl_mj.noise import Noise
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.sets import GridSet
from hyrl_mj.settings import Training
from hyrl_mj.tasks.base import Outcome, Task
from hyrl_mj.training import train


def retrain(
    task: Task,
    policy: MlpPolicy,
    extended: ExtendedSets,
    mode: int,
    settings: Training,
    seed: int,
    log_dir: Path | None = None,
) -> MlpPolicy:
    """Train the policy of one mode (paper, Step 6).

    Measurements are noisy: a policy that passes an obstacle closer than the noise bound is led into
    it, and no switching cures that.

    Args:
        task: what to learn.
        policy: the stage-1 policy; with `settings.warm_start` training goes on from its weights.
        extended: M_ext_i and W_i, from stage 5.
        mode: the mode to train.
        settings: how to train.
        seed: of everything random; each mode derives its own from it.
        log_dir: where logs and checkpoints go.
    """
    domain = mode_domain(task, extended, mode, settings.gamma)
    return train(
        task,
        settings,
        seed=int(np.random.SeedSequence([seed, 1 + mode]).generate_state(1)[0]),
        noise=Noise("uniform", extended.noise) if extended.noise else Noise(),
        domain=domain,
        start_from=policy if settings.warm_start else None,
        log_dir=log_dir,
        label=f"mode {mode}",
    )


def mode_domain(task: Task, extended: ExtendedSets, mode: int, gamma: float) -> Domain:
    """Where mode i is trained: every state whose measurement can lie in M_ext_i.

    That is M_ext_i dilated by the noise bound. Starts are drawn from it evenly, where the mode can
    still succeed; leaving it ends an episode and counts as the worst reward for ever.
    """
    i = extended.modes.index(mode)
    within: GridSet = extended.sets[i].dilated(extended.noise)
    grid = within.grid
    plant = task.plant(len(grid.nodes))
    plant.set_state(task.qpos(grid.nodes))
    alive = task.ending(plant.measurement) == Outcome.RUNNING
    nodes = np.flatnonzero(within.mask & extended.winning[i] & alive)
    if not len(nodes):
        # The stage-1 policy never succeeds here; training may still find a way.
        nodes = np.flatnonzero(within.mask & alive)

    def starts(n: int, rng: np.random.Generator) -> np.ndarray:
        jitter = rng.uniform(-0.5, 0.5, (n, task.chart.dimension)) * grid.spacing
        z = grid.nodes[rng.choice(nodes, n)] + jitter
        return np.where(task.chart.periodic, z, np.clip(z, task.chart.low, task.chart.high))

    return Domain(starts, within.contains, task.worst_reward / (1 - gamma))
