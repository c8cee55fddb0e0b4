"""Whether NumPy code gives the same for all whole turns of a periodic coordinate, as its operations tell.

By how much a turn of the argument changes each result is followed from operation to operation: a sum by the
sum of the changes, a sine not at all if its argument changes by whole turns. So nothing has to be tried.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hyrl_mj.tracing import EVALUATED, Operation, Program


def tells_turns(program: Program, turn: np.ndarray) -> bool:
    """Returns whether a program may give something else after any whole number of turns.

    Args:
        program: one argument (n, p), one result.
        turn: (p,) by how much one turn changes the argument.
    """
    (argument,), (result,) = program.inputs, program.outputs
    changes: dict[Operation, np.ndarray] = {argument: np.broadcast_to(turn, argument.value.shape)}
    for operation in program.operations():
        change = _change(operation, changes)
        if change is None:
            return True
        changes[operation] = np.broadcast_to(change, operation.value.shape)
    return bool(changes[result].any())


def _change(operation: Operation, changes: Mapping[Operation, np.ndarray]) -> np.ndarray | None:
    """Returns by how much a turn changes the result of an operation; None if that depends on the state."""
    by = [
        changes[o] if isinstance(o, Operation) else np.zeros(np.shape(o))
        for o in operation.operands
    ]
    if not any(change.any() for change in by):
        return np.zeros(operation.value.shape)
    rule = RULES.get(operation.name)
    return None if rule is None else rule(operation, by)


def _applied(operation: Operation, by: list[np.ndarray]) -> np.ndarray:
    function = EVALUATED.get(operation.name) or getattr(np, operation.name)
    return np.asarray(function(*by, **operation.options), dtype=float)


def _scaled(operation: Operation, by: list[np.ndarray]) -> np.ndarray | None:
    """Returns the change of a product or a quotient with constants; of others that of neither is known."""
    for k, other in ((0, 1), (1, 0)):
        constant = operation.operands[other]
        if by[other].any() or isinstance(constant, Operation):
            continue
        if operation.name == "divide" and k:
            return None
        values = [by[0], constant] if k == 0 else [constant, by[1]]
        with np.errstate(all="ignore"):
            change = np.asarray(getattr(np, operation.name)(*values), dtype=float)
        return change if np.isfinite(change).all() else None
    return None


def _periodic(operation: Operation, by: list[np.ndarray]) -> np.ndarray | None:
    """Returns no change of a sine, a cosine or a remainder whose argument changes by whole periods."""
    period: Any = 2 * np.pi
    if operation.name == "remainder":
        if by[1].any() or isinstance(operation.operands[1], Operation):
            return None
        period = operation.operands[1]
    return np.zeros(operation.value.shape) if _are_whole(by[0] / period) else None


def _rounded(operation: Operation, by: list[np.ndarray]) -> np.ndarray | None:
    return np.round(by[0]) if _are_whole(by[0]) else None


def _chosen(operation: Operation, by: list[np.ndarray]) -> np.ndarray | None:
    condition = operation.operands[0]
    if isinstance(condition, Operation):
        same = (np.broadcast_to(by[1], operation.value.shape) == by[2]).all()
        return np.asarray(by[1]) if same and not by[0].any() else None
    return np.where(condition, by[1], by[2])


def _taken(operation: Operation, by: list[np.ndarray]) -> np.ndarray | None:
    indices = operation.operands[1]
    if isinstance(indices, Operation):
        return None
    return np.take(by[0], indices, **operation.options)


def _cast(operation: Operation, by: list[np.ndarray]) -> np.ndarray | None:
    return by[0] if operation.value.dtype.kind == "f" else None


def _are_whole(values: np.ndarray) -> bool:
    return bool((np.abs(values - np.round(values)) <= 1e-9).all())


RULES: dict[str, Callable[[Operation, list[np.ndarray]], np.ndarray | None]] = {
    # What changes as its operands do, and what only moves entries.
    **dict.fromkeys(("add", "subtract", "negative", "sum"), _applied),
    **dict.fromkeys(("reshape", "transpose", "concatenate"), _applied),
    **dict.fromkeys(("multiply", "divide", "matmul"), _scaled),
    **dict.fromkeys(("sin", "cos", "remainder"), _periodic),
    **dict.fromkeys(("rint", "floor", "ceil"), _rounded),
    "where": _chosen,
    "take": _taken,
    "astype": _cast,
}
