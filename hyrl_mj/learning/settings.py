"""The settings of a run, in frozen dataclasses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

from hyrl_mj.errors import BadInput, check_bound, check_seed
from hyrl_mj.policies import Agent, algorithm_title


@dataclass(frozen=True)
class Training:
    """How SB3 trains one policy.

    Attributes:
        algorithm: one of `hyrl_mj.policies.algorithms.ALGORITHMS`, or `module:Class` of another one.
        samples: total number of environment samples.
        envs: number of episodes side by side.
        hidden: widths of the hidden layers.
        activation: function between the layers, one of `hyrl_mj.policies.mlp.ACTIVATIONS`.
        learning_rate: learning rate at the start.
        anneal: whether the learning rate falls linearly to (almost) zero.
        gamma: discount factor.
        symmetric: whether the network respects the task's mirror symmetry, if it has one. The weights are
            used twice, and the policy has twice the width.
        warm_start: whether the first attempt continues from the policy of stage 1 (stage 6 only): DQN from
            its weights, PPO from its distilled actions on the mode's part. A Gaussian policy of small spread
            does not explore the other way any more.
        episode: samples until an episode is truncated, by default the task's; shorter episodes cover more
            starts.
        attempts: number of trainings, each with another seed, until a policy is good enough (stage 6 only);
            the best policy is kept.
        action_noise: standard deviation of the exploration noise of TD3 and DDPG on inputs scaled to -1..1.
        options: further keyword arguments of the SB3 algorithm.
    """

    algorithm: str
    samples: int
    envs: int
    hidden: tuple[int, ...]
    activation: str
    learning_rate: float
    anneal: bool
    gamma: float
    symmetric: bool
    warm_start: bool = False
    episode: int | None = None
    attempts: int = 1
    action_noise: float = 0.0
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The name of the algorithm, such as "PPO"."""
        return algorithm_title(self.algorithm)


@dataclass(frozen=True)
class Settings:
    """All settings of a run; `config.json` holds them.

    Attributes:
        task: name of the task, or the file that defines it.
        preset: name of the preset of the other settings.
        seed: seed of all random numbers.
        noise: bound eps of the measurement noise that the controller has to survive.
        horizon: time T of the backward propagation [s]; None to size the sets to the noise.
        stage1: training of the first policy (stage 1), or the agent in its place.
        stage6: training of each mode's policy (stage 6).
        cells: grid cells along the longest side of the chart; cells are square in chart units.
        rods: grid points along the longest side from which the search for critical points starts.
        lattice: lattice cells along the longest side for the worst-case game.
        resolution: length of the last rods, as a share of the first.
        search: search method for critical points, "rods" or "outcome".
    """

    task: str
    preset: str
    seed: int
    noise: float
    horizon: float | None
    stage1: Training | Agent
    stage6: Training
    cells: int
    rods: int
    lattice: int
    resolution: float = 1 / 32
    search: str = "rods"

    def __post_init__(self) -> None:
        check_bound(self.noise)
        if self.horizon is not None and not (
            isinstance(self.horizon, Real) and math.isfinite(self.horizon) and self.horizon > 0
        ):
            raise BadInput(f"horizon {self.horizon!r} s cannot be used: give a finite time > 0")
        check_seed(self.seed)
