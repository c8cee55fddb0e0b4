"""What tests of figures look at: the pixels of a PNG, and planted artifacts to draw."""

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image
from planted import (
    decisions,
    halves,
    homing_controller,
    homing_policy,
    ideal_controller,
    sign_policy,
)

from hyrl_mj import ExtendedSets, Noise, simulate

EPS = 0.1


def where(path, colour):
    """The pixels (k, 2) that have just this colour: from the left, and from below."""
    picture = np.asarray(Image.open(path).convert("RGB"))
    found = (picture == np.round(255 * np.array(to_rgb(colour))).astype(int)).all(axis=-1)
    return np.argwhere(found[::-1])[:, ::-1]


def size_of(path):
    """Width and height [pixels] of what is a PNG."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        return image.size


def policy_of(task):
    """A stage-1 policy that decides where `decisions` says."""
    return homing_policy(task) if task.name == "unit_circle" else sign_policy(task)


def controller_of(task):
    return homing_controller(task) if task.name == "unit_circle" else ideal_controller(task)


def sets_of(task, reach=0.2):
    """The parts, each reaching so far over M* as it would be by that much noise."""
    parts = halves(task).parts
    sets = tuple(part.dilated_by_box(task.noise_in_chart(reach)) for part in parts)
    everywhere = np.ones(len(sets[0].values), dtype=bool)
    nowhere = np.empty((0, task.chart.dimension)), np.empty(0)
    return ExtendedSets((0, 1), sets, (everywhere,) * 2, 0.25, EPS, *nowhere)


def arcs_of(task):
    """The replays, and the policy's from M*, under the paper's noise."""
    noise, horizon = Noise("alternating", EPS), task.replay_time
    starts = [*task.replay_starts, decisions(task).points[0]]
    names = [*(f"start{i}" for i in range(5)), "critical"]
    found = {}
    for who, loop, q in (("policy", policy_of(task), None), ("hyrl_q0", controller_of(task), 0),
                         ("hyrl_q1", controller_of(task), 1)):  # fmt: skip
        arcs = simulate(task, loop, np.array(starts, dtype=float), noise, q, horizon)
        found |= {(name, who): arc for name, arc in zip(names, arcs, strict=True)}
    return found
