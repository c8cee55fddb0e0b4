"""First layers that see all of a chart: their kinks are spread over its observations."""

import numpy as np
import torch
from torch import nn

from hyrl_mj.learning.rehearsal import running_points
from hyrl_mj.tasks import Task


def spread_kinks(policy: nn.Module, task: Task, seed: int) -> None:
    """Moves the kink of every unit that reads the observation to an observation of the chart.

    SB3 starts networks with biases of zero: all kinks of the first layer pass through the origin of the
    observation, and a network learns slowly what differs far from it.

    Args:
        policy: a policy of SB3, whose weights change.
        task: gives the chart and its observations.
        seed: seed of the draw.
    """
    rng = np.random.default_rng(seed)
    z = running_points(task, 4_096, rng)
    plant = task.plant(len(z))
    plant.set_state(*task.state(z, rng))
    seen = torch.as_tensor(task.observation(plant.measurement))
    columns = len(task.observation_low)
    with torch.no_grad():
        for network in (module for module in policy.modules() if isinstance(module, nn.Sequential)):
            layer = next(iter(network), None)
            if isinstance(layer, nn.Linear) and layer.in_features == columns:
                # The same rows for layers of one width: a target network stays a copy.
                draw = np.random.default_rng([seed, layer.out_features])
                at = seen[torch.as_tensor(draw.integers(len(seen), size=layer.out_features))]
                layer.bias.copy_(-(layer.weight * at.to(layer.weight.dtype)).sum(dim=1))
