"""Instances of an environment in processes, one on each core, which play the episodes of many runs.

What an episode does depends on its start, inputs and noise alone, so results do not depend on the number of
processes. What episodes leave behind in modules, closures or other instances is there for all instances of a
process, those that play and those that judge. So a process that is forked before the first instance is made
forks again for each that plays or judges.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import warnings
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import fields
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle, send_handle
from threading import RLock
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.gym_import.opening import Description, preload
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.stage import Arrays, Played, Stage
from hyrl_mj.system import cores, limits
from hyrl_mj.system.forked import own_end
from hyrl_mj.system.generators import kept_generators

# Fewer episodes than this for each process are played by one.
FEWEST = 16


class Pool:
    """Plays episodes of an environment on all cores.

    Args:
        description: of the environment, of which this package has made no instance yet.

    Attributes:
        spec: what is known of the environment; `inspect` completes it.
        left: runs of plants that nobody has any more: places (n,), numbers (n,), and which are played (n,).
    """

    def __init__(self, description: Description):
        preload(description)
        self.spec = EnvironmentSpec(description)
        self.left: deque[tuple[np.ndarray, np.ndarray, np.ndarray]] = deque()
        self._owner, self._lock = os.getpid(), RLock()  # several threads may simulate at once
        self._stage: Stage | None = None
        self._hands: list[Connection] = []
        self._server: Connection | None = None
        if "fork" in multiprocessing.get_all_start_methods():
            context = multiprocessing.get_context("fork")
            ours, theirs = context.Pipe()
            self._server = own_end(ours)
            server = context.Process(target=_fork, args=(theirs, description), daemon=True)
            # A daemon may have no children, which nobody would end: these end with their pipe.
            here = multiprocessing.current_process()
            of_daemon, here.daemon = here.daemon, False
            try:
                with warnings.catch_warnings():  # of threads, which stay here
                    warnings.simplefilter("ignore", DeprecationWarning)
                    server.start()
            finally:
                here.daemon = of_daemon
            theirs.close()

    @property
    def forks(self) -> bool:
        """Whether there can be new processes, in this process and after no interrupt."""
        return self._server is not None and self._owner == os.getpid()

    def try_out(self) -> None:
        """Has the environment made, reset and stepped within limits of time and memory.

        Raises:
            BadInput: it cannot be, or takes more.
        """
        hand, found = self._process(), None
        hand.send(("try_out", []))
        with suppress(EOFError, ConnectionError):
            found = hand.recv() if hand.poll(limits.LONGEST) else None
        if found is None:
            raise BadInput(
                f"the environment {self.spec.name} cannot be used: where it is made, reset and stepped, its "
                f"process crashes, takes longer than {limits.SECONDS} s, or needs more than "
                f"{limits.MEMORY >> 20} MB of memory; give it other arguments"
            )
        if isinstance(found, Exception):
            raise found

    def learn(self, spec: EnvironmentSpec) -> None:
        """Takes what is known by now; instances that play by what was known before are given up."""
        self.spec, self._stage, self._hands = spec, None, []
        self.left.clear()

    def scatter(self, what: str, *values: np.ndarray) -> Arrays:
        """Has all processes do something with values (k, ...): "rest" or "branch"; see `Stage`."""
        return self.ask(what, self.places(len(values[0])), *values)

    def check(self, runs: Sequence[Played], processes: int | None = None) -> None:
        """Has runs played by the real environment, in so many new processes, by default one on each core.

        Raises:
            BadInput: a run goes another way there.
        """
        if not self.forks:
            with self._lock:
                self._answers("check", {0: [runs]})
            return
        count = min(processes or cores.count(), len(runs))
        hands = [self._process() for _ in range(count)]
        for i, hand in enumerate(hands):
            hand.send(("check", [runs[i::count]]))
        _raise_any([self._answer(hand) for hand in hands])

    def places(self, n: int) -> np.ndarray:
        """Returns the processes (n,) over which so many runs are spread, the number of this one being 0."""
        count = min(cores.count(), max(n // FEWEST, 1)) if self.forks else 1
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
            self._owner, self._stage, self._server, self._hands = os.getpid(), None, None, []
        while len(self._hands) < max(jobs, default=0):
            self._hands.append(self._process())
        for i in jobs:
            if i:
                self._hands[i - 1].send((what, jobs[i]))
        answers: dict[int, Any] = dict.fromkeys(jobs)
        try:
            if 0 in jobs:
                self._stage = self._stage or Stage(self.spec)
                with kept_generators():
                    answers[0] = getattr(self._stage, what)(*jobs[0])
        finally:  # what was asked for is always taken, or it would be taken for another answer
            answers |= {i: self._answer(self._hands[i - 1]) for i in jobs if i}
        _raise_any(answers.values())
        return answers

    def _answer(self, hand: Connection) -> Any:
        """Returns the answer of a process, or the error that it has ended."""
        try:
            return hand.recv()
        except (EOFError, ConnectionError):
            return self._ended()

    def _process(self) -> Connection:
        """Returns a pipe to a new process: it takes names of methods of a `Stage` with their arguments."""
        assert self._server is not None
        facts = {f.name: getattr(self.spec, f.name) for f in fields(self.spec)}
        del facts["description"]  # a function may be in it, which no pipe takes
        with self._lock:
            try:
                self._server.send(facts)
                return own_end(Connection(recv_handle(self._server)))
            except (EOFError, OSError) as error:
                raise self._ended() from error
            except BaseException:  # a pipe that comes too late would be taken for the next one
                self._server.close()
                self._server = None
                raise

    def _ended(self) -> BadInput:
        return BadInput(
            f"a new process that steps {self.spec.name} has ended: see what it printed, and repair the "
            "environment"
        )


def _raise_any(answers: Iterable[Any]) -> None:
    """Raises the first error of some answers."""
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer


# ---- in other processes


def _fork(hand: Connection, description: Description) -> None:
    """Forks a process for each request through a pipe; where its other end is closed, all of them end."""
    os.setpgid(0, 0)  # an interrupt at the keyboard is for who asks
    signal.signal(signal.SIGTERM, lambda *_: os.killpg(0, signal.SIGKILL))
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        while True:
            facts = hand.recv()
            ours, theirs = multiprocessing.Pipe()
            if not os.fork():
                hand.close()
                ours.close()
                _serve(theirs, EnvironmentSpec(description, **facts))
            send_handle(hand, ours.fileno(), None)
            ours.close()
            theirs.close()
    except (EOFError, OSError):
        os.killpg(0, signal.SIGKILL)


def _serve(work: Connection, spec: EnvironmentSpec) -> None:
    """Answers what is asked through a pipe, until the other end is closed, and ends the process."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    stage = Stage(spec)
    with suppress(EOFError, ConnectionError):
        while True:
            what, arguments = work.recv()
            try:
                answer = getattr(stage, what)(*arguments)
            except HyrlError as error:
                answer = error
            except BaseException as error:  # of a foreign environment
                answer = BadInput(f"{spec.name} cannot be stepped: {brief(error)}")
            sys.stdout.flush()
            work.send(answer)
    os._exit(0)
