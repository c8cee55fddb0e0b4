"""Every setting of a run, in frozen dataclasses with named presets."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any

import numpy as np

from hyrl_mj.algorithms import accepted, algorithm_title, check_algorithm, relative
from hyrl_mj.errors import BadArtifact, BadInput, unknown
from hyrl_mj.noise import check_bound, check_seed
from hyrl_mj.tasks.base import Task

PRESETS = ("fast", "paper", "smoke")


@dataclass(frozen=True)
class Training:
    """How SB3 trains one policy.

    Attributes:
        algorithm: one of `hyrl_mj.algorithms.ALGORITHMS`, or `module:Class` of another one.
        samples: environment samples in all.
        envs: episodes side by side.
        hidden: widths of the hidden layers.
        activation: between the layers, one of `hyrl_mj.policies.ACTIVATIONS`.
        learning_rate: at the start.
        anneal: whether it falls linearly to (almost) zero.
        gamma: discount factor.
        symmetric: whether the network is made to respect the task's mirror symmetry, if it has one.
            Its weights then serve twice, and the policy has twice the width.
        warm_start: whether the first attempt goes on from the policy of stage 1 (stage 6 only): DQN from
            its weights, PPO from what it does on the mode's part, distilled. A Gaussian policy that has
            made up its mind does not try the other way any more.
        episode: samples until an episode is truncated, by default the task's; shorter ones see more of
            the starts.
        attempts: how often training starts again, with another seed, until its policy is good enough
            (stage 6 only); the best is kept.
        action_noise: standard deviation of the noise with which TD3 and DDPG try other inputs, which are
            stretched to lie between -1 and 1.
        options: further keywords of the SB3 algorithm.
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
        """The algorithm for people: "PPO"."""
        return algorithm_title(self.algorithm)


@dataclass(frozen=True)
class Agent:
    """A policy that is given, in the place of one that stage 1 trains.

    Attributes:
        algorithm: of SB3 that trained it; "onnx" for a model in that format, "function" for code.
        source: the file that it came from, as it was given; "" for an object of Python's. Two agents that
            differ in nothing else are the same.
        sha256: of what it is: a network's tensors, a model's file, a function's answers.
        activation: between a network's layers, else None.
        stochastic: whether it draws its inputs, as it did while it learned.
    """

    algorithm: str
    source: str = field(compare=False)
    sha256: str
    activation: str | None = None
    stochastic: bool = False

    def __str__(self) -> str:
        """It for people: "agent.zip (DQN, sampled)"."""
        drawn = ", sampled" if self.stochastic else ""
        return f"{self.source or 'an agent of Python code'} ({self.title}{drawn})"

    @property
    def title(self) -> str:
        """What it is for people: "DQN", "ONNX", "FUNCTION"."""
        return algorithm_title(self.algorithm)

    @property
    def options(self) -> list[str]:
        """How the command line is told of it."""
        options = ["--policy", self.source]
        if self.activation is not None:
            options += ["--activation", self.activation]
        return options + ["--stochastic"] * self.stochastic


@dataclass(frozen=True)
class Settings:
    """All settings of a run; `config.json` holds them.

    Attributes:
        task: its name, or the file that defines it.
        preset: the name of the preset that the others started from.
        seed: of everything random.
        noise: bound eps of the measurement noise that the controller has to survive.
        horizon: time T of the backward propagation [s]; None to size the sets to the noise.
        stage1: training of the first policy (stage 1), or the agent that is given instead.
        stage6: training of each mode's policy (stage 6).
        cells: grid cells along the longest side of the chart; cells are square in chart units.
        rods: grid points along the longest side from which the search for critical points starts.
        lattice: cells along the longest side for the worst-case game.
        resolution: length of the last rods, as a share of the first.
        search: how critical points are searched for, by "rods" or "outcome".
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
            stages = {name: _stage(content[name]) for name in ("stage1", "stage6")}
            return Settings(**{**content, **stages})
        except (KeyError, TypeError) as error:
            raise BadArtifact(f"its settings are not those of this version ({error})") from error


def _stage(content: dict[str, Any]) -> Training | Agent:
    """A training or an agent, from what `to_json` makes of it."""
    if "sha256" in content:
        return Agent(**content)
    return Training(**{**content, "hidden": tuple(content["hidden"])})


# Stage 1 of preset fast, by algorithm: of tasks with continuous inputs, and of those with levels.
# Short episodes, for tasks that start all over the chart: the decision falls in their first second.
_PPO = Training(
    algorithm="ppo",
    samples=160_000,
    envs=128,
    hidden=(64, 64),
    activation="tanh",
    learning_rate=3e-3,
    anneal=True,
    gamma=0.98,
    symmetric=True,
    episode=20,
    options={"n_steps": 32, "batch_size": 1024, "n_epochs": 8},
)
_A2C = replace(
    _PPO,
    algorithm="a2c",
    options={"n_steps": 16, "normalize_advantage": True, "use_rms_prop": False},
)
# A gradient step takes milliseconds, a sample hardly anything: many samples to each.
_SAC = replace(
    _PPO,
    algorithm="sac",
    samples=48_000,
    envs=32,
    activation="relu",
    gamma=0.95,
    options={
        "buffer_size": 100_000,
        "learning_starts": 1_000,
        "batch_size": 256,
        "train_freq": 1,
        "gradient_steps": 1,
        "tau": 0.02,
        "ent_coef": 0.02,
    },
)
_TD3 = replace(
    _SAC,
    algorithm="td3",
    action_noise=0.3,
    options={name: value for name, value in _SAC.options.items() if name != "ent_coef"},
)
_CONTINUOUS = {
    "ppo": _PPO,
    "a2c": _A2C,
    "sac": _SAC,
    "td3": _TD3,
    "ddpg": replace(_TD3, algorithm="ddpg"),
}
_DQN = Training(
    algorithm="dqn",
    samples=150_000,
    envs=64,
    hidden=(64, 64),
    activation="relu",
    learning_rate=1e-3,
    anneal=True,
    gamma=0.9664,
    symmetric=True,
    options={
        "buffer_size": 200_000,
        "learning_starts": 2_000,
        "batch_size": 256,
        "train_freq": 1,
        "gradient_steps": 4,
        "target_update_interval": 3_000,
        "n_steps": 5,
        "exploration_initial_eps": 1.0,
        "exploration_fraction": 0.5,
        "exploration_final_eps": 0.05,
    },
)
_PPO_LEVELS = replace(
    _PPO,
    samples=200_000,
    activation="relu",
    gamma=0.9664,
    episode=None,
    options={**_PPO.options, "ent_coef": 0.02, "gae_lambda": 0.95},
)
_LEVELS = {
    "ppo": _PPO_LEVELS,
    "a2c": replace(
        _PPO_LEVELS,
        algorithm="a2c",
        samples=300_000,
        envs=32,
        gamma=0.95,
        options={**_A2C.options, "n_steps": 8, "ent_coef": 0.01, "gae_lambda": 0.9},
    ),
    "dqn": _DQN,
}
# What the paper trained with.
_PAPER = Training(
    algorithm="dqn",
    samples=1_000_000,
    envs=1,
    hidden=(64, 64),
    activation="relu",
    learning_rate=1.946e-4,
    anneal=False,
    gamma=0.9664,
    symmetric=False,
)
_PAPERS = {"ppo": replace(_PAPER, algorithm="ppo"), "dqn": _PAPER}
# Samples of preset smoke.
_SMOKE = {
    "ppo": 24_576,
    "a2c": 65_536,
    "dqn": 10_000,
    "sac": 12_000,
    "td3": 12_000,
    "ddpg": 12_000,
}
# Stage 6, whatever stage 1 was trained with. The modes of a discrete task are trained by PPO, too: the ways
# differ by less than the error of a freely trained value function, and a policy that is learned directly
# does not depend on it.
_MODES_CONTINUOUS = replace(
    _PPO,
    samples=320_000,
    activation="relu",
    gamma=0.95,
    symmetric=False,
    episode=40,
    attempts=3,
)
_MODES_DISCRETE = replace(
    _MODES_CONTINUOUS,
    samples=400_000,
    gamma=0.9,
    episode=None,
    options={**_PPO.options, "ent_coef": 0.003, "gae_lambda": 0.9},
)
_MODES_PAPER_CONTINUOUS = replace(
    _PAPER,
    algorithm="ppo",
    samples=100_000,
    hidden=(112, 112),
    learning_rate=3.45e-4,
    gamma=0.9637,
)
_MODES_PAPER_DISCRETE = replace(_PAPER, samples=300_000, warm_start=True)
_SMOKE_MODES = 8_192
# Grid points along the longest side of the chart, by its dimension: search of M*, and sets.
_RODS = {1: 120, 2: 120, 3: 24, 4: 8}
_CELLS = {1: 2880, 2: 240, 3: 48, 4: 16}
# Coarser ones where every sample takes a physics engine's work: plants with dynamics.
_RODS_DYNAMIC = {1: 120, 2: 40, 3: 16, 4: 8}
_CELLS_DYNAMIC = {1: 720, 2: 96, 3: 30, 4: 12}
# Cells along the longest side of the lattice on which the worst-case game is played; a smoke run takes less.
LATTICE = {1: 12_000, 2: 480}
_LATTICE_SMOKE = {1: 1_200, 2: 120}


def preset(
    task: Task,
    name: str = "fast",
    *,
    noise: float = 0.1,
    seed: int = 0,
    horizon: float | None = None,
    agent: Agent | None = None,
) -> Settings:
    """The settings of a preset.

    Args:
        task: what they are for; `task.algorithm` trains stage 1.
        name: "fast", "paper" (the paper's training), or "smoke" (seconds, to see that all runs).
        noise: bound eps of the measurement noise that the controller has to survive.
        seed: of everything random.
        horizon: time T of the backward propagation [s]; by default the sets are sized to the noise, and
            preset "paper" takes the paper's T.
        agent: takes the place of stage 1; the modes then go on from it.

    Raises:
        BadInput: an unknown preset, or a value that cannot be used.
    """
    if name not in PRESETS:
        raise unknown("preset", name, PRESETS)
    stage1 = agent or _stage1(task, name)
    stage6 = _stage6(task, name, stage1.algorithm)
    task.check_noise(noise)
    dimension = task.chart.dimension
    cells, rods = (_CELLS, _RODS) if task.kinematic else (_CELLS_DYNAMIC, _RODS_DYNAMIC)
    return Settings(
        task=task.reference,
        preset=name,
        seed=seed,
        noise=noise,
        horizon=task.horizon if horizon is None and name == "paper" else horizon,
        stage1=stage1,
        stage6=replace(stage6, warm_start=True) if agent else stage6,
        cells=cells[min(dimension, 4)],
        # Whose agent goes straight on for some samples before it decides has a part of M* that rods miss.
        search="outcome" if agent else task.search,
        rods=rods[min(dimension, 4)],
        lattice=(_LATTICE_SMOKE if name == "smoke" else LATTICE).get(dimension, 0),
    )


def _stage1(task: Task, name: str) -> Training:
    """Stage 1 of a preset, with the task's algorithm."""
    check_algorithm(task.algorithm, task.name, task.levels)
    known = relative(task.algorithm, task.levels)
    if name == "paper":
        if known not in _PAPERS:
            raise BadInput(
                f"preset 'paper' has no {task.algorithm}, the paper trained with {' and '.join(_PAPERS)}: "
                "choose preset fast or smoke"
            )
        found = _PAPERS[known]
    else:
        found = (_CONTINUOUS if task.levels is None else _LEVELS)[known]
    if name == "smoke":
        found = replace(found, samples=_SMOKE[known])
    if np.any(np.subtract(task.start_high, task.start_low) < task.chart.sides - 1e-9):
        found = replace(found, episode=None)  # what lies behind the starts has to be driven to
    if known == task.algorithm:
        return found
    options = accepted(task.algorithm, found.options)
    return replace(found, algorithm=task.algorithm, options=options)


def _stage6(task: Task, name: str, algorithm: str) -> Training:
    """Stage 6 of a preset, after stage 1 with an algorithm."""
    if name == "paper":
        found = _MODES_PAPER_CONTINUOUS if task.levels is None else _MODES_PAPER_DISCRETE
        return replace(found, warm_start=found.warm_start and found.algorithm == algorithm)
    found = _MODES_CONTINUOUS if task.levels is None else _MODES_DISCRETE
    return replace(found, samples=_SMOKE_MODES, attempts=1) if name == "smoke" else found
