"""Runs NumPy code on traced arrays, which record the operations from its arguments to its results."""

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
    """Returns the operations that a function does with its arguments.

    Args:
        function: takes arrays with one row for each row of the batch; returns one such array or a tuple.
        samples: for each argument `BATCH` rows of possible values.
        name: what messages call the function.

    Raises:
        BadInput: the function cannot be traced.
    """
    inputs = tuple(Operation("input", (key,), {}, value) for key, value in samples.items())
    try:
        with np.errstate(all="ignore"):
            results = PrivateCopies(REPLACEMENTS).of(function)(*map(Traced, inputs))
    except Untraceable as error:
        raise BadInput(f"{name} cannot be exported: it {error}") from error
    except Exception as error:  # code that gets another kind of array fails in many ways
        raise BadInput(
            f"{name} cannot be exported: it raises {brief(error)} when its operations are traced; write "
            "it with NumPy's functions of arrays alone"
        ) from error
    results = results if isinstance(results, tuple) else (results,)
    if not all(isinstance(r, Traced) and r.shape[:1] == (BATCH,) for r in results):
        raise BadInput(f"{name} cannot be exported: it must return one row for each row it gets")
    return Program(inputs, tuple(result.operation for result in results))


# ---- replacements of functions that ignore NumPy's protocols for foreign arrays


def _filled(original: Callable[..., np.ndarray], *args: Any, **kwargs: Any) -> Any:
    """np.zeros((len(x), 3)) and the like: an array that traced values can be assigned to."""
    array = original(*args, **kwargs)
    if BATCH not in array.shape:
        return array
    number = 0 if original is np.empty else array.flat[0].item()
    return apply("full", number, shape=array.shape, dtype=array.dtype.name)


def _converted(original: Callable[..., Any], x: Any, dtype: Any = None, **kwargs: Any) -> Any:
    """np.asarray(x), np.array([x, y]) and the like."""
    if isinstance(x, list | tuple) and any(isinstance(part, Traced) for part in x):
        x = np.stack(x)
    if not isinstance(x, Traced):
        return original(x, dtype, **kwargs)
    return x.astype(x.dtype if dtype is None else dtype)


def _take(x: Any, indices: Any, *args: Any, **kwargs: Any) -> Any:
    """np.take(table, x)."""
    return (take if isinstance(indices, Traced) else np.take)(x, indices, *args, **kwargs)


REPLACEMENTS: dict[str, Callable[..., Any]] = {
    **{f: partial(_filled, getattr(np, f)) for f in ("empty", "zeros", "ones", "full")},
    **{
        f: partial(_converted, getattr(np, f))
        for f in ("array", "asarray", "asanyarray", "ascontiguousarray")
    },
    "take": _take,
}
