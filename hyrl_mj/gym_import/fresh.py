"""Processes in which an environment was never made before, so that nothing can have been left behind there.

What episodes leave behind in modules, closures or other instances is there for all instances of a process,
those that play and those that judge. A process that is forked before the first instance is made, and forks
again for each that plays or judges, has none of it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
import warnings
from contextlib import suppress
from dataclasses import fields
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle, send_handle
from threading import Lock
from typing import Any

from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.gym_import.opening import Description, preload
from hyrl_mj.gym_import.specification import EnvironmentSpec
from hyrl_mj.gym_import.stage import Stage
from hyrl_mj.system import limits
from hyrl_mj.system.forked import own_end

# For how long a process waits awake for another [s]: between two samples it has to for about a millisecond.
AWAKE = 0.002


class Fresh:
    """Makes processes of one in which no environment was ever made.

    Args:
        description: of the environment, of which this package has made no instance yet.
    """

    def __init__(self, description: Description):
        preload(description)
        self._owner, self._lock = os.getpid(), Lock()
        self._hand: Connection | None = None
        if "fork" in multiprocessing.get_all_start_methods():
            context = multiprocessing.get_context("fork")
            ours, theirs = context.Pipe()
            self._hand = own_end(ours)
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
    def available(self) -> bool:
        """Whether there can be new processes, in this process and after no interrupt."""
        return self._hand is not None and self._owner == os.getpid()

    def process(self, spec: EnvironmentSpec) -> Connection:
        """Returns a pipe to a new process: it takes names of methods of a `Stage` with their arguments."""
        assert self._hand is not None
        facts = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name != "description"}
        with self._lock:  # several threads may simulate at once
            try:
                self._hand.send(facts)
                return own_end(Connection(recv_handle(self._hand)))
            except (EOFError, OSError) as error:
                raise ended(spec.name) from error
            except BaseException:  # a pipe that comes too late would be taken for the next one
                self._hand.close()
                self._hand = None
                raise

    def try_out(self, spec: EnvironmentSpec) -> None:
        """Has the environment made, reset and stepped within limits of time and memory.

        Raises:
            BadInput: it cannot be, or takes more.
        """
        hand, found = self.process(spec), None
        hand.send(("try_out", []))
        with suppress(EOFError, ConnectionError):
            found = hand.recv() if hand.poll(limits.LONGEST) else None
        if found is None:
            raise BadInput(
                f"the environment {spec.name} cannot be used: where it is made, reset and stepped, its "
                f"process crashes, takes longer than {limits.SECONDS} s, or needs more than "
                f"{limits.MEMORY >> 20} MB of memory; give it other arguments"
            )
        if isinstance(found, Exception):
            raise found


def received(hand: Connection) -> Any:
    """Returns what comes through a pipe, which is looked at for `AWAKE` before it is waited for in sleep.

    Who sleeps is woken late, and often on the core of who wakes it.
    """
    until = time.perf_counter() + AWAKE
    while not hand.poll() and time.perf_counter() < until:
        pass
    return hand.recv()


def ended(name: str) -> BadInput:
    """Returns the error that a process of an environment has ended."""
    return BadInput(
        f"a new process that steps {name} has ended: see what it printed, and repair the environment"
    )


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
            what, arguments = received(work)
            try:
                answer = getattr(stage, what)(*arguments)
            except HyrlError as error:
                answer = error
            except BaseException as error:  # of a foreign environment
                answer = BadInput(f"{spec.name} cannot be stepped: {brief(error)}")
            sys.stdout.flush()
            work.send(answer)
    os._exit(0)
