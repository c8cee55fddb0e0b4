"""Noise below the wrappers of an environment: its own steps wait inside of theirs for the noise of a sample.

Stacks, delays, filters and normalisation so see what a sensor would have sent.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrl_mj.errors import BadInput, brief

if TYPE_CHECKING:
    from hyrl_mj.gym_import.instance import Instance


class Chain:
    """Plays the steps of wrapped environments in a thread that waits for noise inside of the innermost.

    Args:
        instance: of the environment, whose innermost `step` and `reset` are replaced.
    """

    def __init__(self, instance: Instance):
        self._instance = instance
        self._own_step, self._own_reset = instance.inner.step, instance.inner.reset
        try:
            instance.inner.step, instance.inner.reset = self._step, self._reset
        except Exception as error:
            raise BadInput(
                f"{instance.name} allows no attributes beside its own ({brief(error)}), and noise comes in "
                "by its step() below the wrappers: let it allow them, or leave the wrappers out"
            ) from error
        self._work: SimpleQueue[Callable[[], Any] | None] = SimpleQueue()
        self._noise: SimpleQueue[np.ndarray] = SimpleQueue()
        self._news: SimpleQueue[tuple[str, Any]] = SimpleQueue()
        self._busy = False  # with a sample that waits to be observed
        self._calls = 0
        self._inside = False  # of the environment's own reset, which may step it
        # What is done to the result of a step before wrappers get it, in a trial, in which they may write to
        # a state that noise has moved.
        self.tamper: Callable[[tuple[Any, ...]], tuple[Any, ...]] | None = None
        # The state that wrappers see, if it is not the true one.
        self._shown: np.ndarray | None = None
        Thread(target=_serve, args=(self._work, self._news), daemon=True).start()
        weakref.finalize(self, self._work.put, None)  # the thread ends with the instance

    def ask(self, work: Callable[[], Any]) -> None:
        """Begins a step or a reset, up to where the innermost environment would observe."""
        if self._busy:
            raise AssertionError("a sample has not been observed")
        self._calls, self._busy = 0, True
        self._work.put(work)
        what, value = self._news.get()
        if what != "sensing":
            self._busy = False
            if what == "error":
                raise value
            raise BadInput(
                f"a wrapper of {self._instance.name} does not step the environment in each of its steps: "
                "leave it out"
            )

    def answer(self, noise: np.ndarray) -> Any:
        """Goes on with noise (d,) to the end of the step or reset, and returns its result."""
        self._noise.put(noise)
        what, value = self._news.get()
        self._busy = False
        wrote = self._shown is not None and self._come_back(self._shown)
        if what == "error":
            raise value
        if wrote and self.tamper is None:
            raise BadInput(
                f"a wrapper of {self._instance.name} reads MuJoCo's state for what it observes, and writes "
                "to it: let it observe what the environment gives it, or let only the environment write"
            )
        return value

    def _come_back(self, shown: np.ndarray) -> bool:
        """Puts the true state back after wrappers saw another one; returns whether they wrote to it."""
        physics, self._shown = self._instance.physics, None
        now = physics.read()
        wrote = (now != shown) & ~(np.isnan(now) & np.isnan(shown))
        physics.come_back()
        if wrote.any():
            state = physics.read()
            state[wrote] = now[wrote]
            physics.show(state)
        return bool(wrote.any())

    def leave(self) -> None:
        """Ends a step that waits for noise."""
        if self._busy:
            self.answer(np.zeros(self._instance.spec.dimension))

    def _step(self, action: Any) -> Any:
        result = self._own_step(action)
        if self._inside:
            return result
        self._instance.inner_seen = result[0]
        return self._observed(result[0], result[1:])

    def _reset(self, **options: Any) -> Any:
        instance, self._inside = self._instance, True
        try:
            result = self._own_reset(**options)
        finally:
            self._inside = False
        instance.inner_seen = result[0]
        if instance.start is None:
            return result
        instance.pin()
        instance.arrive(instance.start)
        return self._observed(instance.inner_seen, result[1:])

    def _observed(self, observation: Any, rest: tuple[Any, ...]) -> tuple[Any, ...]:
        instance = self._instance
        if not self._busy:
            return (observation, *rest)
        if self.tamper is not None:
            rest = self.tamper(rest)
        self._calls += 1
        if self._calls > 1:
            raise BadInput(
                f"a wrapper of {instance.name} steps or resets the environment more than once in a step, and "
                "noise comes once a sample: give the environment a frame_skip instead"
            )
        self._news.put(("sensing", None))
        noise = self._noise.get()
        if noise.any():
            observation = instance.displaced(noise)
            if instance.spec.sensing:
                # Wrappers that read MuJoCo's state for what they observe see it where the sensor does.
                shown = instance.moved(instance.physics.read(), noise)
                instance.physics.leave()
                instance.physics.write(shown)
                self._shown = instance.physics.read()
        return (observation, *rest)


def _serve(work: SimpleQueue[Any], news: SimpleQueue[Any]) -> None:
    """Does what is asked for in turn, until that is None; it holds on to nothing in between."""
    while (job := work.get()) is not None:
        try:
            news.put(("done", job()))
        except BaseException as error:
            news.put(("error", error))
        del job
