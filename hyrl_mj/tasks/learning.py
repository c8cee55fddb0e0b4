"""What trains a task by default."""

from __future__ import annotations

from dataclasses import dataclass

# The searches for the critical set.
SEARCHES = ("rods", "outcome")


@dataclass(frozen=True)
class Learning:
    """Defaults of a task's training and of the stages after it; a run's settings can differ.

    Attributes:
        algorithm: an algorithm of SB3, as "ppo", or "module:Class"; by default "dqn" where the input has
            levels, else "ppo".
        levels: number of equally spaced levels of the single input; None for continuous inputs.
        search: the search for the critical set, by "rods" or by "outcome"; see `find_critical_set`.
        horizon: the paper's horizon T of the backward propagation [s].
    """

    algorithm: str = ""
    levels: int | None = None
    search: str = "outcome"
    horizon: float = 0.5

    def __post_init__(self) -> None:
        if not self.algorithm:
            object.__setattr__(self, "algorithm", "ppo" if self.levels is None else "dqn")
