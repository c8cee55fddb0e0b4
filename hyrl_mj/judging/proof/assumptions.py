"""What a proof takes for granted of a task, each with how it is checked.

The table in `docs/robustness.md` lists it for people.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.judging.proof.networks import bounds_of, method_of, program_of
from hyrl_mj.judging.proof.rules import Truth
from hyrl_mj.judging.proof.turns import tells_turns
from hyrl_mj.physics import memory, mjcf
from hyrl_mj.sets import Chart
from hyrl_mj.tasks import Task
from hyrl_mj.tracing import Program

# Methods that a proof reads as the default ones; the others it follows operation by operation.
DEFAULTS = (
    "z", "at", "with_z", "state", "measure", "mocap", "outcome", "plant", "placed", "check_measurement",
    "check_noise", "noise_in_chart",
)  # fmt: skip
# States at which the operations that were followed are compared with the method.
COMPARED = 1_000


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
