"""How good policies of stage 1 are on the paper's problems, by figures that do not depend on HyRL."""

import numpy as np

import hyrl_mj
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import closed_loop


def circle_return(task: hyrl_mj.Task, policy: hyrl_mj.MlpPolicy, starts: int = 10_000) -> float:
    """Returns the mean return over 150 samples from starts drawn evenly from pi +- 0.2 rad."""
    env = BatchedEnv(task, starts)
    env.reset(z=np.pi + np.random.default_rng(0).uniform(-0.2, 0.2, (starts, 1)))
    rewards = [env.step(policy.act(env.plant.measurement)).reward for _ in range(task.max_steps)]
    return float(np.sum(rewards) / starts)


class Hard:
    """Steers to one side at the limit, whatever it measures."""

    def __init__(self, u: float):
        self._u = u

    def act(self, measured: np.ndarray) -> np.ndarray:
        return np.full((len(measured), 1), self._u)


def vehicle_share(task: hyrl_mj.Task, policy: hyrl_mj.MlpPolicy) -> float:
    """Returns the share of the winnable starts in [0, 0.5] x [-1, 1] m that the policy passes from."""
    x, y = np.meshgrid(np.linspace(0, 0.5, 50), np.linspace(-1, 1, 50), indexing="ij")
    z0 = np.stack([x.ravel(), y.ravel()], axis=1)

    def outcome(policy: hyrl_mj.Policy) -> np.ndarray:
        return closed_loop(task, PolicyController(policy), z0).outcome

    # Steering hard drives into the wall in the end; it has passed if that comes before a crash.
    winnable = np.any([outcome(Hard(u)) != hyrl_mj.Outcome.CRASHED for u in (-1.0, 1.0)], axis=0)
    won = outcome(policy) == hyrl_mj.Outcome.REACHED
    return float((won & winnable).sum() / winnable.sum())
