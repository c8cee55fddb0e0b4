"""What a forked process cannot use: MuJoCo's threads and GL contexts stay in the process that made them."""

import ctypes
import os
from typing import Any
from weakref import WeakSet

_OWN: WeakSet[Any] = WeakSet()
_LEFT: WeakSet[Any] = WeakSet()


def own(thing: Any) -> None:
    """Records that a thing can be used, and deleted, in this process only."""
    _OWN.add(thing)


def is_left(thing: Any) -> bool:
    """Returns whether a thing was made by the process that this one was forked from."""
    return thing in _LEFT


def _after_fork() -> None:
    for thing in list(_OWN):
        _LEFT.add(thing)
        # It is never deleted: to delete it waits for threads or drivers that do not answer here.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))
    _OWN.clear()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)
