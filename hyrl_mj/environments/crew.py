"""Processes that step copies of one environment side by side, one on each core.

Each is a fork of this process, with the environment in it. What copies do depends on their rows alone, so
results do not depend on the number of processes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import warnings
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any

import numpy as np

from hyrl_mj import cores
from hyrl_mj.environments.copies import Host, Report
from hyrl_mj.errors import BadInput, HyrlError

# Fewer copies than this for each process are faster in one.
FEWEST = 24


class Crew:
    """Steps copies of an environment, with all cores.

    Args:
        host: the environment, which this process works with itself.
    """

    def __init__(self, host: Host):
        self._host = host
        self._owner = 0
        self._hands: list[Connection] = []
        self._lock = Lock()  # a game attacks several controllers in threads

    def advance(
        self, states: np.ndarray, memories: np.ndarray, u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, Report]:
        """Does what `Host.advance` does."""
        parts = self._spread("advance", states, memories, u)
        states, memories = (np.concatenate([part[i] for part in parts]) for i in range(2))
        columns = np.concatenate([part[2].columns for part in parts])
        return states, memories, Report.of(columns)

    def observe(self, states: np.ndarray, memories: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Does what `Host.observe` does."""
        parts = self._spread("observe", states, memories)
        observed, blocked = (np.concatenate([part[i] for part in parts]) for i in range(2))
        return observed, blocked

    def _spread(self, what: str, *arrays: np.ndarray) -> list[Any]:
        """Returns what a method of hosts returns for parts of the rows of arrays."""
        with self._lock:
            return self._at_once(what, *arrays)

    def _at_once(self, what: str, *arrays: np.ndarray) -> list[Any]:
        rows = len(arrays[0])
        count = min(cores.count(), rows // FEWEST)
        own = getattr(self._host, what)
        if count <= 1 or not self._is_open(count):
            return [own(*arrays)]
        chunks = [np.array_split(array, count) for array in arrays]
        parts = [*zip(*chunks, strict=True)]
        hands = self._hands[: count - 1]
        for hand, part in zip(hands, parts[1:], strict=True):
            hand.send((what, part))
        results, error = [], None
        try:
            results = [own(*parts[0])]
        finally:  # what was asked for is always taken, or it would be taken for another answer
            for hand in hands:
                answer = _answer(hand)
                error = error or (answer if isinstance(answer, Exception) else None)
                results.append(answer)
        if error is not None:
            raise error
        return results

    def _is_open(self, count: int) -> bool:
        """Returns whether there are processes, after it has made what is missing."""
        process = multiprocessing.current_process()
        if "fork" not in multiprocessing.get_all_start_methods() or process.daemon:
            return False
        if self._owner != os.getpid():
            # Those of a process that this one was forked from are not ours.
            self._owner, self._hands = os.getpid(), []
        context = multiprocessing.get_context("fork")
        while len(self._hands) < count - 1:
            ours, theirs = context.Pipe()
            worker = context.Process(
                target=_serve, args=(theirs, self._host, [*self._hands, ours]), daemon=True
            )
            with warnings.catch_warnings():
                # Python 3.12 warns of threads: those of torch and MuJoCo take no part in the children.
                warnings.simplefilter("ignore", DeprecationWarning)
                worker.start()
            theirs.close()
            self._hands.append(ours)
        return True


def _answer(hand: Connection) -> Any:
    try:
        return hand.recv()
    except EOFError:
        return BadInput(
            "a process that steps an environment has ended: see what it printed, and repair it"
        )


def _serve(work: Connection, host: Host, others: Sequence[Connection]) -> None:
    """Answers what is asked through a pipe, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for other in others:
        other.close()
    with suppress(EOFError, BrokenPipeError):
        while True:
            what, arrays = work.recv()
            try:
                answer = getattr(host, what)(*arrays)
            except HyrlError as error:
                answer = error
            except Exception as error:
                answer = BadInput(f"{host.name} cannot be stepped: {type(error).__name__}: {error}")
            work.send(answer)
