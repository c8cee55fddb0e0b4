"""Functions that pause: they run in a thread of their own, and wait there for what they are told."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from contextvars import Context, copy_context
from queue import SimpleQueue
from threading import Thread
from typing import Any


class Pausing:
    """A thread that runs one function after another, each of which may pause until it is told to go on.

    What its maker has set in its context holds there, too, as by `numpy.seterr`, or `decimal`'s precision.

    Attributes:
        busy: whether a function has begun and not ended.
    """

    def __init__(self) -> None:
        self.busy = False
        self._work: SimpleQueue[Callable[[], Any] | None] = SimpleQueue()
        self._answers: SimpleQueue[Any] = SimpleQueue()
        self._news: SimpleQueue[tuple[str, Any]] = SimpleQueue()
        given = self._work, self._news, copy_context()
        Thread(target=_serve, args=given, daemon=True).start()
        weakref.finalize(self, self._work.put, None)  # the thread ends with its owner

    def begin(self, function: Callable[[], Any]) -> Any:
        """Runs a function until it pauses or ends; returns its result, if it has ended."""
        assert not self.busy, "the function before waits"
        self.busy = True
        self._work.put(function)
        return self._heard()

    def go_on(self, answer: Any) -> Any:
        """Does what `begin` does, with the function that waits for an answer."""
        self._answers.put(answer)
        return self._heard()

    def pause(self) -> Any:
        """Returns the answer that a function waits for, which calls this in the thread."""
        self._news.put(("paused", None))
        return self._answers.get()

    def _heard(self) -> Any:
        what, value = self._news.get()
        self.busy = what == "paused"
        if what == "error":
            raise value
        return value


def _serve(work: SimpleQueue[Any], news: SimpleQueue[Any], context: Context) -> None:
    """Does what is asked for in turn, until that is None; it holds on to nothing in between."""
    while (job := work.get()) is not None:
        try:
            news.put(("done", context.run(job)))
        except BaseException as error:
            news.put(("error", error))
        del job
