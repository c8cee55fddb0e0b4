"""Processes in which an environment was never made before, so that nothing can have been left behind there.

What episodes leave behind in modules, closures or other instances is there for all instances of a process,
those that play and those that judge. A process that is forked before the first instance is made, and forks
again for each judge, has none of it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any

from hyrl_mj.environments.opening import Description, preload
from hyrl_mj.environments.specification import EnvironmentSpec
from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.system.forked import own_end


class Fresh:
    """Plays runs in new processes.

    Args:
        description: of the environment, of which this package has made no instance yet.
    """

    def __init__(self, description: Description):
        preload(description)
        self._owner, self._lock = os.getpid(), Lock()
        self._hand: Connection | None = None
        forks = "fork" in multiprocessing.get_all_start_methods()
        if forks and not multiprocessing.current_process().daemon:
            context = multiprocessing.get_context("fork")
            ours, theirs = context.Pipe()
            self._hand = own_end(ours)
            server = context.Process(target=_serve, args=(theirs, description), daemon=True)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which stay here
                server.start()
            theirs.close()

    @property
    def available(self) -> bool:
        """Whether runs can be played in new processes, from this process and after no interrupt."""
        return self._hand is not None and self._owner == os.getpid()

    def check(self, spec: EnvironmentSpec, parts: Sequence[Sequence[Any]]) -> None:
        """Has each part of some runs, which are `Played`, judged in a process of its own.

        Raises:
            BadInput: a run goes another way there.
        """
        assert self._hand is not None
        facts = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name != "description"}
        with self._lock:  # several threads may simulate at once
            try:
                self._hand.send((facts, parts))
                answers = self._hand.recv()
            except (EOFError, ConnectionError):
                answers = [_ended(spec.name)]
            except BaseException:  # an answer that comes too late would be taken for the next one
                self._hand.close()
                self._hand = None
                raise
        for answer in answers:
            if answer is not None:
                raise answer


def _ended(name: str) -> BadInput:
    return BadInput(
        f"a new process that steps {name} has ended: see what it printed, and repair the environment"
    )


def _serve(work: Connection, description: Description) -> None:
    """Answers what is asked through a pipe, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(EOFError, ConnectionError):
        while True:
            facts, parts = work.recv()
            judges = [_fork(description, facts, runs) for runs in parts]
            work.send([_answer(description.name, *judge) for judge in judges])


def _fork(
    description: Description, facts: dict[str, Any], runs: Sequence[Any]
) -> tuple[int, Connection]:
    """Forks a process that judges runs, and returns its id and where its answer comes from."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    if not (pid := os.fork()):
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # it may be at work without end
        try:
            theirs.send(_judged(EnvironmentSpec(description, **facts), runs))
        finally:
            sys.stdout.flush()
            os._exit(0)
    theirs.close()
    return pid, ours


def _judged(spec: EnvironmentSpec, runs: Sequence[Any]) -> HyrlError | None:
    from hyrl_mj.environments.pool import Stage  # which imports this module

    try:
        Stage(spec).check(runs)
    except HyrlError as error:
        return error
    except BaseException as error:  # of a foreign environment
        return BadInput(f"{spec.name} cannot be stepped in a new process: {brief(error)}")
    return None


def _answer(name: str, pid: int, hand: Connection) -> HyrlError | None:
    try:
        return hand.recv()
    except EOFError:
        return _ended(name)
    finally:
        hand.close()
        os.waitpid(pid, 0)
