"""Instances of an environment in processes, one on each core, which play the episodes of many runs.

What an episode does depends on its start, inputs and noise alone, so results do not depend on the number of
processes.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any

import numpy as np

from hyrl_mj.gym_import.fresh import Fresh, ended, received
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.stage import Arrays, Played, Stage
from hyrl_mj.system import cores
from hyrl_mj.system.generators import kept_generators

# Fewer episodes than this for each process are played by one.
FEWEST = 16


class Pool:
    """Plays episodes of an environment on all cores.

    Args:
        spec: what is known of the environment.
        fresh: makes processes.
    """

    def __init__(self, spec: EnvironmentSpec, fresh: Fresh):
        self.spec, self._fresh = spec, fresh
        self._stage, self._owner = Stage(spec), os.getpid()
        self._hands: list[Connection] = []
        self._lock = Lock()  # several threads may simulate at once
        # Runs of plants that nobody has any more: places (n,), numbers (n,), and which are played (n,) bool.
        self.left: deque[tuple[np.ndarray, np.ndarray, np.ndarray]] = deque()

    def scatter(self, what: str, *values: np.ndarray) -> Arrays:
        """Has all processes do something with values (k, ...): "rest" or "branch"; see `Stage`."""
        return self.ask(what, self.places(len(values[0])), *values)

    def check(self, runs: Sequence[Played], alone: bool = False) -> None:
        """Has runs played by the real environment, in new processes: one on each core, or one for each run.

        Raises:
            BadInput: a run goes another way there.
        """
        if not self._fresh.available:
            with self._lock:
                self._answers("check", {0: [runs]})
            return
        count = len(runs) if alone else min(cores.count(), len(runs))
        hands = [self._fresh.process(self.spec) for _ in range(count)]
        for i, hand in enumerate(hands):
            hand.send(("check", [runs[i::count]]))
        for answer in [self._answer(hand) for hand in hands]:
            if isinstance(answer, Exception):
                raise answer

    def places(self, n: int) -> np.ndarray:
        """Returns the processes (n,) over which so many runs are spread, the number of this one being 0."""
        count = min(cores.count(), max(n // FEWEST, 1)) if self._fresh.available else 1
        return np.arange(n) % count

    def ask(self, what: str, places: np.ndarray, *values: np.ndarray) -> Arrays:
        """Has each process do its rows of values (k, ...), by a method of `Stage`; joins the answers.

        Args:
            what: the name of the method.
            places: (k,) the process of each row; a run that is played stays in its process.
            values: the arguments.
        """
        with self._lock:
            while self.left:
                of_plant, runs, played = self.left.popleft()
                self._spread("leave", of_plant[played], runs[played])
            return self._spread(what, places, *values)

    def _spread(self, what: str, places: np.ndarray, *values: np.ndarray) -> Arrays:
        rows_of = {int(i): np.flatnonzero(places == i) for i in np.unique(places)}
        answers = self._answers(
            what, {i: [value[rows] for value in values] for i, rows in rows_of.items()}
        )
        joined = []
        for column in zip(*answers.values(), strict=True):
            whole = np.empty((len(places), *column[0].shape[1:]))
            for rows, part in zip(rows_of.values(), column, strict=True):
                whole[rows] = part
            joined.append(whole)
        return tuple(joined)

    def _answers(self, what: str, jobs: dict[int, list[Any]]) -> dict[int, Any]:
        """Returns the answer of each process."""
        if self._owner != os.getpid():
            # Instances and processes of a process that this one was forked from are not ours.
            self._stage, self._owner, self._hands = Stage(self.spec), os.getpid(), []
        while len(self._hands) < max(jobs, default=0):
            self._hands.append(self._fresh.process(self.spec))
        for i in jobs:
            if i:
                self._hands[i - 1].send((what, jobs[i]))
        answers: dict[int, Any] = dict.fromkeys(jobs)
        try:
            if 0 in jobs:
                with kept_generators():
                    answers[0] = getattr(self._stage, what)(*jobs[0])
        finally:  # what was asked for is always taken, or it would be taken for another answer
            answers |= {i: self._answer(self._hands[i - 1]) for i in jobs if i}
        for answer in answers.values():
            if isinstance(answer, Exception):
                raise answer
        return answers

    def _answer(self, hand: Connection) -> Any:
        """Returns the answer of a process, or the error that it has ended."""
        try:
            return received(hand)
        except (EOFError, ConnectionError):
            return ended(self.spec.name)
