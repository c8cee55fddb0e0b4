"""What a task's own methods raise or return wrongly becomes one sentence, with the state that provoked it.

The methods are guarded where a subclass of `Task` is made, so that the sentence is the same in checks,
training, simulation and the game.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from inspect import getattr_static, isfunction
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

import numpy as np

from hyrl_mj.errors import BadInput, HyrlError, brief, line_in
from hyrl_mj.tasks.description import Outcome

if TYPE_CHECKING:
    from hyrl_mj.tasks.base import Task

# The attribute whose length is the number of columns of what a method returns, by the method's name. Those
# with "" return one value for each row.
COLUMNS = {
    "z": "start_low",
    "with_z": "noisy",
    "observation": "observation_low",
    "measured": "noisy",
    "reward": "",
    "ending": "",
    "failed": "",
    "verdict": "",
    "arrived": "",
    "miss": "",
    "danger": "",
    "direction": "",
    "where": "plane",
    "measure": "noisy",
}


METHODS = (*COLUMNS, "state", "control", "mocap")
DEFAULTS = "hyrl_mj.tasks.base"  # the module of those that need no guard
_GUARDS: WeakSet[Callable[..., Any]] = WeakSet()


def guard(kind: type[Task]) -> None:
    """Guards the methods of a subclass of `Task`, also those of classes that are no tasks."""
    for name in METHODS:
        method = getattr_static(kind, name)
        if isinstance(method, staticmethod):
            method = _of_object(method.__func__)
        if isfunction(method) and not _is_guarded(method):
            setattr(kind, name, guarded := _guarded(name, method))
            _GUARDS.add(guarded)


def unguarded(task: Task) -> list[str]:
    """Returns the names of methods that are none of the class as it was made, so that nothing guards them."""
    kind = type(task)
    return [n for n in METHODS if n in vars(task) or not _is_guarded(getattr_static(kind, n))]


def _is_guarded(method: Any) -> bool:
    return isfunction(method) and (method in _GUARDS or method.__module__ == DEFAULTS)


def _of_object(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a static method as one of an object."""

    @wraps(function)
    def method(self: Task, *args: Any, **kwargs: Any) -> Any:
        return function(*args, **kwargs)

    return method


def read_only(value: Any) -> Any:
    """Returns an array that cannot be written to, as users' code gets what simulations go on with."""
    if not isinstance(value, np.ndarray):
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def writes(error: BaseException) -> bool:
    """Returns whether an error is that of NumPy about code that writes to a `read_only` array."""
    return isinstance(error, ValueError) and "read-only" in str(error)


def check_finite(
    task: Task, name: str, values: np.ndarray, measurement: np.ndarray, infinite: bool = False
) -> None:
    """Raises `BadInput` if method `name` gave values (n,) for measurements (n, p) that are not finite.

    They may be `infinite`, and are no NaN then.
    """
    if not math.isfinite(values.sum()):
        good = ~np.isnan(values) if infinite else np.isfinite(values)
        if not good.all():
            row = int(np.argmin(good))
            raise BadInput(
                f"{name}() of the task {task.name} gives {values[row]}"
                f"{_place(task, name, [measurement], row)}: give {'' if infinite else 'finite '}numbers"
            )


def _guarded(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def checked(self: Task, *args: Any, **kwargs: Any) -> Any:
        # It may be asked by that of a subclass, which adds a column, or about an array that is traced.
        if getattr(type(self), name) is not checked or not (
            args and isinstance(args[0], np.ndarray)
        ):
            return method(self, *args, **kwargs)
        try:
            result = method(self, *map(read_only, args), **kwargs)
        except HyrlError:
            raise
        except (Exception, SystemExit) as error:  # whatever the user's own code raises
            if writes(error):
                raise BadInput(
                    f"{name}() of the task {self.name} writes to an array that is read-only"
                    f"{line_in(error, self.source)}, as those are that it is given: let it work on a copy"
                ) from error
            row = _row_of(lambda *rows: method(self, *rows), args, name)
            raise BadInput(
                f"{name}() of the task {self.name} raises {brief(error)}{line_in(error, self.source)}"
                f"{_place(self, name, args, row)}"
            ) from error
        if name in COLUMNS:
            _check_result(self, name, args, result)
            if name == "measure":  # in single precision rewards would be rounded by the batch
                result = result.astype(float, copy=False)
        elif name == "state":
            _check_state(self, args, result)
        # Part of what was shown is read-only, too, and the caller may write to what it gets.
        shown = isinstance(result, np.ndarray) and not result.flags.writeable
        return result.copy() if shown else result

    return checked


def _check_result(task: Task, name: str, args: tuple[Any, ...], result: Any) -> None:
    """Checks the shape of what a method returned, and whether it is finite if it has to be."""
    n = args[0].shape[1 if name == "direction" else 0]
    columns = COLUMNS[name]
    shape = (n, len(getattr(task, columns))) if columns else (n,)
    if not isinstance(result, np.ndarray) or result.shape != shape:
        given = (
            f"shape {result.shape}"
            if isinstance(result, np.ndarray)
            else f"a {type(result).__name__}"
        )
        raise BadInput(
            f"{name}() of the task {task.name} gives {given} for {n} row(s): give an array of shape {shape}"
        )
    if result.dtype.kind not in "biuf":
        raise BadInput(
            f"{name}() of the task {task.name} gives {result.dtype}: give an array of real numbers"
        )
    if name in ("ending", "verdict") and n and not _are_outcomes(result):
        raise BadInput(
            f"{name}() of the task {task.name} gives {result.dtype} from {result.min()} to "
            f"{result.max()}: give a hyrl_mj.Outcome for each row"
        )
    if name in ("measure", "z", "with_z", "observation") and not math.isfinite(result.sum()):
        finite = np.isfinite(result).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise BadInput(
                f"{name}() of the task {task.name} gives {result[row].tolist()}"
                f"{_place(task, name, args, row)}: give finite numbers"
            )


def _are_outcomes(values: np.ndarray) -> bool:
    return bool(values.dtype.kind in "iu" and values.min() >= 0 and values.max() <= max(Outcome))


def _check_state(task: Task, args: tuple[Any, ...], result: Any) -> None:
    """Checks the full states that `state` returned: qpos (n, nq) and qvel (n, nv), or None."""
    if not isinstance(result, tuple) or len(result) != 2:
        raise BadInput(
            f"state() of the task {task.name} gives a {type(result).__name__}: give a tuple (qpos, qvel), "
            "with None for qvel at rest"
        )
    for part, values in zip(("qpos", "qvel"), result, strict=True):
        finite = np.isfinite(np.asarray(0.0 if values is None else values, dtype=float))
        if not finite.all():
            row = int(np.argwhere(~finite)[0][0])
            raise BadInput(
                f"state() of the task {task.name} gives a {part} that is not finite"
                f"{_place(task, 'state', args, row)}: give finite numbers"
            )


def _row_of(method: Callable[..., Any], args: tuple[Any, ...], name: str) -> int | None:
    """Returns the first row for which a method raises an error on its own; None if there is none."""
    axis = 1 if name == "direction" else 0
    n = args[0].shape[axis] if args[0].ndim > axis else 0
    for row in range(min(n, 4_096)):  # or it takes long
        rows = [
            np.take(a, [row], axis) if isinstance(a, np.ndarray) and a.ndim > axis else a
            for a in args
        ]
        try:
            method(*rows)
        except (Exception, SystemExit):
            return row
    return None


def _place(task: Task, name: str, args: Any, row: int | None) -> str:
    """Returns where a method failed: " at x = 0.1 m, y = 0.2 m"; "" if that cannot be told."""
    with suppress(Exception):  # the method that tells the chart point may be the one that failed
        # No chart point can be told from what these methods take.
        if row is not None and name not in ("measure", "measured", "control", "mocap"):
            first = args[0][0] if name == "direction" else args[0]
            placed = name in ("state", "arrived", "miss", "direction")
            point = first[row] if placed else task.z(first[[row]])[0]
            return f" at {task.chart.format(point)}"
    if row is None:
        return ""
    return f" for {np.array2string(np.asarray(args[0][row]), precision=4, threshold=8)}"
