"""What a proof takes for granted of a task, each with how it is checked.

The table in `docs/robustness.md` lists it for people.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.judging.proof.networks import bounds_of, method_of, program_of
from hyrl_mj.judging.proof.rules import Truth
from hyrl_mj.physics import memory, mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks import Task
from hyrl_mj.tracing import EVALUATED, Operation, Program

# Methods that a proof reads as the default ones; the others it follows operation by operation.
DEFAULTS = (
    "z", "at", "with_z", "state", "measure", "mocap", "outcome", "plant", "placed", "check_measurement",
    "check_noise", "noise_in_chart",
)  # fmt: skip
# States at which the operations that were followed are compared with the method.
COMPARED = 10_000


def check_assumptions(task: Task) -> None:
    """Raises `Unbounded` unless all that a proof takes for granted of a task holds."""
    methods = {name: getattr(getattr(task, name), "__func__", None) for name in DEFAULTS}
    own = [name for name, method in methods.items() if method is not getattr(Task, name)]
    model = task.model
    qpos = np.arange(1, model.nq + 1)  # the state begins with the time
    measured = mjcf.state_columns(model)
    if own or measured is None or [*measured] != [*qpos] or type(task.chart) is not Chart:
        whose = f" ({', '.join(own)})" if own else ""
        raise Unbounded(
            f"{task.name} computes its chart, measurement or state in methods of its own{whose}, or from "
            "other sensors than the positions of all joints in their order"
        )
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT:
        raise Unbounded(
            f"contacts and other constraints could move {task.name} between the nodes otherwise than on "
            'them: if it needs none, switch them off in its MJCF with <flag constraint="disable"/>'
        )
    if task.has_inner_loop:
        raise Unbounded(
            f"an inner loop (`control`) stands between the inputs of {task.name} and its speeds"
        )
    if why := memory.remembers(model) or memory.why_not_direct(model):
        raise Unbounded(f"the plant of {task.name} may not follow its inputs at once: {why}")
    for name in ("observation", "ending", "verdict"):
        program = program_of(task, name)
        _check_turns(task, name, program)
        _check_program(task, name, program)


def _check_turns(task: Task, name: str, program: Program) -> None:
    """Raises `Unbounded` if a method may tell whole turns of a periodic coordinate apart."""
    chart = task.chart
    for axis in np.flatnonzero(chart.periodic):
        turn = chart.sides * (np.arange(chart.dimension) == axis)
        if tells_turns(program, turn):
            raise Unbounded(
                f"{method_of(task, name)} tells whole turns of {chart.names[axis]} apart, or may do so: "
                "let it use the sine and the cosine, or self.chart.wrap(measured)"
            )


def _check_program(task: Task, name: str, program: Program) -> None:
    """Raises `Unbounded` unless a method gives what the operations give that were followed, row by row.

    It may look at the values, at other rows, at the time or at what it was asked before.
    """
    method: Callable[[np.ndarray], np.ndarray] = getattr(task, name)
    chart, rng = task.chart, np.random.default_rng(1)
    beyond = chart.sides * (0.1 + np.array(chart.periodic))
    z = rng.uniform(chart.low - beyond, chart.high + beyond, (COMPARED, chart.dimension))
    found = bounds_of(program, method_of(task, name), Affine.box(z, np.zeros(chart.dimension)))
    order, fewer = rng.permutation(COMPARED), (1, 2, 7, 33, 150, 600)
    try:
        parts = [method(z), method(z[order])[np.argsort(order)], *(method(z[:k]) for k in fewer)]
    except BadInput as error:
        raise Unbounded(f"{method_of(task, name)} cannot be followed: {error}") from error
    for given in parts:
        k = len(given)
        if isinstance(found, Truth):
            same = (given >= found.surely[:k]) & (given <= found.possibly[:k])
        else:
            slack = 1e-9 * (1 + np.abs(given))
            inside = (given >= found.low[:k] - slack) & (given <= found.high[:k] + slack)
            same = inside | (np.isnan(given) & found.nan[:k])
        if not same.all():
            row = int(np.argwhere(~same)[0][0])
            raise Unbounded(
                f"{method_of(task, name)} gives another result at {chart.format(z[row])} than the operations "
                "that it does with the measurement: it may depend on other rows, or on what was before"
            )


# ---- whole turns of a periodic coordinate: by how much one changes each result is followed from operation to
# operation, a sum by the sum of the changes, a sine not at all if its argument changes by whole turns. So
# nothing has to be tried.


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
    rule = TURNS.get(operation.name)
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


TURNS: dict[str, Callable[[Operation, list[np.ndarray]], np.ndarray | None]] = {
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
