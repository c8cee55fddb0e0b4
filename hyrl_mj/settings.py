"""Every setting of a run, in frozen dataclasses with named presets."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from hyrl_mj.errors import BadArtifact, BadInput, unknown
from hyrl_mj.noise import check_bound

PRESETS = ("fast", "paper", "smoke")


@dataclass(frozen=True)
class Training:
    """How SB3 trains one policy.

    Attributes:
        samples: environment samples in all.
        envs: episodes side by side.
        hidden: widths of the hidden layers.
        activation: "relu" or "tanh".
        learning_rate: at the start.
        anneal: whether it falls linearly to (almost) zero.
        gamma: discount factor.
        symmetric: whether the network is made to respect the task's mirror symmetry, if it has one.
            It then has twice the width.
        options: further keywords of the SB3 algorithm.
    """

    samples: int
    envs: int
    hidden: tuple[int, ...]
    activation: str
    learning_rate: float
    anneal: bool
    gamma: float
    symmetric: bool
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Settings:
    """All settings of a run; `config.json` holds them.

    Attributes:
        task: its name.
        preset: the name of the preset that the others started from.
        seed: of everything random.
        noise: bound eps of the measurement noise that the controller has to survive.
        horizon: time T of the backward propagation [s].
        stage1: training of the first policy (stage 1).
        stage6: training of each mode's policy (stage 6).
        cells: grid cells along the longest side of the chart; cells are square in chart units.
        rods: grid points along the longest side from which the search for critical points starts.
        resolution: length of the last rods, as a share of the grid's cells.
    """

    task: str
    preset: str
    seed: int
    noise: float
    horizon: float
    stage1: Training
    stage6: Training
    cells: int
    rods: int
    resolution: float = 0.02

    def __post_init__(self) -> None:
        check_bound(self.noise)
        if not (math.isfinite(self.horizon) and self.horizon > 0):
            raise BadInput(f"horizon {self.horizon} s cannot be used: give a finite time > 0")
        if self.seed < 0:
            raise BadInput(f"seed {self.seed} cannot be used: give an integer >= 0")

    def to_json(self) -> dict[str, Any]:
        """As nested dicts."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(content: dict[str, Any]) -> Settings:
        """From nested dicts.

        Raises:
            BadArtifact: a setting is missing or unknown.
        """
        try:
            stages = {
                name: Training(**{**content[name], "hidden": tuple(content[name]["hidden"])})
                for name in ("stage1", "stage6")
            }
            return Settings(**{**content, **stages})
        except (KeyError, TypeError) as error:
            raise BadArtifact(f"its settings are not those of this version ({error})") from error
