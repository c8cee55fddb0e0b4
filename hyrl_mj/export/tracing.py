"""Follows NumPy code from its argument to its result, and keeps the operations on the way."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from hyrl_mj.errors import BadInput, brief
from hyrl_mj.export.private_copies import PrivateCopies
from hyrl_mj.export.traced_array import Operation, Program, Traced, apply, take
from hyrl_mj.export.vocabulary import BATCH, Untraceable


def trace(function: Callable[..., Any], samples: Mapping[str, np.ndarray], name: str) -> Program:
    """What a function does with its arguments.

    Args:
        function: takes arrays with one row for each of the batch, gives one such array or a tuple of them.
        samples: for each argument `BATCH` rows as it may get them.
        name: of the function, for people.

    Raises:
        BadInput: it does what cannot be followed.
    """
    inputs = tuple(Operation("input", (key,), {}, value) for key, value in samples.items())
    try:
        with np.errstate(all="ignore"):
            answer = PrivateCopies(REPLACEMENTS).of(function)(*map(Traced, inputs))
    except Untraceable as error:
        raise BadInput(f"{name} cannot be exported: it {error}") from error
    # Code that is handed another kind of array fails in ways of its own.
    except Exception as error:
        raise BadInput(
            f"{name} cannot be exported: it ends with {brief(error)} when it is followed from operation "
            "to operation; write it with NumPy's functions of arrays alone"
        ) from error
    results = answer if isinstance(answer, tuple) else (answer,)
    if not all(isinstance(r, Traced) and r.shape[:1] == (BATCH,) for r in results):
        raise BadInput(
            f"{name} cannot be exported: it must compute one row for each row that it is given"
        )
    return Program(inputs, tuple(result.operation for result in results))


# ---- functions that do not ask an array of another kind, in forms that do


def _filled(original: Callable[..., np.ndarray], *args: Any, **kwargs: Any) -> Any:
    """np.zeros((len(x), 3)) and the like: an array that traced values can be assigned to."""
    made = original(*args, **kwargs)
    if BATCH not in made.shape:
        return made
    number = 0 if original is np.empty else made.flat[0].item()
    return apply("full", number, shape=made.shape, dtype=made.dtype.name)


def _converted(original: Callable[..., Any], x: Any, dtype: Any = None, **kwargs: Any) -> Any:
    """np.asarray(x), np.array([x, y]) and the like."""
    if isinstance(x, list | tuple) and any(isinstance(part, Traced) for part in x):
        x = np.stack(x)
    if not isinstance(x, Traced):
        return original(x, dtype, **kwargs)
    return np.copy(x) if dtype is None or x.dtype == dtype else x.astype(dtype)


def _take(x: Any, indices: Any, *args: Any, **kwargs: Any) -> Any:
    """np.take(table, x)."""
    return (take if isinstance(indices, Traced) else np.take)(x, indices, *args, **kwargs)


REPLACEMENTS: dict[str, Callable[..., Any]] = {
    **{f: partial(_filled, getattr(np, f)) for f in ("empty", "zeros", "ones", "full")},
    **{f: partial(_converted, getattr(np, f)) for f in ("array", "asarray", "asanyarray")},
    "ascontiguousarray": partial(_converted, np.ascontiguousarray),
    "take": _take,
}
