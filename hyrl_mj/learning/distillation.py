"""Distillation: copies any policy into a network from which training can continue."""

from collections.abc import Callable

import numpy as np
import torch

from hyrl_mj.errors import BadInput
from hyrl_mj.learning.settings import Training
from hyrl_mj.learning.training import build, export, threads, usual_torch
from hyrl_mj.policies import ALGORITHMS, MlpPolicy, Policy
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Task

# A function that draws n chart points (n, d).
Starts = Callable[[int, np.random.Generator], np.ndarray]
# States and steps of the regression.
STATES, STEPS = 16_384, 1_500


def fits(task: Task, settings: Training, policy: MlpPolicy) -> bool:
    """Returns whether training can continue from a policy's weights."""
    try:
        build(task, settings, 0, start_from=policy)
    except BadInput:
        return False
    return True


@usual_torch()
def distil(task: Task, policy: Policy, starts: Starts, settings: Training, seed: int) -> MlpPolicy:
    """Returns a network that imitates a policy, by regression; PPO and A2C can continue from it.

    Its value function and spread are untrained.

    Args:
        task, policy: the robot and its problem, and the policy to copy, of any kind.
        starts: draws the chart points (n, d) at which the policy is copied.
        settings: settings of the training that continues, with its network and algorithm.
        seed: seed of weights and points.
    """
    model = build(task, settings, seed)
    rng = np.random.default_rng(seed)
    measured = task.placed(starts(STATES, rng), rng).measurement
    observations = torch.as_tensor(task.observation(measured).astype(np.float32))
    inputs, levels = policy.act(measured), task.input_levels
    if levels is None:
        actions = torch.as_tensor(inputs.astype(np.float32))
    else:
        distances = np.abs(inputs[:, None] - levels).sum(axis=2)
        actions = torch.as_tensor(distances.argmin(axis=1))
    parts, parameters = ALGORITHMS[settings.algorithm].parts, model.policy.named_parameters()
    actor = [weights for name, weights in parameters if name.startswith(parts)]
    optimizer = torch.optim.Adam(actor, lr=settings.learning_rate)
    with threads(1):
        for _ in progress_bar(range(STEPS), "distilling the agent", "steps"):
            rows = torch.as_tensor(rng.integers(STATES, size=512))
            _, likelihood, _ = model.policy.evaluate_actions(observations[rows], actions[rows])
            optimizer.zero_grad()
            (-likelihood.mean()).backward()
            optimizer.step()
    return export(model, task)
