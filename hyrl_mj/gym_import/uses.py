"""Trials of an environment that knows the place of the robot past the noise.

Its own `step` may use what it observes, and what it observes may show a copy of the place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.instance import Instance, Seen, renewed, to_end
from hyrl_mj.gym_import.observations import flat, shaped
from hyrl_mj.gym_import.resets import SAME
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, SAMPLES


def check_use(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if step() changes what is observed under noise, or moves the robot by it.

    The same runs are played by an environment whose observer sees the true place, and by one whose observer
    sees others, all over the chart. What the latter gives has to be returned, and both runs have to go the
    same way. Wrappers give the actions of the former.
    """
    true, noisy = Instance(spec), Instance(spec)
    inner, offset, given = noisy.inner, np.zeros(spec.dimension), list[np.ndarray]()
    if not hasattr(type(inner), spec.observer) or spec.observer in getattr(
        inner, "__dict__", {spec.observer: None}
    ):  # it is made of several methods, or put in already, or the environment allows no attributes
        return

    def observe() -> Any:
        given.append(noisy.seen_as("now", noisy.physics.read(), offset))
        return shaped(given[-1], noisy.inner_seen, inner.observation_space)

    rng, half = np.random.default_rng(10), spec.chart.sides * (np.array(spec.noisy) > 0) / 2
    for state in spec.state_at(spec.anywhere(rng, EPISODES)):
        vars(inner).pop(spec.observer, None)
        for one in (true, noisy):  # both, so that they are reset as often
            one.reset()
            one.arrive(state)
        setattr(inner, spec.observer, observe)
        if true.physics.depth(spec.solid) > spec.depth:
            continue
        for k in range(min(SAMPLES, spec.max_steps)):
            if k % HELD == 0:
                u = true.drawn(rng)
            true.passed.clear()
            ended = any(true.stepped(u)[2:4])
            if spec.wrapped and len(true.passed) != 1:  # wrappers step several times, or not at all
                return
            noisy.script, offset[:] = iter(true.passed[:]), rng.uniform(-half, half)
            given.clear()
            try:
                ended |= any(noisy.stepped(u)[2:4])
            except BadInput:  # step() may not be able to work with such observations
                break
            before, after = true.physics.read(), noisy.physics.read()
            if not np.array_equal(before, after, equal_nan=True):
                raise BadInput(
                    f"step() of {spec.name} moves the robot by what {spec.observer}() gives, where noise "
                    "does not come: let it read MuJoCo's state, or put the controller into a wrapper, which "
                    "sees the noise"
                )
            seen = flat(noisy.inner_seen, inner.observation_space)
            if given and not any(np.array_equal(one, seen, equal_nan=True) for one in given):
                raise BadInput(
                    f"step() of {spec.name} changes what {spec.observer}() gives where noise may show the "
                    "robot, as where it clips: let that method compute all that is observed"
                )
            if ended:
                break


def check_copied(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if what is observed shows the place by what code copies into MuJoCo's state.

    A copy, as of a camera that is put above the robot, is moved by as much as the robot, whatever it was
    before. What follows the place in `userdata`, where no physics writes, is one, too, also
    scaled or filtered. Noise on the chart does not reach it.
    """
    rng, one, step = np.random.default_rng(15), Instance(spec), spec.nudge
    columns, far = one.physics.columns, float(step.max())
    parts = ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat", "userdata")  # but for forces
    others = np.setdiff1d(np.concatenate([columns[part] for part in parts]), own_of(one))
    for i, z in enumerate(spec.anywhere(rng, EPISODES if len(others) else 0)):
        inputs = [one.drawn(rng)] * (HELD if i % 2 else 1)
        none = np.zeros((len(inputs) + 1, spec.dimension))
        usual, elsewhere = spec.state_at(np.array([z, z + step]))
        before = usual.copy()
        before[others] += far
        runs = list[list[Seen]]()
        for start in (usual, elsewhere, before):
            one = renewed(one)
            runs.append([*to_end(one.play(start, inputs, none))])
        if len({len(run) for run in runs}) > 1:
            continue
        here, there, after = (run[-1].state for run in runs)
        by = np.append(step, (there - here)[spec.places])
        moved = np.abs((there - here)[others, None] - by[by != 0]) <= SAME * far
        is_copy = moved.any(axis=1) & (np.abs(after - here)[others] <= SAME * far)
        noted = np.isin(others, columns["userdata"]) & (there != here)[others]
        copies = others[is_copy | noted]
        other = here.copy()
        other[copies] = there[copies]
        seen, shown = (one.seen_as("now", state, none[0]) for state in (here, other))
        if not np.array_equal(seen, shown, equal_nan=True):
            names = ", ".join(one.physics.names[at] for at in copies[:4])
            raise BadInput(
                f"what {spec.name} observes shows {names}, to which code copies the place of the robot, "
                "where noise does not reach it: let it observe the place itself"
            )
