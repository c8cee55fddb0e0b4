"""Runs of a few seconds: less training, coarser grids, small pictures. What is attacked stays the same.

As a program it is `hyrl-mj` with such runs, for surroundings that only a new process can have:

    python tests/attacks/small.py run unit_circle --preset smoke
"""

import os
import pwd
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import hyrl_mj.judging.proof.assumptions as assumptions
import hyrl_mj.judging.proof.cells as cells
import hyrl_mj.judging.proof.replays as replays
import hyrl_mj.judging.results as results
import hyrl_mj.judging.worst_case as examination
import hyrl_mj.viz.diagnosis as diagnosis
import hyrl_mj.viz.drives as drives
import hyrl_mj.viz.figures.style as style
import hyrl_mj.viz.replay as replay
from hyrl_mj import cli
from hyrl_mj.gym_import.task import EnvironmentTask
from hyrl_mj.learning import presets
from hyrl_mj.system import limits
from hyrl_mj.tasks import Task
from hyrl_mj.tasks.unit_circle import UnitCircle
from hyrl_mj.viz.figures import FIGURES

SIZE, FPS = (480, 160), 2
STEPS = 40  # of an episode
LATTICE = 130  # about the least with cells no longer than a sample on the circle
# The same for processes of Ray's: settings of their runs.
FEW = {
    "stage1.samples": 1_024, "stage6.samples": 1_024, "cells": 130, "rods": 24, "lattice": LATTICE,
}  # fmt: skip
# Within which what is tried in a process of its own must end: of the processor, and in all [s].
SECONDS, LONGEST = 2, 10.0
KEPT = {"extended_sets", "robustness_map"}  # of the figures
# Set where the program has to run without the rights of root, in a folder that cannot be written.
NOBODY = "ATTACK_AS_NOBODY"
# What commands import when they need it.
LATE = (
    "hyrl_mj.export",
    "hyrl_mj.runs.arcs",
    "hyrl_mj.viz.shows",
    "hyrl_mj.viz.diagnosis",
    "hyrl_mj.viz.report",
    "fontTools.subset",
    "imageio_ffmpeg",
    "matplotlib.backends.backend_pdf",
    "matplotlib.pyplot",
    "mediapy",
    "mujoco.batch",
    "pydantic.dataclasses",
    "pydantic.type_adapter",
    "scipy.sparse.linalg",
    "scipy.spatial",
    "scipy.stats",
    "stable_baselines3",
    "tensorboard",
    "torch._dynamo",
    "typeguard",
)


def import_late() -> None:
    """Imports once what every forked process would import."""
    for name in LATE:
        import_module(name)


def shorten() -> None:
    """Shortens preset smoke and the replays, in this process and those that it forks."""
    presets._LATTICE_SMOKE |= {1: LATTICE, 2: 60}
    presets._GRIDS |= {1: (24, 240), 2: (24, 48)}
    presets._GRIDS_DYNAMIC |= {1: (24, 240), 2: (16, 32)}
    # The least number of samples that PPO trains on is envs x n_steps.
    presets._SMALL.options["n_steps"] = 8
    presets._SMOKE |= {"ppo": 1_024, "dqn": 3_000}
    presets._SMOKE_MODES = 1_024
    examination.CURVE = examination.CURVE[::8]
    results.EPISODES = 64
    assumptions.COMPARED = cells.STATES = 300
    replays.STARTS = dict.fromkeys(replays.STARTS, 40)
    for kind in (Task, EnvironmentTask):
        kind.effort = replace(kind.effort, checkpoints=2)
    # What never ends is stopped earlier, but not before a busy machine has started what is honest.
    limits.limit.__defaults__ = (SECONDS, limits.MEMORY)
    limits.tried.__kwdefaults__ |= {"seconds": SECONDS, "longest": LONGEST}
    limits.LONGEST = LONGEST
    style.DPI = 30
    style.STYLE["pdf.fonttype"] = 3
    for name in FIGURES.keys() - KEPT:
        del FIGURES[name]
    UnitCircle.max_steps = STEPS
    UnitCircle.scene = replace(UnitCircle.scene, starts=UnitCircle.scene.starts[:2], time=0.5)
    render = replay.render_replay

    def render_small(
        task: Any, shows: Any, path: Any, options: Any = replay.USUAL, **more: Any
    ) -> None:
        render(task, shows, path, replace(options, size=SIZE, fps=FPS), **more)

    for module in (replay, diagnosis, drives):
        module.render_replay = render_small  # type: ignore[attr-defined]


def become_nobody() -> None:
    """Gives up the rights of root, who may write everywhere."""
    if os.getuid() == 0:
        os.setuid(pwd.getpwnam("nobody").pw_uid)


if __name__ == "__main__":
    shorten()
    if os.environ.get(NOBODY):
        Path().chmod(0o555)
        become_nobody()
    cli.main()
