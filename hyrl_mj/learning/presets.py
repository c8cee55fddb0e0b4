"""The presets of a run's settings: fast, paper and smoke."""

from dataclasses import fields, replace
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.judging.game import LATTICE, Lattice, aligned_cells
from hyrl_mj.learning.settings import PRESETS, REHEARSED, Settings, Training
from hyrl_mj.policies import Agent, algorithms
from hyrl_mj.sets import enough_cells
from hyrl_mj.tasks import Task, reference

# Stage 1 of preset fast, by algorithm, for continuous inputs and for levels.
# Episodes are short for tasks that start all over the chart: the first second decides the way.
_SMALL = Training(
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
    _SMALL,
    algorithm="a2c",
    options={"n_steps": 16, "normalize_advantage": True, "use_rms_prop": False},
)
# A gradient step takes milliseconds and a sample hardly anything: many samples for each step.
_TD3 = replace(
    _SMALL,
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
# What learns a scene that nobody has tuned it for: a wide network whose first layer sees all of the chart,
# and episodes all over it.
_WIDE: dict[str, Any] = {
    "samples": 500_000,
    "hidden": (128, 128),
    "spread": True,
    "normalize": True,
    "rehearse": REHEARSED,
}
_CONTINUOUS = {
    "ppo": replace(_SMALL, **_WIDE),
    "a2c": _A2C,
    "sac": replace(
        _TD3, algorithm="sac", action_noise=0.0, options={**_TD3.options, "ent_coef": 0.02}
    ),
    "td3": _TD3,
    "ddpg": replace(_TD3, algorithm="ddpg"),
}
_SMALL_LEVELS = replace(
    _SMALL,
    samples=200_000,
    activation="relu",
    gamma=0.9664,
    episode=None,
    options={**_SMALL.options, "ent_coef": 0.02, "gae_lambda": 0.95},
)
_A2C_LEVELS = replace(
    _SMALL_LEVELS,
    algorithm="a2c",
    samples=300_000,
    envs=32,
    gamma=0.95,
    options={**_A2C.options, "n_steps": 8, "ent_coef": 0.01, "gae_lambda": 0.9},
)
_DQN = replace(
    _SMALL_LEVELS,
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
_LEVELS = {"ppo": replace(_SMALL_LEVELS, **_WIDE), "a2c": _A2C_LEVELS, "dqn": _DQN}
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
_SMOKE_MODES = 8_192
# Stage 6, for every algorithm of stage 1. The modes of a discrete task are trained by PPO, too: the returns
# of the ways differ by less than the error of a freely trained value function.
_MODES_CONTINUOUS = replace(
    _SMALL, samples=320_000, activation="relu", gamma=0.95, symmetric=False, episode=40, attempts=3
)
_MODES_DISCRETE = replace(
    _MODES_CONTINUOUS,
    samples=400_000,
    gamma=0.9,
    episode=None,
    options={**_SMALL.options, "ent_coef": 0.003, "gae_lambda": 0.9},
)
# Grid points along the longest side of the chart, by its dimension (4: or more), for the search of M* and for
# the sets; fewer for plants with dynamics, whose samples are slower to simulate.
_GRIDS = {1: (120, 2880), 2: (120, 240), 3: (24, 48), 4: (11, 13)}
_GRIDS_DYNAMIC = {1: (120, 720), 2: (40, 96), 3: (16, 30), 4: (8, 11)}
# Cells of the worst-case game's lattice in a smoke run.
_LATTICE_SMOKE = {1: 1_200, 2: 120, 3: 60}


def preset(
    task: Task,
    name: str = "fast",
    *,
    eps: float = 0.1,
    seed: int = 0,
    horizon: float | None = None,
    agent: Agent | None = None,
    algorithm: str | None = None,
) -> Settings:
    """Returns the settings of a preset.

    Args:
        task: the robot and its problem.
        name: "fast", "paper" (the paper's training), or "smoke" (seconds, to check that all stages run).
        eps: bound of the measurement noise that the controller has to survive.
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
    resolution = Settings.resolution
    rods, cells = (_GRIDS if task.kinematic else _GRIDS_DYNAMIC)[min(dimension, 4)]
    if task.kinematic and dimension == 2:
        cells = aligned_cells(task, cells)
    if not task.kinematic and dimension == 3 and name != "smoke":
        # As many more as the noise needs, up to 88 (680,000 nodes); most of them are not simulated.
        cells = enough_cells(task.chart, task.noise_in_chart(eps), cells, most=88)
    if (most := task.learning.cells) is not None:
        rods, cells = min(rods, most), min(cells, most)
        resolution = 1 / 8  # longer last rods: runs from many nodes take too long
    settings = Settings(
        task=reference(task),
        preset=name,
        seed=seed,
        eps=eps,
        horizon=task.learning.horizon if horizon is None and name == "paper" else horizon,
        stage1=stage1,
        stage6=replace(stage6, warm_start=True) if agent else stage6,
        cells=cells,
        # Rods miss a part of M* if the agent goes straight on for some samples before it picks a way.
        search="outcome" if agent else task.learning.search,
        rods=rods,
        resolution=resolution,
        lattice=(_LATTICE_SMOKE if name == "smoke" else LATTICE).get(dimension, 0)
        if dimension < 3 or not Lattice.why_not(task)
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
    if name == "fast":
        training = replace(training, attempts=3)
    if name != "paper":
        if known == "ppo" and task.mirror is None:
            # A mirror doubles the width, see `Training.symmetric`, and halves what there is to learn.
            training = replace(training, hidden=(192, 192))
        if algorithm == task.learning.algorithm:
            training = _with(training, task, "training")
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
    if name == "paper" and continuous:
        return replace(
            _PAPER, samples=100_000, hidden=(112, 112), learning_rate=3.45e-4, gamma=0.9637
        )
    if name == "paper":
        return replace(_PAPER, algorithm="dqn", samples=300_000, warm_start=algorithm == "dqn")
    usual = _MODES_CONTINUOUS if continuous else _MODES_DISCRETE
    training = _with(usual, task, "modes")
    if name == "smoke":
        return replace(training, samples=_SMOKE_MODES, attempts=1)
    most = task.effort.trainings
    return training if most is None else replace(training, attempts=min(training.attempts, most))


def _with(training: Training, task: Task, of: str) -> Training:
    """Returns a training with the changes that `learning.training` or `learning.modes` of a task make.

    Raises:
        BadInput: there is no such field, or it cannot have the value.
    """
    changes, known = getattr(task.learning, of), [field.name for field in fields(training)]
    for name in changes:
        if name not in known:
            raise unknown(f"field in learning.{of} of {task.name}", name, known)
    try:
        return replace(training, **changes)
    except BadInput as error:
        raise BadInput(f"learning.{of} of {task.name}: {error}") from error
