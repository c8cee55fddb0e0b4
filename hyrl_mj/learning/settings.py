"""The settings of a run, in frozen dataclasses, and their presets: fast, paper and smoke."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np

from hyrl_mj.errors import BadInput, check_bound, check_seed, unknown
from hyrl_mj.game import LATTICE, Lattice
from hyrl_mj.learning.options import check_options
from hyrl_mj.policies import ACTIVATIONS, ALGORITHMS, Agent, algorithms
from hyrl_mj.ranges import (
    By,
    Flag,
    Instance,
    Integer,
    Number,
    OneOf,
    Optional,
    Several,
    Text,
    check_fields,
)
from hyrl_mj.sets import Grid
from hyrl_mj.tasks import SEARCHES, Task, reference

PRESETS = ("fast", "paper", "smoke")

# Samples of the longest episode, and grid cells along the longest side of a chart.
LONGEST = 100_000
CELLS = Integer(2, 10**6)


@dataclass(frozen=True)
class Training:
    """How SB3 trains one policy. A field beside whose type a rule stands is checked by it.

    Attributes:
        algorithm: one of `hyrl_mj.policies.ALGORITHMS`, or `module:Class` of another one.
        samples: total number of environment samples.
        envs: number of episodes side by side.
        hidden: widths of the hidden layers.
        activation: function between the layers, one of `hyrl_mj.policies.ACTIVATIONS`.
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

    algorithm: Annotated[str, Text()]
    samples: Annotated[int, Integer(1, 10**9)]
    envs: Annotated[int, Integer(1, 2**16)]
    hidden: Annotated[tuple[int, ...], Several(Integer(1, 4_096), 1, 16)]
    activation: Annotated[str, OneOf(ACTIVATIONS)]
    learning_rate: Annotated[float, Number(0, 1, above=True)]
    anneal: Annotated[bool, Flag()]
    gamma: Annotated[float, Number(0, 1, above=True)]
    symmetric: Annotated[bool, Flag()]
    warm_start: Annotated[bool, Flag()] = False
    episode: Annotated[int | None, Optional(Integer(1, LONGEST))] = None
    attempts: Annotated[int, Integer(1, 1_000)] = 1
    action_noise: Annotated[float, Number(0, 10)] = 0.0
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)
        if ":" not in self.algorithm and self.algorithm not in ALGORITHMS:
            raise unknown("algorithm", self.algorithm, [*ALGORITHMS, "or module:Class"])
        check_options(self.algorithm, self.options, samples=self.samples, envs=self.envs)
        if self.action_noise and self.algorithm in ("ppo", "a2c", "dqn"):
            raise BadInput(
                f"action_noise {self.action_noise:g} cannot be used, because {self.algorithm} explores "
                "without it: give 0"
            )

    @property
    def title(self) -> str:
        """The name of the algorithm, such as "PPO"."""
        return algorithms.title(self.algorithm)


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
        lattice: lattice cells along the longest side for the worst-case game, fewer where these do not fit
            into the memory; 0 for the usual number.
        resolution: length of the last rods, as a share of the first.
        search: search method for critical points, "rods" or "outcome".
        everywhere: whether the noise acts on all coordinates, not only on the task's noisy ones.
    """

    task: Annotated[str, Text()]
    preset: Annotated[str, OneOf(PRESETS)]
    seed: Annotated[int, By(check_seed)]
    noise: Annotated[float, By(check_bound)]
    horizon: Annotated[float | None, Optional(Number(0, 3_600, above=True))]
    stage1: Annotated[Training | Agent, Instance((Training, Agent))]
    stage6: Annotated[Training, Instance((Training,))]
    cells: Annotated[int, CELLS]
    rods: Annotated[int, CELLS]
    lattice: Annotated[int, Integer(0, 10**6)]
    resolution: Annotated[float, Number(1e-6, 1)] = 1 / 32
    search: Annotated[str, OneOf(SEARCHES)] = "rods"
    everywhere: Annotated[bool, Flag()] = False

    def __post_init__(self) -> None:
        check_fields(self)
        if self.stage6.gamma == 1:
            raise BadInput(
                "stage6.gamma 1.0 cannot be used, because the cost of leaving a mode's set for ever would be "
                "infinite: give a number less than 1"
            )
        if self.stage6.algorithm not in ALGORITHMS:
            raise unknown("stage6.algorithm", self.stage6.algorithm, ALGORITHMS)

    def check(self, task: Task) -> None:
        """Raises `BadInput` if a value does not fit the task: its chart, its episodes, or its inputs."""
        task.check_noise(self.noise, self.everywhere)
        longest = task.max_steps * task.dt
        if self.horizon is not None and self.horizon > longest:
            raise BadInput(
                f"horizon {self.horizon:g} s cannot be used: give at most {longest:g} s, the length of an "
                f"episode of {task.name}"
            )
        trainings = [t for t in (self.stage1, self.stage6) if isinstance(t, Training)]
        for name in {training.algorithm for training in trainings} & set(ALGORITHMS):
            algorithms.check(name, task.name, task.learning.levels)
        for count in (self.cells, self.rods):
            Grid.with_cells(task.chart, count)
        if self.lattice and task.chart.dimension < 3:
            Grid.with_cells(task.chart, CELLS.checked("lattice", self.lattice))


# Stage 1 of preset fast, by algorithm, for continuous inputs and for levels.
# Episodes are short for tasks that start all over the chart: the first second decides the way.
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
# A gradient step takes milliseconds and a sample hardly anything: many samples for each step.
_TD3 = replace(
    _PPO,
    algorithm="td3",
    samples=48_000,
    envs=32,
    activation="relu",
    gamma=0.95,
    action_noise=0.3,
    options={
        "buffer_size": 100_000,
        "learning_starts": 1_000,
        "batch_size": 256,
        "train_freq": 1,
        "gradient_steps": 1,
        "tau": 0.02,
    },
)
_DDPG = replace(_TD3, algorithm="ddpg")
_SAC = replace(_TD3, algorithm="sac", action_noise=0.0, options={**_TD3.options, "ent_coef": 0.02})
_CONTINUOUS = {"ppo": _PPO, "a2c": _A2C, "sac": _SAC, "td3": _TD3, "ddpg": _DDPG}
_PPO_LEVELS = replace(
    _PPO,
    samples=200_000,
    activation="relu",
    gamma=0.9664,
    episode=None,
    options={**_PPO.options, "ent_coef": 0.02, "gae_lambda": 0.95},
)
_A2C_LEVELS = replace(
    _PPO_LEVELS,
    algorithm="a2c",
    samples=300_000,
    envs=32,
    gamma=0.95,
    options={**_A2C.options, "n_steps": 8, "ent_coef": 0.01, "gae_lambda": 0.9},
)
_DQN = replace(
    _PPO_LEVELS,
    algorithm="dqn",
    samples=150_000,
    envs=64,
    learning_rate=1e-3,
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
_LEVELS = {"ppo": _PPO_LEVELS, "a2c": _A2C_LEVELS, "dqn": _DQN}
# The paper's training, and its algorithms.
_PAPER = replace(
    _DQN,
    algorithm="ppo",
    samples=1_000_000,
    envs=1,
    learning_rate=1.946e-4,
    anneal=False,
    symmetric=False,
    options={},
)
_PAPERS = ("ppo", "dqn")
# Samples of preset smoke.
_SMOKE = {"ppo": 24_576, "a2c": 65_536, "dqn": 10_000, "sac": 12_000, "td3": 12_000, "ddpg": 12_000}
# Stage 6, for every algorithm of stage 1. The modes of a discrete task are trained by PPO, too: the returns
# of the ways differ by less than the error of a freely trained value function.
_MODES_CONTINUOUS = replace(
    _PPO, samples=320_000, activation="relu", gamma=0.95, symmetric=False, episode=40, attempts=3
)
_MODES_DISCRETE = replace(
    _MODES_CONTINUOUS,
    samples=400_000,
    gamma=0.9,
    episode=None,
    options={**_PPO.options, "ent_coef": 0.003, "gae_lambda": 0.9},
)
_MODES_PAPER_CONTINUOUS = replace(
    _PAPER, samples=100_000, hidden=(112, 112), learning_rate=3.45e-4, gamma=0.9637
)
_MODES_PAPER_DISCRETE = replace(_PAPER, algorithm="dqn", samples=300_000, warm_start=True)
_SMOKE_MODES = 8_192
# Grid points along the longest side of the chart, by its dimension, for the search of M* and for the sets;
# fewer for plants with dynamics, whose samples are slower to simulate.
_GRIDS = {1: (120, 2880), 2: (120, 240), 3: (24, 48), 4: (8, 16)}
_GRIDS_DYNAMIC = {1: (120, 720), 2: (40, 96), 3: (16, 30), 4: (8, 12)}
# Cells of the worst-case game's lattice in a smoke run.
_LATTICE_SMOKE = {1: 1_200, 2: 120, 3: 60}


def preset(
    task: Task,
    name: str = "fast",
    *,
    noise: float = 0.1,
    seed: int = 0,
    horizon: float | None = None,
    agent: Agent | None = None,
    algorithm: str | None = None,
) -> Settings:
    """Returns the settings of a preset.

    Args:
        task: the robot and its problem.
        name: "fast", "paper" (the paper's training), or "smoke" (seconds, to check that all stages run).
        noise: bound eps of the measurement noise that the controller has to survive.
        seed: seed of all random numbers.
        horizon: time T of the backward propagation [s]; by default the sets are sized to the noise, and
            preset "paper" takes the paper's T.
        agent: agent in place of stage 1; the training of the modes then continues from it.
        algorithm: algorithm of stage 1, by default the task's.

    Raises:
        BadInput: an unknown preset, or a value that cannot be used.
    """
    if name not in PRESETS:
        raise unknown("preset", name, PRESETS)
    stage1 = agent or _stage1(task, name, algorithm or task.learning.algorithm)
    stage6 = _stage6(task, name, stage1.algorithm)
    dimension = task.chart.dimension
    rods, cells = (_GRIDS if task.kinematic else _GRIDS_DYNAMIC)[min(dimension, 4)]
    settings = Settings(
        task=reference(task),
        preset=name,
        seed=seed,
        noise=noise,
        horizon=task.learning.horizon if horizon is None and name == "paper" else horizon,
        stage1=stage1,
        stage6=replace(stage6, warm_start=True) if agent else stage6,
        cells=cells,
        # Rods miss a part of M* if the agent goes straight on for some samples before it picks a way.
        search="outcome" if agent else task.learning.search,
        rods=rods,
        lattice=(_LATTICE_SMOKE if name == "smoke" else LATTICE).get(dimension, 0)
        if dimension < 3 or Lattice.possible(task)
        else 0,
    )
    settings.check(task)
    return settings


def _stage1(task: Task, name: str, algorithm: str) -> Training:
    """Returns the training of stage 1 with an algorithm."""
    levels = task.learning.levels
    algorithms.check(algorithm, task.name, levels)
    known = algorithms.sb3_relative(algorithm, levels)
    if name == "paper" and known not in _PAPERS:
        raise BadInput(
            f"preset 'paper' has no {algorithm}, the paper trained with {' and '.join(_PAPERS)}: "
            "choose preset fast or smoke"
        )
    training = _PAPER if name == "paper" else (_CONTINUOUS if levels is None else _LEVELS)[known]
    if name == "smoke":
        training = replace(training, samples=_SMOKE[known])
    if np.any(np.subtract(task.start_high, task.start_low) < task.chart.sides - 1e-9):
        # Episodes are not cut short: states outside the start region are only met late in an episode.
        training = replace(training, episode=None)
    options = training.options
    if known != algorithm:
        options = algorithms.accepted_options(algorithm, options)
    return replace(training, algorithm=algorithm, options=options)


def _stage6(task: Task, name: str, algorithm: str) -> Training:
    """Returns the training of stage 6 after stage 1 with an algorithm."""
    continuous = task.learning.levels is None
    if name == "paper":
        training = _MODES_PAPER_CONTINUOUS if continuous else _MODES_PAPER_DISCRETE
        return replace(training, warm_start=training.warm_start and training.algorithm == algorithm)
    training = _MODES_CONTINUOUS if continuous else _MODES_DISCRETE
    return replace(training, samples=_SMOKE_MODES, attempts=1) if name == "smoke" else training
