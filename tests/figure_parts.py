"""For tests of figures: the pixels of a PNG, and planted artifacts to draw."""

from types import SimpleNamespace

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image
from planted import (
    decisions,
    extended,
    halves,
    homing_controller,
    homing_policy,
    ideal_controller,
    sign_policy,
)

from hyrl_mj import Noise, simulate
from hyrl_mj.learning.presets import preset
from hyrl_mj.viz.figures import Shown, style

EPS = 0.1


def where(path, colour):
    """Returns the pixels (k, 2) of exactly this colour: columns from the left, rows from below."""
    picture = np.asarray(Image.open(path).convert("RGB"))
    same = (picture == np.round(255 * np.array(to_rgb(colour))).astype(int)).all(axis=-1)
    return np.argwhere(same[::-1])[:, ::-1]


def written(figure, path):
    """Returns a figure, which is written if there is a path."""
    if path is not None:
        style.write(figure, path)
    return figure


def size_of(path):
    """Returns width and height [pixels] of a PNG."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        return image.size


def policy_of(task):
    """Returns a stage-1 policy whose critical set is `decisions`."""
    return homing_policy(task) if task.name == "unit_circle" else sign_policy(task)


def controller_of(task):
    return homing_controller(task) if task.name == "unit_circle" else ideal_controller(task)


def sets_of(task, reach=0.2):
    """Returns the parts, each extended over M* by the noise bound `reach`."""
    parts = halves(task).parts
    return extended([part.dilated_by_box(task.noise_in_chart(reach)) for part in parts])


def arcs_of(task):
    """Returns the replays, and those from M*, under the paper's noise."""
    noise, horizon = Noise("alternating", EPS), task.scene.time
    starts = [*task.scene.starts, decisions(task).points[0]]
    names = [*(f"start{i}" for i in range(5)), "critical"]
    arcs = {}
    for who, loop, q in (("policy", policy_of(task), None), ("hyrl_q0", controller_of(task), 0),
                         ("hyrl_q1", controller_of(task), 1)):  # fmt: skip
        runs = simulate(task, loop, np.array(starts, dtype=float), noise, q, horizon)
        arcs |= {(name, who): arc for name, arc in zip(names, runs, strict=True)}
    return arcs


def planted_run(task, arcs=None, **settings):
    """Returns a run whose artifacts are known, with these replays, and settings that differ."""
    return SimpleNamespace(
        task=task,
        settings=preset(task, **settings),
        policy=policy_of(task),
        policy_title="RL policy (DQN)",
        steady=policy_of(task),
        controller=controller_of(task),
        critical_set=decisions(task),
        partition=halves(task),
        extended_sets=sets_of(task),
        arcs=lambda: arcs or arcs_of(task),
    )


def shown_of(task, arcs=None):
    """Returns what the figures show of a planted run with these replays."""
    return Shown(planted_run(task, arcs))
