"""The cores that work is spread over, of this process and of a pool; results do not depend on them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, Protocol, TypeVar

from hyrl_mj.errors import BadInput
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


def has_pool() -> bool:
    """Returns whether there is a pool."""
    return _pool.get() is not None


def in_processes(work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
    """Yields the results of jobs in their order: from the pool if there is one, else one after the other."""
    pool = _pool.get()
    yield from map(work, jobs) if pool is None else pool.map(partial(_alone, work), jobs)


def _alone(work: Callable[[Job], Result], job: Job) -> Result:
    """Does a job in a process of a pool: on one core, and without a bar of progress among those of others."""
    global allowed
    before = allowed, progress.enabled
    allowed, progress.enabled = 1, False
    try:
        return work(job)
    finally:
        allowed, progress.enabled = before
