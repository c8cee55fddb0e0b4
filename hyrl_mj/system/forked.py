"""What a forked process cannot use: threads of MuJoCo, GL contexts, and ends of pipes of who made them."""

import ctypes
import os
from typing import Any
from weakref import WeakSet

_OWN: WeakSet[Any] = WeakSet()
_LEFT: WeakSet[Any] = WeakSet()
_ENDS: WeakSet[Any] = WeakSet()


def own(thing: Any) -> None:
    """Records that a thing can be used, and deleted, in this process only."""
    _OWN.add(thing)


def is_left(thing: Any) -> bool:
    """Returns whether a thing was made by the process that this one was forked from."""
    return thing in _LEFT


def own_end(end: Any) -> Any:
    """Returns an end of a pipe that is closed in every process that is forked from this one.

    Who waits at the other end learns only so that this process has let go of it.
    """
    _ENDS.add(end)
    return end


def _after_fork() -> None:
    for end in list(_ENDS):
        end.close()
    _ENDS.clear()
    for thing in list(_OWN):
        _LEFT.add(thing)
        # It is never deleted: to delete it waits for threads or drivers that do not answer here.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))
    _OWN.clear()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)
