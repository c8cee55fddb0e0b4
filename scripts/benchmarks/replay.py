"""Frames of the vehicle's replay, encoded, against MuJoCo's own renderer with its default quality."""

from collections.abc import Iterator
from contextlib import closing
from copy import copy
from types import SimpleNamespace

import mujoco
import numpy as np

import hyrl_mj
from benchmarks import Figure
from benchmarks.runs import Runs
from hyrl_mj.viz import ReplayOptions
from hyrl_mj.viz.replay import Show, render_replay


def figures(runs: Runs) -> Iterator[Figure]:
    """At two sizes, and with a camera that moves."""
    task = hyrl_mj.get_task("vehicle")
    noise = hyrl_mj.Noise("alternating", 0.1)
    left = SimpleNamespace(act=lambda measured: np.where(measured[:, :1] < 1.0, 1.0, 0.0))
    arc = hyrl_mj.simulate(task, left, [0.0, 0.0], noise=noise)
    seconds = 4  # three of driving and one of the last frame

    for size, fps, camera, target in (
        ((640, 480), 60, "overhead", ">= 6x, >= 60 frames/s"),
        ((1280, 720), 25, "overhead", ">= 6x, >= 25 frames/s"),
        ((640, 480), 60, "chase", ""),
    ):

        def ours(size=size, fps=fps, camera=camera) -> int:
            options = ReplayOptions(size=size, fps=fps, camera=camera)
            render_replay(task, [Show([arc], [arc])], runs.folder / "r.mp4", options)
            return seconds * fps + 1

        def plain(size=size, fps=fps, camera=camera) -> int:
            model = _default_quality(task.model, *size)
            data, frames = mujoco.MjData(model), seconds * fps + 1
            with closing(mujoco.Renderer(model, size[1], size[0])) as renderer:
                for k in range(frames):
                    data.qpos[:] = arc.z[k % len(arc.z)]
                    mujoco.mj_forward(model, data)
                    renderer.update_scene(data, camera)
                    renderer.render()
            return frames

        name = f"replay, {camera}, {size[0]} x {size[1]}"
        against = "mujoco.Renderer, default quality"
        yield Figure(name, "frames/s", against, target, ours, plain)


def _default_quality(model: mujoco.MjModel, width: int, height: int) -> mujoco.MjModel:
    """A copy of a model with shadows and the other settings of a plain MJCF."""
    plain, default = copy(model), mujoco.MjSpec().compile()
    for name in ("shadowsize", "offsamples", "numslices", "numstacks", "numquads"):
        setattr(plain.vis.quality, name, getattr(default.vis.quality, name))
    plain.vis.global_.offwidth, plain.vis.global_.offheight = width, height
    plain.light_castshadow[:] = 1
    return plain
