"""The real environment as judge: a fresh one plays the same starts and inputs, and has to end alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
        offset: (d,) what the coordinates of the chart are greater by than MuJoCo's state.
        observations: (k + 1, o), or none where noise was on them.
        rewards: (k,) of the samples, or none.
    """

    start: np.ndarray
    inputs: np.ndarray
    path: np.ndarray
    offset: np.ndarray
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

    def check(self, runs: Sequence[Played]) -> None:
        """Raises `BadInput` if runs went otherwise than in the real environment.

        There is no tolerance: the same code computes the same from the same numbers.
        """
        for run in runs:
            self._check(run)

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

    def _check(self, run: Played) -> None:
        instance, seen = self._reset(run.start)
        name, places = instance.name, list(self._recipe.noisy)
        self._compare(name, "observation", 0, run.observations, seen)
        for k, u in enumerate(run.inputs):
            observation, reward, *_ = instance.env.step(instance.action(u))
            place = instance.physics.read()[places] + run.offset
            self._compare(name, "the chart's coordinate", k + 1, run.path, place)
            rewards = None if run.rewards is None else run.rewards[:, None]
            self._compare(name, "reward", k, rewards, np.array([float(reward)]))
            told = flat(observation, instance.env.observation_space)
            self._compare(name, "observation", k + 1, run.observations, told)

    def _compare(
        self, name: str, what: str, k: int, ours: np.ndarray | None, real: np.ndarray
    ) -> None:
        if ours is None or np.array_equal(ours[k], real, equal_nan=True):
            return
        i = int(np.argmax(~((ours[k] == real) | (np.isnan(ours[k]) & np.isnan(real)))))
        raise BadInput(
            f"{name} goes another way than a new one from the same start with the same inputs: {what}[{i}] "
            f"is {ours[k][i]:.9g} after {k} sample(s), and {real[i]:.9g} in the new one; it depends on "
            "other episodes, on time, on chance, or on what it observes"
        )
