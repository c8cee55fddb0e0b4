"""A task's mirror is tried: mirrored states under mirrored inputs have to do the same, mirrored."""

from __future__ import annotations

from itertools import product

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import mjcf, mujoco_log
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.description import Outcome

# How far images may be off, as a share of the range of what is compared: friction is solved for directions
# that are no images of each other, which moves the wheels of `rover` by 0.013.
ALIKE = 0.02
# Images that agree up to this share of the range have to have the same end and the same reward.
SAME = 1e-6


def try_mirror(task: Task) -> None:
    """Raises `BadInput` if mirrored states under mirrored inputs do not do what the states do, mirrored.

    The runs start all over the chart, so that those near obstacles are among them. The image of a state is
    that whose observation is the mirrored one: by `measured`, else that of the chart point of which some
    coordinates have the other sign.
    """
    if task.mirror is None:
        return
    rng, seen = np.random.default_rng(0), np.array(task.mirror.observation)
    n, chart = task.effort.mirrored, task.chart
    anywhere = chart.draw(n // 2, rng)
    z = np.vstack([task.starts(n // 4, rng), anywhere, _near_obstacles(task, n // 4, rng)])
    image = _image(task, z, seen)
    inside = chart.contains(image) & chart.contains(z)
    inside &= task.goes_on(z) | task.goes_on(image)
    if not inside.any():
        raise BadInput(
            "its mirror cannot be tried: the images of all states lie outside of the chart"
        )
    z, image = z[inside], image[inside]
    plant, other = task.placed(z), task.placed(image)
    u = np.zeros((len(z), len(task.inputs)))
    running = np.ones(len(z), dtype=bool)
    with mujoco_log.kept():
        for sample in range(6):
            running &= _compare(task, z, running, sample, u, (plant.measurement, other.measurement))
            running &= task.ending(plant.measurement) == Outcome.RUNNING
            u = task.draw_inputs(len(z), rng)
            plant.step(u)
            other.step(np.clip(u * task.mirror.inputs, *task.input_limits))
            running &= ~(plant.unstable | other.unstable)


def _near_obstacles(task: Task, n: int, rng: np.random.Generator) -> np.ndarray:
    """Returns up to n chart points (k, d) near obstacles, where the chart begins with places in the plane."""
    ids = [task.model.geom(name).id for name in mjcf.obstacles(task.model)]
    if type(task).where is not Task.where or task.chart.dimension < 2 or not ids:
        return np.empty((0, task.chart.dimension))
    z = task.chart.draw(n, rng)
    which = rng.integers(len(ids), size=n)
    centres = mjcf.geom_positions(task.model, ids)[:, list(task.plane)][which]
    wide = 1.5 * np.minimum(task.model.geom_rbound[ids], task.chart.sides[:2].max())[which]
    z[:, :2] = centres + rng.uniform(-1, 1, (n, 2)) * wide[:, None]
    return z[task.chart.contains(z)]


def _image(task: Task, z: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Returns the chart points (n, d) whose observations are the mirrored ones.

    Raises:
        BadInput: there are none that can be found.
    """
    plant = task.placed(z)
    observed = task.observation(plant.measurement)
    if type(task).measured is not Task.measured:
        return task.z(task.measured(observed * seen))
    wide = np.maximum(np.ptp(observed, axis=0), SAME)
    for signs in product((1, -1), repeat=task.chart.dimension):
        image = z * signs
        plant.set_state(*task.state(image))
        off = np.abs(task.observation(plant.measurement) - observed * seen) / wide
        if (off <= SAME).all() and task.chart.contains(image).all():
            return image
    raise BadInput(
        "its mirror cannot be tried: the mirrored observation is not that of the same chart point with other "
        "signs; give it a measured(observation), or no mirror"
    )


def _compare(
    task: Task,
    z: np.ndarray,
    running: np.ndarray,
    sample: int,
    u: np.ndarray,
    measured: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Returns which measurements (n, p) of runs and of their images are images but for rounding: (n,) bool.

    The others are not followed any more: after contacts, small differences grow.

    Raises:
        BadInput: some of the running ones are no images, or end or earn otherwise.
    """
    assert task.mirror is not None
    seen = np.array(task.mirror.observation)
    observed, image = (task.observation(m) for m in measured)
    off = (np.abs(image - observed * seen) / np.maximum(np.ptp(observed, axis=0), 1e-3)).max(axis=1)
    ends, others = (task.ending(m) for m in measured)
    same = running & (off <= SAME)
    rewards = task.reward(measured[0], u), task.reward(measured[1], u * task.mirror.inputs)
    apart = np.abs(rewards[0] - rewards[1]) > ALIKE * max(float(np.ptp(rewards[0])), 1e-3)
    wrong = (running & (off > ALIKE)) | (same & ((ends != others) | apart))
    if not wrong.any():
        return np.asarray(same)
    row = int(np.argmax(wrong))
    where = (
        f"{task.chart.format(z[row])}, {sample} sample(s) later,"
        if sample
        else task.chart.format(z[row])
    )
    told = [
        f"is observed as {np.round(o[row], 4).tolist()} ({Outcome(e[row]).label}, reward {r[row]:.4g})"
        for o, e, r in ((observed, ends, rewards[0]), (image, others, rewards[1]))
    ]
    raise BadInput(
        f"mirror is no symmetry of it: {where} {told[0]}, and its image {told[1]}; change its signs, "
        "what is not symmetric, or give none"
    )
