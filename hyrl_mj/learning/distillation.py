"""A policy that may be any, copied into a network with which training can go on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from hyrl_mj.errors import BadInput
from hyrl_mj.learning.settings import Training
from hyrl_mj.learning.training import build, export, single_threaded
from hyrl_mj.policies import ALGORITHMS, MlpPolicy, Policy
from hyrl_mj.progress import Progress
from hyrl_mj.tasks import Task

# Draws n chart points (n, d).
Starts = Callable[[int, np.random.Generator], np.ndarray]
# States at which a policy is copied, and the steps and batches of the regression.
DISTILLED, DISTILLING, BATCH = 16_384, 1_500, 512


def fits(task: Task, settings: Training, policy: MlpPolicy) -> bool:
    """Whether training can go on from a policy's weights."""
    try:
        build(task, settings, 0, start_from=policy)
    except BadInput:
        return False
    return True


def distil(task: Task, policy: Policy, starts: Starts, settings: Training, seed: int) -> MlpPolicy:
    """A network that answers as a policy does, by regression: what PPO and A2C can go on from.

    Args:
        task: gives observations and inputs.
        policy: the one to copy, which may be any.
        starts: draws the chart points (n, d) at which it is copied.
        settings: of the training that goes on from there: network and algorithm.
        seed: of weights and points.

    Returns:
        A policy of `settings.algorithm`, whose value function and spread are untrained.
    """
    model = build(task, settings, seed)
    rng = np.random.default_rng(seed)
    plant = task.plant(DISTILLED)
    plant.set_state(*task.state(starts(DISTILLED, rng), rng))
    measured = plant.measurement
    seen = torch.as_tensor(task.observation(measured).astype(np.float32))
    inputs, levels = policy.act(measured), task.input_levels
    if levels is None:
        wanted = torch.as_tensor(inputs.astype(np.float32))
    else:
        off = np.abs(inputs[:, None] - levels).sum(axis=2)
        wanted = torch.as_tensor(off.argmin(axis=1))
    acting = [
        weights
        for name, weights in model.policy.named_parameters()
        if name.startswith(ALGORITHMS[settings.algorithm].parts)
    ]
    optimizer = torch.optim.Adam(acting, lr=settings.learning_rate)
    progress = Progress("distilling the agent", DISTILLING, "steps")
    with single_threaded():
        for step in range(DISTILLING):
            rows = torch.as_tensor(rng.integers(DISTILLED, size=BATCH))
            _, likelihood, _ = model.policy.evaluate_actions(seen[rows], wanted[rows])
            optimizer.zero_grad()
            (-likelihood.mean()).backward()
            optimizer.step()
            progress.update(step + 1)
    progress.close()
    return export(model, task)
