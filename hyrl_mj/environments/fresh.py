"""Processes in which an environment was never made before, so that nothing can have been left behind there.

What episodes leave behind in modules, closures or other instances is there for all instances of a process,
those that play and those that judge. A process that is forked before the first instance is made, and forks
again for each judge, has none of it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from multiprocessing.connection import Connection
from typing import Any

from hyrl_mj.environments.opening import Description, preload
from hyrl_mj.environments.specification import EnvironmentSpec
from hyrl_mj.errors import BadInput, HyrlError, brief


class Fresh:
    """Plays runs in new processes.

    Args:
        description: of the environment, of which no instance has been made yet.
    """

    def __init__(self, description: Description):
        preload(description)
        self._owner = os.getpid()
        self.hand: Connection | None = None
        forks = "fork" in multiprocessing.get_all_start_methods()
        if forks and not multiprocessing.current_process().daemon:
            context = multiprocessing.get_context("fork")
            self.hand, theirs = context.Pipe()
            server = context.Process(
                target=_serve, args=(theirs, description, self.hand), daemon=True
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which stay here
                server.start()
            theirs.close()

    @property
    def there(self) -> bool:
        """Whether there are new processes: not where none can be forked, and not in forks of this one."""
        return self.hand is not None and self._owner == os.getpid()

    def check(self, spec: EnvironmentSpec, parts: Sequence[Sequence[Any]]) -> None:
        """Has each part of some runs, which are `Played`, judged in a process of its own.

        Raises:
            BadInput: a run goes another way there.
        """
        assert self.hand is not None
        facts = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name != "description"}
        try:
            self.hand.send((facts, parts))
            answers = self.hand.recv()
        except (EOFError, BrokenPipeError):
            answers = [_ended(spec.name)]
        for answer in answers:
            if answer is not None:
                raise answer


def _ended(name: str) -> BadInput:
    return BadInput(
        f"a new process that steps {name} has ended: see what it printed, and repair the environment"
    )


def _serve(work: Connection, description: Description, other: Connection) -> None:
    """Answers what is asked through a pipe, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    other.close()
    with suppress(EOFError, BrokenPipeError):
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
        try:
            theirs.send(_judged(EnvironmentSpec(description, **facts), runs))
        finally:
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
