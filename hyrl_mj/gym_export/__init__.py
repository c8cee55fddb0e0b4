"""Environments: one batched core, and its interfaces for Gymnasium and Stable-Baselines3.

The module `sb3_env` imports Stable-Baselines3, so it is imported only where it is needed.
"""

from hyrl_mj.gym_export.core import BatchedEnv, Domain, Pay, pay_of
from hyrl_mj.gym_export.gym_env import TaskEnv, TaskVectorEnv, observation_space
from hyrl_mj.gym_export.sb3_policy import Sb3Policy

__all__ = [
    "BatchedEnv",
    "Domain",
    "Pay",
    "Sb3Policy",
    "TaskEnv",
    "TaskVectorEnv",
    "observation_space",
    "pay_of",
    "sb3_env",
]
