"""The real environment as judge: a fresh one plays the same starts and inputs, and has to end alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrl_mj.environments.instance import Instance, Recipe, Worn
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
        rewards: (k,) of the samples, or none.
    """

    start: np.ndarray
    inputs: np.ndarray
    path: np.ndarray
    observations: np.ndarray | None = None
    rewards: np.ndarray | None = None


class Real:
    """The environment as its user makes it: made, reset, put to a start, and stepped.

    It is made anew wherever it is not as new after a reset.

    Args:
        recipe: how it is made.
    """

    def __init__(self, recipe: Recipe):
        self._recipe = recipe
        self._instance: Instance | None = None

    def check(self, run: Played) -> None:
        """Raises `BadInput` if a run went otherwise than in the real environment.

        There is no tolerance: the same code computes the same from the same numbers.
        """
        instance, seen = self._reset(run.start)
        space, places = instance.env.observation_space, list(self._recipe.noisy)
        observations, path, rewards = [seen], [run.path[0]], []
        for u in run.inputs:
            observation, reward, *_ = instance.env.step(instance.action(u))
            observations.append(flat(observation, space))
            path.append(instance.physics.read()[places] + self._recipe.offset)
            rewards.append([float(reward)])
        name = instance.name
        _compare(name, "observation", run.observations, observations)
        _compare(name, "the chart's coordinate", run.path, path)
        if run.rewards is not None:
            _compare(name, "reward", run.rewards[:, None], np.reshape(rewards, (-1, 1)))

    def _reset(self, start: np.ndarray) -> tuple[Instance, np.ndarray]:
        """Returns an environment at a start (S,), and what it observes there (o,)."""
        if self._recipe.anew:
            instance = Instance(self._recipe)
            return instance, instance.put(start)
        instance = self._instance = self._instance or Instance(self._recipe)
        instance.reset()
        try:
            instance.mark()
        except Worn:
            self._instance = None
            return self._reset(start)
        return instance, instance.put(start)


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
