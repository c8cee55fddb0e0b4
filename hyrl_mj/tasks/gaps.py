"""Gaps: drive through one of the four gaps beside and between three posts abreast."""

from functools import cached_property

import numpy as np

from hyrl_mj.tasks.description import Mirror, Scene
from hyrl_mj.tasks.pillar import PostsTask
from hyrl_mj.tasks.registry import register


@register
class Gaps(PostsTask):
    name = "gaps"
    description = "drive through one of the four gaps beside and between three posts (PPO)"
    max_steps = 70
    start_low, start_high = (0.0, -1.5), (0.6, 1.5)
    scene = Scene(
        starts=tuple((0.0, y) for y in (-1.3, -0.9, -0.1, 0.1, 0.9, 1.3)),
        time=3.1,
    )
    mirror = Mirror((1, -1), (-1,))

    @cached_property
    def middles(self) -> np.ndarray:
        """Middles of the gaps between posts and walls: y (K + 1,) [m]."""
        centres, radii = self.posts
        order = np.argsort(centres[:, 1])
        left, right = (centres[:, 1] + radii)[order], (centres[:, 1] - radii)[order]
        (_, low), (_, high) = self.arena
        return (np.append(low, left) + np.append(right, high)) / 2

    def reward(self, measurement: np.ndarray, u: np.ndarray) -> np.ndarray:
        off = np.abs(measurement[:, 1:2] - self.middles).min(axis=1)
        return np.maximum(super().reward(measurement, u) - off, 0.0)
