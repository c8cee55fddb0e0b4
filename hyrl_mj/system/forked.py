"""What a forked process cannot use: threads of MuJoCo, GL contexts, and ends of pipes of who made them."""

import ctypes
import os
from typing import Any
from weakref import WeakSet

_owned: WeakSet[Any] = WeakSet()
_left: WeakSet[Any] = WeakSet()
_ends: WeakSet[Any] = WeakSet()


def own(thing: Any) -> None:
    """Records that a thing can be used, and deleted, in this process only."""
    _owned.add(thing)


def is_left(thing: Any) -> bool:
    """Returns whether a thing was made by the process that this one was forked from."""
    return thing in _left


def own_end(end: Any) -> Any:
    """Returns an end of a pipe that is closed in every process that is forked from this one.

    Who waits at the other end learns only so that this process has let go of it.
    """
    _ends.add(end)
    return end


def _after_fork() -> None:
    for end in list(_ends):
        end.close()
    _ends.clear()
    for thing in list(_owned):
        _left.add(thing)
        # It is never deleted: to delete it waits for threads or drivers that do not answer here.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))
    _owned.clear()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)
