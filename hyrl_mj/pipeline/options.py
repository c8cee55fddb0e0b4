"""The options of a run, as frozen values that Python and the command line share.

A docstring's "by default ..." at the end of an entry is what `--help` shows as the default.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from hyrl_mj.errors import BadInput, unknown

# What options were called in version 0.1.
RENAMED = {"noise": "eps", "preset_name": "preset"}


@dataclass(frozen=True)
class RunOptions:
    """The options of a run that trains its own policy.

    Attributes:
        eps: bound of the measurement noise to survive, in the units of the chart.
        seed: seed of everything random.
        preset: fast, paper (the paper's training, ten minutes), or smoke (seconds).
        algorithm: the algorithm of stage 1: ppo, a2c, dqn, sac, td3, ddpg, or module:Class for another one
            with the interface of SB3's, as sb3_contrib:TQC; by default the task's.
        horizon: time T of the backward propagation [s], in the paper 0.5 (unit_circle) and 0.3 (vehicle);
            by default the paper's with preset paper, otherwise the sets are sized to the noise.
        out: the run directory; by default runs/TASK.
    """

    eps: float = 0.1
    seed: int = 0
    preset: str = "fast"
    algorithm: str | None = None
    horizon: float | None = None
    out: str | Path | None = None


@dataclass(frozen=True)
class AgentOptions:
    """The options of a run on an agent that was trained elsewhere.

    Attributes:
        activation: activation between the layers of the agent's network, for a zip that does not say; by
            default that of SB3's policy.
        stochastic: sample the inputs of the agent, as during its training (PPO, A2C, SAC); noisy episodes
            then stand in for the worst-case game.
        eps: bound of the measurement noise to survive, in the units of the chart.
        seed: seed of everything random.
        preset: fast, paper or smoke, as for `hyrl-mj run`.
        horizon: time T of the backward propagation [s]; by default the paper's with preset paper, otherwise
            the sets are sized to the noise.
        out: the run directory; by default runs/TASK_robust.
    """

    activation: str | None = None
    stochastic: bool = False
    eps: float = 0.1
    seed: int = 0
    preset: str = "fast"
    horizon: float | None = None
    out: str | Path | None = None


@dataclass(frozen=True)
class ExamineOptions:
    """The options of an examination under noise.

    Attributes:
        eps: bound of the noise, in the units of the chart; by default the run's.
        episodes: noisy episodes for each kind of noise and each controller; by default none where the worst
            case can be played exactly, on charts of one or two dimensions.
        noise: kinds of noise in the episodes; by default uniform,alternating,adversarial.
        all_coordinates: add noise to every coordinate of the measurement, not only to those that the task
            calls noisy.
        near_critical: start all episodes within twice the bound of the critical set.
        seed: seed of starts and noise of the episodes.
    """

    eps: float | None = None
    episodes: int | None = None
    noise: tuple[str, ...] = ()
    all_coordinates: bool = False
    near_critical: bool = False
    seed: int = 0


Options = TypeVar("Options", RunOptions, AgentOptions)


def complete(kind: type[Options], options: Options | None, changes: dict[str, Any]) -> Options:
    """Returns options, by default those of `kind`, with some of them changed.

    Raises:
        BadInput: they are of another kind, or a change has a name that no option has.
    """
    if options is None:
        options = kind()
    if not isinstance(options, kind):
        raise BadInput(f"options {options!r} cannot be used: give {kind.__name__}(...)")
    names = [field.name for field in fields(kind)]
    for name, value in changes.items():
        if name in RENAMED and name not in names:
            new = RENAMED[name]
            raise BadInput(f"the option {name} is now called {new}: give {new}={value!r}")
        if name not in names:
            raise unknown("option", name, names)
    return replace(options, **changes)
