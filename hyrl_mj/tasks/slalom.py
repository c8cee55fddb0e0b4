"""A slalom: drive past two posts in a row, each on its left or on its right."""

from hyrl_mj.tasks.description import Scene
from hyrl_mj.tasks.pillar import PostsTask
from hyrl_mj.tasks.registry import register


@register
class Slalom(PostsTask):
    name = "slalom"
    description = "drive past two posts in a row, each on its left or on its right (PPO)"
    max_steps = 90
    start_low, start_high = (0.0, -0.9), (0.3, 0.9)
    scene = Scene(
        starts=tuple((0.0, y) for y in (-0.5, -0.1, 0.0, 0.15, 0.3, 0.6)),
        time=4.2,
    )
