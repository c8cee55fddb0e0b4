"""How robots move: whether each sample begins anew, and how far it leads."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.physics import mujoco_log
from hyrl_mj.tasks.description import Outcome

if TYPE_CHECKING:
    from hyrl_mj.tasks.base import Task

# How far a sample may lead beside that of a copy that is made anew, as a share of the longest one. A velocity
# actuator of strength kv keeps m / (m + h kv) of the velocity of a mass m in a physics step of h seconds:
# 2e-5 at 1 kg, kv 1e6 and 0.05 s, but 0.67 at 1e5 kg. The finest lattice has cells of about a hundredth of a
# sample, of which this is a tenth; and it does not add up, because what lags behind once has caught up later.
# A proof takes the lag that it measures into account.
ALIKE = 1e-3
ROUNDING = 1e-12  # of positions
RUNS = 512  # side by side


def begins_anew(task: Task, of_chart: bool = False) -> bool:
    """Returns whether runs go on as copies do that are made anew at each of their samples.

    The runs start all over the chart. A third of them has random inputs, a third random ones of the limits,
    and a third changes from limit to limit at each sample. Runs are followed until they end.

    Args:
        task: the robot and its problem.
        of_chart: whether copies are made at the measured chart points; by default at the positions, at rest.
    """
    rng, chart = np.random.default_rng(0), task.chart
    z = chart.draw(500, rng)
    z = z[task.goes_on(z)][:50]
    if not len(z):
        return False
    plant, anew = task.placed(z, rng), task.plant(len(z))
    inputs, off, hops, goes_on = _inputs(task, len(z), rng), [], [], np.ones(len(z), dtype=bool)
    with mujoco_log.kept():
        for u in inputs:
            before = plant.measurement
            goes_on &= chart.contains(task.z(before)) & (task.ending(before) == Outcome.RUNNING)
            goes_on &= ~plant.unstable
            if not goes_on.any():
                break
            start = plant.qpos
            anew.set_state(*(task.state(task.z(before)) if of_chart else (start, None)))
            # A copy may be whole turns of a periodic coordinate away: the hops are compared.
            copied = anew.qpos
            plant.step(u)
            anew.step(u)
            hop = plant.qpos - start
            off.append(np.abs(hop - (anew.qpos - copied))[goes_on])
            hops.append(np.abs(hop)[goes_on])
    longest = np.concatenate(hops).max(axis=0)
    return bool((np.concatenate(off) <= ALIKE * longest + ROUNDING).all())


def ends_well(task: Task) -> bool:
    """Returns whether episodes end as a success somewhere on the chart, or up to ten times its sides beyond.

    Where they do may be small: it is looked for nearer and nearer to where the task's `miss` is least, too.
    """
    rng, chart = np.random.default_rng(0), task.chart
    # It is looked for at this number of states, and then nearer and nearer to the best of them: within these
    # shares of the chart, each a half to a quarter of the one before. A smaller end may be missed.
    states, nearer = 4_000, (0.05, 0.02, 0.005, 0.002, 0.0005)
    for beyond in (0.0, 0.1, 1.0, 10.0):
        by = np.where(chart.periodic, 0.0, beyond * chart.sides)
        low, high = chart.origin - by, chart.origin + chart.sides + by
        z = rng.uniform(low, high, (states, chart.dimension))
        for share in (*nearer, 0.0):
            with suppress(BadInput):  # a robot may be nowhere beyond its chart
                if _some_reached(task, z, rng):
                    return True
            try:
                nearest = np.repeat(z[np.argsort(task.miss(z))[: RUNS // 8]], 8, axis=0)
            except BadInput:  # it has no set-point
                break
            z = nearest + share * chart.sides * rng.uniform(-1, 1, nearest.shape)
    return False


def _some_reached(task: Task, z: np.ndarray, rng: np.random.Generator) -> bool:
    """Returns whether an episode ends as a success at a chart point (n, d), whatever is measured beside it.

    An end may ask for a height or a speed that a robot has nowhere at its start.
    """
    plant = task.placed(z, rng)
    usual = plant.measurement
    plant.set_state(plant.qpos)  # at rest
    anything = rng.normal(size=usual.shape) * 10 ** rng.uniform(-2, 2, usual.shape)
    seen = usual, plant.measurement, task.with_z(usual + anything, z)
    return bool((task.ending(np.vstack(seen)) == Outcome.REACHED).any())


def stands_still(task: Task) -> bool:
    """Returns whether nothing but its controls moves a kinematic robot.

    What a spring or a bias of an actuator adds to its speeds does not change its sign with the controls, so
    that a step backward would not lead back.
    """
    rng = np.random.default_rng(0)
    plant = task.placed(task.chart.draw(500, rng), rng)
    start = plant.qpos
    plant.coast()
    still = plant.qpos
    with mujoco_log.kept():
        plant.step(task.draw_inputs(len(start), rng))
    longest = np.abs(plant.qpos - still).max(axis=0)
    return bool((np.abs(still - start) <= ALIKE * longest + ROUNDING).all())


def _inputs(task: Task, n: int, rng: np.random.Generator) -> np.ndarray:
    """Returns the inputs (20, n, m) of the runs, sample by sample."""
    low, high = task.input_limits
    shape = (20, n, len(low))
    corners = np.where(rng.random(shape) < 0.5, low, high)
    turns = (np.arange(len(corners)) % 2 == 1)[:, None, None]
    alternating = np.where(turns, low + high - corners[:1], corners[:1])
    kind = (np.arange(n) % 3)[:, None]
    drawn = rng.uniform(low, high, shape)
    return np.select([kind == 0, kind == 1], [drawn, corners], alternating)


def largest_moves(task: Task, inertia: bool = False) -> np.ndarray:
    """Returns the largest change (p,) of each column of the measurement in one sample, as runs show it.

    They start anywhere on the chart, under inputs at their limits or in their middle, which half of the runs
    hold. Where a robot has inertia, how fast it becomes depends on where it starts and on the order of its
    inputs: as many runs start where the task does, and a third of all changes its inputs at each sample.
    What a collision or an end does is left out.
    """
    rng, chart, d = np.random.default_rng(0), task.chart, task.chart.dimension
    z = chart.draw(4 * RUNS, rng)
    z = z[task.goes_on(z)][:RUNS]
    z = np.vstack([z, task.starts(RUNS, rng)]) if inertia else z
    active, largest = np.arange(len(z)), np.zeros(len(task.noisy))
    plant, (low, high) = task.placed(z, rng), task.input_limits
    u, kind = np.zeros((len(z), len(low))), active % (3 if inertia else 2)
    held = 8  # samples after which runs that do not hold their input draw a new one
    for k in range(task.max_steps):
        if inertia or k % held == 0:
            drawn = low + (high - low) * rng.integers(3, size=u.shape) / 2
            changes = (k == 0) | (kind == 2) | ((kind == 0) & (k % held == 0))
            u = np.where(changes[:, None], drawn, u)
        before = plant.measurement
        plant.step(u[active], active)
        after, unstable = plant.measurement, plant.unstable
        goes_on = task.outcome(after, unstable)[active] == Outcome.RUNNING
        active = active[goes_on]
        change = after[active] - before[active]
        change[:, :d] = chart.difference(after[active, :d], before[active, :d])
        largest = np.maximum(largest, np.abs(change).max(axis=0, initial=0.0))
    # Moves come close to the largest one, and do not reach it: where it depends smoothly on the state, those
    # of thousands of samples fall short of it by less than a thousandth. Of robots with inertia one run in a
    # thousand goes farther by some percent than all others.
    return (1 + (0.05 if inertia else 1e-3)) * largest
