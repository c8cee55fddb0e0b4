"""The real environment as judge: a new one plays the same starts and inputs, and has to end alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.environments.instance import Instance
from hyrl_mj.environments.observations import flat
from hyrl_mj.errors import BadInput


@dataclass(frozen=True)
class Played:
    """Samples of one run.

    Attributes:
        start: MuJoCo's state (S,) in which it begins.
        inputs: (k, m).
        path: (k + 1, d) chart points, before and after each sample.
        observations: (k + 1, o), or none where noise was on them.
        rewards: (k, 1) of the samples, or none.
    """

    start: np.ndarray
    inputs: np.ndarray
    path: np.ndarray
    observations: np.ndarray | None = None
    rewards: np.ndarray | None = None


def check(run: Played, real: Instance) -> None:
    """Raises `BadInput` if a run went otherwise than in an environment that its user would make.

    That is put to the start and stepped, past all that lets episodes be played side by side. There is no
    tolerance: the same code computes the same from the same numbers.
    """
    recipe, space = real.recipe, real.env.observation_space
    observations, path, rewards = [real.put(run.start)], [run.path[0]], []
    for u in run.inputs:
        observation, reward, *_ = real.env.step(real.action(u))
        observations.append(flat(observation, space))
        path.append(real.physics.read()[list(recipe.noisy)] + recipe.offset)
        rewards.append([float(reward)])
    _compare(real.name, "observation", run.observations, observations)
    _compare(real.name, "the chart's coordinate", run.path, path)
    _compare(real.name, "reward", run.rewards, np.reshape(rewards, (-1, 1)))


def _compare(name: str, what: str, ours: np.ndarray | None, real: Any) -> None:
    if ours is None or np.array_equal(ours, real, equal_nan=True):
        return
    same = (ours == real) | (np.isnan(ours) & np.isnan(real))
    k, i = np.argwhere(~same)[0]
    raise BadInput(
        f"{name} goes another way than a new one from the same start with the same inputs: {what}[{i}] is "
        f"{ours[k][i]:.9g} after {k} sample(s), and {real[k][i]:.9g} in the new one; it depends on other "
        "episodes, on time, on chance, or on what it observes"
    )
