"""Trials of what an environment does with its own observation, and with the place of its reset."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.fingerprint import differing
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.observations import flat
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.trials import EPISODES, HELD, SAMPLES


class _Sensor:
    """An environment whose observer sees the robot elsewhere, as noise has it.

    Attributes:
        offset: (d,) on the coordinates of the chart.
        given: what was observed since it was emptied, as vectors (o,).
    """

    def __init__(self, spec: EnvironmentSpec):
        self.instance = Instance(spec)
        self.offset, self.given = np.zeros(spec.dimension), list[np.ndarray]()
        self._own, self._within = getattr(self.instance.inner, spec.observer), False

    def put(self, state: np.ndarray) -> bool:
        """Begins at a state (S,) of MuJoCo; returns whether that is free of walls, and can be observed."""
        instance = self.instance
        vars(instance.inner).pop(instance.spec.observer, None)
        instance.reset()
        instance.arrive(state)
        setattr(instance.inner, instance.spec.observer, self._observe)
        return instance.physics.depth(instance.spec.solid) <= instance.spec.depth

    def step(self, action: Any, offset: np.ndarray) -> tuple[np.ndarray, Any]:
        """Returns what is observed (o,) after an action of the innermost environment, and its result."""
        self.offset, self.given = offset, []
        result = self.instance.inner.step(action)
        return flat(result[0], self.instance.inner.observation_space), result

    def _observe(self, *arguments: Any, **options: Any) -> Any:
        instance = self.instance
        if self._within:
            return self._own(*arguments, **options)
        self._within = True
        instance.physics.leave()
        try:
            instance.physics.write(instance.moved(instance.physics.read(), self.offset))
            seen = self._own(*arguments, **options)
        finally:
            instance.physics.come_back()
            self._within = False
        self.given.append(flat(seen, instance.inner.observation_space))
        return seen


def check_use(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if step() changes what is observed under noise, or moves the robot by it.

    The same runs are played with an observer that sees the true place, and with one that sees others, all
    over the chart. What the latter gives has to be returned, and both runs have to go the same way. Wrappers
    give the actions of a run without noise.

    Args:
        spec: what is known of the environment.
    """
    inner = Instance(spec).inner
    if not hasattr(type(inner), spec.observer) or spec.observer in getattr(
        inner, "__dict__", {spec.observer: None}
    ):  # it is made of several methods, or put in already, or the environment allows no attributes
        return
    wrapped, true, noisy = Instance(spec), _Sensor(spec), _Sensor(spec)
    actions: list[Any] = []
    wrapped.inner.step = _noting(wrapped.inner.step, actions)
    rng, half = np.random.default_rng(10), spec.chart.sides * (np.array(spec.noisy) > 0) / 2
    for z in rng.uniform(spec.start_low, spec.start_high, (EPISODES, spec.dimension)):
        state = spec.state_at(z[None])[0]
        wrapped.reset()
        wrapped.arrive(state)
        if not (true.put(state) and noisy.put(state)):
            continue
        for k in range(min(SAMPLES, spec.max_steps)):
            if k % HELD == 0:
                u = wrapped.drawn(rng)
            actions.clear()
            ended = any(wrapped.stepped(u)[2:4])
            if len(actions) != 1:  # of wrappers which step several times, or not at all
                return
            try:
                seen, result = true.step(actions[0], 0 * half)
                moved, other = noisy.step(copy.copy(actions[0]), rng.uniform(-half, half))
            except (Exception, SystemExit):  # step() may not be able to work with such observations
                break
            before, after = (one.instance.physics.read() for one in (true, noisy))
            if not np.array_equal(before, after, equal_nan=True):
                raise BadInput(
                    f"step() of {spec.name} moves the robot by what {spec.observer}() gives, where noise "
                    "does not come: let it read MuJoCo's state, or put the controller into a wrapper, which "
                    "sees the noise"
                )
            if _holds(true.given, seen) and not _holds(noisy.given, moved):
                raise BadInput(
                    f"step() of {spec.name} changes what {spec.observer}() gives where noise may show the "
                    "robot, as where it clips: let that method compute all that is observed"
                )
            if ended or any([*result[2:4], *other[2:4]]):
                break


def _noting(step: Callable[[Any], Any], actions: list[Any]) -> Callable[[Any], Any]:
    """Returns the step of an environment, which also notes its actions."""

    def noting(action: Any) -> Any:
        actions.append(copy.copy(action))
        return step(action)

    return noting


def _holds(given: list[np.ndarray], seen: np.ndarray) -> bool:
    return any(np.array_equal(one, seen, equal_nan=True) for one in given)


def check_noted(spec: EnvironmentSpec) -> None:
    """Raises `BadInput` if runs from a start on the chart depend on the place that the reset before noted.

    They are played after the reset as it is, and after one that leads to the start itself, because what it
    computes with mj_forward is computed there. Both have to go alike, to their ends and under inputs that do
    not change, which lead far away.

    Args:
        spec: what is known of the environment.
    """
    if spec.description.starts == "reset":
        return
    rng, usual, led = np.random.default_rng(11), Instance(spec), Instance(spec)
    for z in rng.uniform(spec.start_low, spec.start_high, (EPISODES, spec.dimension)):
        state = spec.state_at(z[None])[0]
        usual.put(state)
        with _leading(led, state):
            led.put(state)
        noted = differing(led.memory(), usual.memory())
        if not noted:
            return
        if usual.physics.depth(spec.solid) > spec.depth:
            continue
        u = usual.drawn(rng)
        for _ in range(spec.max_steps):
            if not np.array_equal(_told(usual, u), _told(led, u), equal_nan=True):
                raise BadInput(
                    f"reset() of {spec.name} notes where it leads to ({noted[0]}), and step() goes by that, "
                    "so a start elsewhere on the chart is none of its own: let the first step() note it, or "
                    "give starts='reset'"
                )
            if usual.report[1] or usual.report[2]:
                break


def _told(instance: Instance, u: np.ndarray) -> np.ndarray:
    """Returns numbers (k,) that tell how a step with inputs u (m,) went, and what it is judged by."""
    instance.act(u)
    instance.sense(np.zeros(instance.spec.dimension))
    judged = instance.report[0 if instance.spec.criterion.asks("reward") else 1 :]
    return np.concatenate([instance.physics.read(), instance.observation, judged])


@contextmanager
def _leading(instance: Instance, state: np.ndarray) -> Iterator[None]:
    """Has mj_forward first put an environment to the chart's place in a state (S,)."""
    own, places = mujoco.mj_forward, instance.spec.places

    def forward(model: Any, data: Any) -> None:
        if data is instance.data:
            moved = instance.physics.read()
            moved[places] = state[places]
            instance.physics.show(moved)
        own(model, data)

    mujoco.mj_forward = forward
    try:
        yield
    finally:
        mujoco.mj_forward = own
