"""Instances of an environment in processes, one on each core, which play the episodes of many runs.

Each process is a fork of this one. What an episode does depends on its start, inputs and noise alone, so
results do not depend on the number of processes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import warnings
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any

import numpy as np

from hyrl_mj import cores
from hyrl_mj.environments import fingerprint as written
from hyrl_mj.environments.instance import Instance, Recipe, Worn
from hyrl_mj.environments.judge import Played, Real
from hyrl_mj.environments.opening import kept_generators
from hyrl_mj.errors import BadInput, HyrlError, brief

# Fewer episodes than this for each process are played by one.
FEWEST = 16
# For how long a process waits awake for another [s]: between two samples it has to for about a millisecond.
AWAKE = 0.002
Arrays = tuple[np.ndarray, ...]


class Stage:
    """The instances of one process, and the episodes that they play.

    Args:
        recipe: how instances are made.
    """

    def __init__(self, recipe: Recipe):
        self.recipe = recipe
        self._playing: dict[tuple[int, int], Instance] = {}  # by plant and row
        self._free: list[Instance] = []
        self._resting: Instance | None = None
        self._real = Real(recipe)
        self._shared: written.Fingerprint | None = (
            None  # what a new instance shares with all others
        )

    def begin(self, plant: int, rows: np.ndarray, starts: np.ndarray) -> Arrays:
        """Begins episodes at MuJoCo's states (k, S) and gives each row of a plant an instance."""
        with kept_generators():  # once for all of them
            for row, start in zip(rows.tolist(), starts, strict=True):
                self._playing[plant, row] = self._begun(start)
        return ()

    def act(self, plant: int, rows: np.ndarray, u: np.ndarray) -> Arrays:
        """Steps episodes with inputs (k, m).

        Returns:
            MuJoCo's states (k, S), observations (k, o) and reports (k, r), which with wrappers come from
            `sense`.
        """
        return self._acted([self._playing[plant, row] for row in rows.tolist()], u)

    def sense(self, plant: int, rows: np.ndarray, noise: np.ndarray) -> Arrays:
        """Gives episodes the noise (k, d) of a sample.

        Returns:
            Observations (k, o), and with wrappers reports (k, r).
        """
        instances = [self._playing[plant, row] for row in rows.tolist()]
        reports = [i.sense(n) for i, n in zip(instances, noise, strict=True)]
        return np.array([instance.observation for instance in instances]), np.array(reports)

    def leave(self, plant: int, rows: np.ndarray) -> Arrays:
        """Lets the instances of episodes play others.

        Raises:
            BadInput: random numbers were drawn in one of them.
        """
        instances = [self._playing.pop((plant, row)) for row in rows.tolist()]
        self._free += instances
        try:
            for instance in instances:
                instance.finish()
        finally:
            for instance in instances:
                instance.quit()
        return ()

    def rest(self, rows: np.ndarray, starts: np.ndarray) -> Arrays:
        """Returns what episodes that begin in states (k, S) observe first (k, o), and depths (k,) [m]."""
        seen, depths = [], []
        for start in starts:
            try:
                self._resting = self._resting or self._new()
                seen.append(self._resting.rested(start))
            except Worn:
                self._resting = self._new()
                seen.append(self._resting.rested(start))
            depths.append(self._resting.depth())
        return np.array(seen), np.array(depths)

    def branch(self, rows: np.ndarray, states: np.ndarray, u: np.ndarray) -> Arrays:
        """Steps an environment without memory from states (k, S), written directly, with inputs u (k, m).

        Returns what `act` returns.

        Raises:
            BadInput: it remembers something after all.
        """
        instance = self._begun(states[0])
        before = written.fingerprint(instance.env)
        results = self._acted([instance] * len(u), u, states)
        if changed := written.differing(written.fingerprint(instance.env), before):
            raise BadInput(
                f"{self.recipe.source.name} remembers something in {changed[0]}, as no sampled run showed; "
                "without a memory that is always there it cannot be tabulated"
            )
        self._free.append(instance)
        return results

    def check(self, rows: np.ndarray, runs: np.ndarray) -> Arrays:
        """Plays runs (k,) of `Played` in new environments; raises `BadInput` if these go another way."""
        for run in runs:
            self._real.check(run)
        return ()

    def _acted(
        self, instances: Sequence[Instance], u: np.ndarray, begun: np.ndarray | None = None
    ) -> Arrays:
        """Steps instances with inputs (k, m), from where they are or from states (k, S) written before."""
        first = instances[0]
        states, seen = (np.empty((len(u), n)) for n in (first.physics.size, len(first.observation)))
        reports = []
        with first.undrawn():
            for i, (instance, inputs) in enumerate(zip(instances, u, strict=True)):
                if begun is not None:
                    instance.physics.write(begun[i])
                reports.append(instance.act(inputs))
                instance.physics.read(states[i])
                seen[i] = instance.observation
        return states, seen, np.array(reports, dtype=float)

    # ---- instances

    def _begun(self, start: np.ndarray) -> Instance:
        """Returns an instance that begins at a state (S,); a new one takes the place of those worn."""
        while True:
            instance = self._free.pop() if self._free else self._new()
            try:
                instance.begin(start)
                return instance
            except Worn as worn:
                instance.quit()
                if written.is_shared(str(worn)):
                    raise instance.is_shared(str(worn)) from None

    def _new(self) -> Instance:
        instance = Instance(self.recipe)
        shared = written.shared(instance.env)
        self._shared = self._shared or shared
        if changed := written.differing(shared, self._shared):
            raise instance.is_shared(changed[0])
        return instance


class Pool:
    """Plays episodes of an environment on all cores.

    Args:
        recipe: how instances are made.
    """

    def __init__(self, recipe: Recipe):
        self.recipe = recipe
        self._stage, self._owner = Stage(recipe), os.getpid()
        self._hands: list[Connection] = []
        self._lock = Lock()  # a game attacks several controllers in threads
        # Plants that nobody has any more: their number, their processes, and which rows play (n,).
        self.left: deque[tuple[int, int, np.ndarray]] = deque()

    def runs(
        self, what: str, plant: int, processes: int, rows: np.ndarray, *values: np.ndarray
    ) -> Arrays:
        """Does what `Stage.begin`, `act`, `sense` or `leave` do, each row in the same process ever again."""
        while what != "leave" and (gone := self._gone()):
            self.runs("leave", *gone)
        return self._spread(what, (plant,), rows % processes, rows, *values)

    def _gone(self) -> tuple[int, int, np.ndarray] | None:
        """Takes a plant that nobody has any more: its number, its processes, and the rows that play (k,)."""
        try:  # another thread may take the last one
            number, processes, plays = self.left.popleft()
        except IndexError:
            return None
        return number, processes, np.flatnonzero(plays)

    def rest(self, starts: np.ndarray) -> Arrays:
        """Does what `Stage.rest` does."""
        return self._any("rest", starts)

    def branch(self, states: np.ndarray, u: np.ndarray) -> Arrays:
        """Does what `Stage.branch` does."""
        return self._any("branch", states, u)

    def check(self, runs: Sequence[Played]) -> None:
        """Does what `Stage.check` does."""
        array = np.empty(len(runs), dtype=object)
        array[:] = runs
        self._any("check", array)

    def _any(self, what: str, *values: np.ndarray) -> Arrays:
        rows = np.arange(len(values[0]))
        return self._spread(what, (), rows % self.processes(len(rows)), rows, *values)

    def _spread(
        self, what: str, first: tuple[Any, ...], places: np.ndarray, *values: np.ndarray
    ) -> Arrays:
        """Does something with rows of values, each in the process of `places` (k,), and joins the answers."""
        with self._lock:
            self._open(int(places.max(initial=0)) + 1)
            parts = {int(i): np.flatnonzero(places == i) for i in np.unique(places)}
            jobs = {i: (what, (*first, *(v[rows] for v in values))) for i, rows in parts.items()}
            answers = self._answers(jobs)
        joined = []
        for column in zip(*answers.values(), strict=True):
            whole = np.empty((len(places), *column[0].shape[1:]))
            for rows, part in zip(parts.values(), column, strict=True):
                whole[rows] = part
            joined.append(whole)
        return tuple(joined)

    def _answers(self, jobs: dict[int, tuple[str, Any]]) -> dict[int, Any]:
        """Returns the answer of each process: that of number 0 is this one."""
        for i, job in jobs.items():
            if i:
                self._hands[i - 1].send(job)
        answers: dict[int, Any] = {}
        try:
            if 0 in jobs:
                what, arguments = jobs[0]
                answers[0] = getattr(self._stage, what)(*arguments)
        finally:  # what was asked for is always taken, or it would be taken for another answer
            answers |= {i: _answer(self._hands[i - 1]) for i in jobs if i}
        for answer in answers.values():
            if isinstance(answer, Exception):
                raise answer
        return answers

    def processes(self, runs: int) -> int:
        """Returns over how many processes so many runs are spread, this one included."""
        forks = "fork" in multiprocessing.get_all_start_methods()
        if not forks or multiprocessing.current_process().daemon:
            return 1
        return min(cores.count(), max(runs // FEWEST, 1))

    def _open(self, count: int) -> None:
        """Makes the processes that are missing."""
        if self._owner != os.getpid():
            # Instances and processes of a process that this one was forked from are not ours.
            self._stage, self._owner, self._hands = Stage(self.recipe), os.getpid(), []
        while len(self._hands) < count - 1:
            context = multiprocessing.get_context("fork")
            ours, theirs = context.Pipe()
            arguments = theirs, self.recipe, [*self._hands, ours]
            worker = context.Process(target=_serve, args=arguments, daemon=True)
            with warnings.catch_warnings():
                # Python 3.12 warns of threads: those of torch and MuJoCo take no part in the children.
                warnings.simplefilter("ignore", DeprecationWarning)
                worker.start()
            theirs.close()
            self._hands.append(ours)

    def __deepcopy__(self, memo: dict[int, Any]) -> Pool:
        return self


def _received(hand: Connection) -> Any:
    """Returns what comes through a pipe, which is looked at for `AWAKE` before it is waited for in sleep.

    Who sleeps is woken late, and often on the core of who wakes it.
    """
    until = time.perf_counter() + AWAKE
    while not hand.poll() and time.perf_counter() < until:
        pass
    return hand.recv()


def _answer(hand: Connection) -> Any:
    try:
        return _received(hand)
    except EOFError:
        return BadInput(
            "a process that steps an environment has ended: see what it printed, and repair it"
        )


def _serve(work: Connection, recipe: Recipe, others: Sequence[Connection]) -> None:
    """Answers what is asked through a pipe, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for other in others:
        other.close()
    stage = Stage(recipe)
    with suppress(EOFError, BrokenPipeError):
        while True:
            what, arguments = _received(work)
            try:
                answer = getattr(stage, what)(*arguments)
            except HyrlError as error:
                answer = error
            except Exception as error:
                answer = BadInput(f"{recipe.source.name} cannot be stepped: {brief(error)}")
            work.send(answer)
