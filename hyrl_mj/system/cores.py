"""The cores that work is spread over, of this process and of a pool; results do not depend on them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

from hyrl_mj.errors import BadInput, HyrlError
from hyrl_mj.system import progress

Job = TypeVar("Job")
Result = TypeVar("Result")
# Set where several runs share a machine; 0 for all cores.
allowed = 0


class Pool(Protocol):
    """Processes that work side by side, such as `ray.util.multiprocessing.Pool` or `multiprocessing.Pool`."""

    def map(self, work: Callable[[Any], Any], jobs: Iterable[Any], /) -> Iterable[Any]:
        """Returns the results of the jobs, in their order."""


_pool: ContextVar[Pool | None] = ContextVar("pool", default=None)


def count() -> int:
    """Returns the number of cores that this process may use."""
    if allowed:
        return allowed
    if hasattr(os, "sched_getaffinity"):  # on Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def using_pool(pool: Pool) -> Iterator[None]:
    """Spreads bulk work in the block over a pool: noisy episodes, and stage 6 of several modes.

    The results are those without a pool. Each process of the pool works with one core.

    Args:
        pool: processes with `map(function, jobs)`, as `ray.util.multiprocessing.Pool`, `multiprocessing.Pool`
            and `concurrent.futures.ProcessPoolExecutor` have it. They must be able to load the task.

    Raises:
        BadInput: the pool has no such method.
    """
    if not callable(getattr(pool, "map", None)):
        raise BadInput(
            f"{pool!r} is no pool of processes: give one with a method map(function, jobs), such as "
            "multiprocessing.Pool()"
        )
    token = _pool.set(pool)
    try:
        yield
    finally:
        _pool.reset(token)


class Processes:
    """A `Pool` of new processes, one on each core, that begin with the first job and end with this one.

    They import nothing from the current folder but what the user has named, and leave interrupts to this
    process. It is a context manager.
    """

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._workers: set[BaseProcess] = set()

    def map(self, work: Callable[[Any], Any], jobs: Iterable[Any], /) -> Iterable[Any]:
        """Returns the results of the jobs, in their order."""
        if self._pool is None:
            with _apart():  # it starts a process that looks after semaphores
                # A fork would copy the threads of torch and MuJoCo in whatever state they are.
                spawn = multiprocessing.get_context("spawn")
                self._pool = ProcessPoolExecutor(count(), spawn, initializer=_end_with_parent)
        others = {*multiprocessing.active_children()}
        with _apart():  # each job may start a process
            results = self._pool.map(work, jobs)
        self._workers |= {*multiprocessing.active_children()} - others
        return results

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        for worker in self._workers if kind else ():  # nobody waits for what they do
            worker.terminate()
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


@contextmanager
def _apart() -> Iterator[None]:
    """Processes that begin in the block do not search the current folder, and get no interrupts.

    An interrupt of this process comes after the block.
    """
    usual = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"  # Python starts them as python -c
    masks = hasattr(signal, "pthread_sigmask")  # not on Windows
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    try:
        yield
    finally:
        os.environ.pop("PYTHONSAFEPATH")
        if usual is not None:
            os.environ["PYTHONSAFEPATH"] = usual
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """Ends this process as soon as that which started it has ended, however that was."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def has_pool() -> bool:
    """Returns whether there is a pool."""
    return _pool.get() is not None


def in_processes(work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
    """Yields the results of jobs in their order: from the pool if there is one, else one after the other.

    Raises:
        HyrlError: a process of the pool was ended.
    """
    pool = _pool.get()
    try:
        yield from map(work, jobs) if pool is None else pool.map(partial(_alone, work), jobs)
    except BrokenExecutor:
        raise HyrlError(
            "a process that worked for this one was ended, as the system does where the memory is full: let "
            "other programs end, and run it again to resume"
        ) from None


def _alone(work: Callable[[Job], Result], job: Job) -> Result:
    """Does a job in a process of a pool: on one core, and without a bar of progress among those of others."""
    global allowed
    before = allowed, progress.shown
    allowed, progress.shown = 1, ""
    try:
        return work(job)
    finally:
        allowed, progress.shown = before
