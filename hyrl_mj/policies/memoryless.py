"""Whether an agent is a function of what it sees: asked again, in other ways, it has to answer the same.

An agent that remembers, draws at random, or looks at the other rows of a batch would act otherwise in a
batch of runs, where it is examined, than on a robot. `check_memoryless` tries one when it is accepted;
`Asked` goes on trying it, at little cost, in every closed loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.errors import BadInput, brief
from hyrl_mj.policies.controllers import Controller, PolicyController, answer, check_inputs
from hyrl_mj.policies.mlp import Policy, SampledPolicy
from hyrl_mj.policies.preprocessing import PreprocessedPolicy, as_function
from hyrl_mj.tasks import Outcome

if TYPE_CHECKING:
    from hyrl_mj.tasks import Task

# The trial of an agent: runs side by side, half of them by random inputs; and their samples. Of what takes a
# call a batch, every fourth one does.
RUNS, SAMPLES, SOME = 16, 64, 4
# Sums of 256 numbers in another order differ by some 16 roundings of float32; a network has a few of them.
ROUNDING = 32 * float(np.finfo(np.float32).eps)

# Returns answers (n, m) to n measurements, of the given rows of some table, moved by (n, p).
Ask = Callable[[np.ndarray, np.ndarray], np.ndarray]


def draws(policy: object) -> bool:
    """Returns whether a policy draws its inputs and says so, as its user has asked for."""
    while isinstance(policy, PreprocessedPolicy):
        policy = policy.policy
    return isinstance(policy, SampledPolicy) or getattr(policy, "draws", False)


def check_memoryless(policy: Policy, task: Task, name: str = "the policy") -> None:
    """Tries whether a policy is a function of the measurement, where it would act.

    It acts in a few runs without noise, and watches as many that random inputs drive elsewhere. It is then
    asked about their measurements again: in the same batches, later first, and with only the first row in its
    place; in one batch, and in another order; in a few rows, and one by one, many times, in an array
    that is used again; and once more in the first batches. Of a policy that draws its inputs, or sees several
    observations, this is about `as_function` of it.

    Raises:
        BadInput: it answers a measurement otherwise than before, or changes an array that is not its own.
    """
    _Trial(as_function(policy), task, getattr(policy, "name", name)).run()


def answers(policy: Policy, task: Task, measured: np.ndarray, name: str) -> np.ndarray:
    """Returns what a policy answers to measurements (n, p), an array (n, m), which is the policy's own.

    Raises:
        BadInput: it raises an error, changes the measurements, or gives no finite inputs of that shape.
    """
    kept = measured.copy()
    try:
        u = np.asarray(policy.act(measured))
    except BadInput:
        raise
    except Exception as error:  # a user's code can raise anything
        raise BadInput(f"{name} cannot be used: it raised {brief(error)}") from error
    if not np.array_equal(kept, measured):
        raise BadInput(f"{name} changes the measurements that it is given: let it work on a copy")
    shape = (len(measured), len(task.inputs))
    if u.shape != shape or u.dtype.kind not in "iuf":
        raise BadInput(
            f"{name} gives {u.dtype} of shape {u.shape} for {shape[0]} measurements, {task.name} takes "
            f"inputs of shape {shape}"
        )
    if not np.isfinite(u).all():
        raise BadInput(f"{name} gives inputs that are not finite: {task.name} takes numbers")
    return u


class _Trial:
    """The trial of one policy.

    Attributes:
        batches: the measurements (n, p) that were asked about together.
        answers: the first answers (n, m) to them.
    """

    def __init__(self, policy: Policy, task: Task, name: str):
        self.policy, self.task, self.name = policy, task, name
        self.batches: list[np.ndarray] = []
        self.answers: list[np.ndarray] = []
        self._before = (np.zeros(0), np.zeros(0))  # the latest answer, and a copy of it
        low, high = task.input_limits
        self._span = np.zeros_like(low) if task.input_levels is not None else high - low

    def run(self) -> None:
        self._act()
        for k in reversed(range(len(self.batches))):
            self._again(k, "asked again later")
        rows, rng = np.concatenate(self.batches), np.random.default_rng(1)
        first = np.concatenate(self.answers)
        whole = np.arange(len(rows))
        ends = np.cumsum([len(batch) for batch in self.batches])
        orders = [whole, rng.permutation(whole)]
        orders += np.array_split(rng.permutation(whole), max(len(rows) // 3, 1))[: SAMPLES // SOME]
        for batch, end in zip(self.batches[::SOME], ends[::SOME], strict=True):
            others = rng.choice(whole, len(batch) - 1)
            orders.append(np.append(end - len(batch), others))
        for order in orders:
            self._compare(rows, first, order, self._ask(rows[order]), f"in a batch of {len(order)}")
        one = np.empty((1, rows.shape[1]))
        for i in rng.permutation(len(rows))[:128]:
            one[:] = rows[i]
            self._compare(rows, first, np.array([i]), self._ask(one), "alone")
        for k in range(0, len(self.batches), SOME):
            self._again(k, f"asked again after {len(rows)} others")

    def _act(self) -> None:
        """Acts in runs from the start distribution; what has ended begins anew once all have."""
        task, rng = self.task, np.random.default_rng(0)
        plant, active = task.plant(RUNS), np.zeros(0, dtype=int)
        for k in range(SAMPLES):
            measured = plant.measurement
            if len(active):
                outcome = task.outcome(measured, plant.unstable)[active]
                active = active[outcome == Outcome.RUNNING]
            if not len(active):
                plant.set_state(*task.state(task.starts(RUNS, rng), rng))
                measured, active = plant.measurement, np.arange(RUNS)
            self.batches.append(measured[active])
            self.answers.append(self._ask(self.batches[-1]))
            if k % 8 == 0:  # inputs are held for so many samples
                low, high = task.input_limits
                drawn = rng.uniform(low, high, (RUNS, len(low)))
            mine = (active < RUNS // 2)[:, None]
            try:
                plant.step(np.where(mine, self.answers[-1], drawn[active]), active)
            except BadInput:  # inputs beyond the limits are named where a run is really made
                active = active[:0]

    def _ask(self, measured: np.ndarray) -> np.ndarray:
        """Returns a copy of the answers (n, m) to measurements (n, p)."""
        u = answers(self.policy, self.task, measured, self.name)
        latest, copy = self._before
        if not np.array_equal(latest, copy):
            raise BadInput(
                f"{self.name} changes an answer that it gave before: let it return a new array each time"
            )
        self._before = u, u.copy()
        return u.astype(float)

    def _again(self, k: int, words: str) -> None:
        """Asks about a batch as it was asked about first, where not even sums differ."""
        rows, first = self.batches[k], self.answers[k]
        compare(self.name, rows, first, self._ask(rows), ROUNDING * self._span, words)

    def _compare(
        self, rows: np.ndarray, first: np.ndarray, chosen: np.ndarray, u: np.ndarray, words: str
    ) -> None:
        """Compares answers to `chosen` rows (k,) with those of before."""

        def ask(some: np.ndarray, shift: np.ndarray) -> np.ndarray:
            moved = rows[chosen[some]] + shift
            return np.concatenate([self._ask(row) for row in moved[:, None]])

        margin = ROUNDING * self._span
        compare(self.name, rows[chosen], first[chosen], u, margin, words, ask)


def compare(
    name: str,
    rows: np.ndarray,
    first: np.ndarray,
    again: np.ndarray,
    margin: np.ndarray,
    words: str,
    ask: Ask | None = None,
) -> None:
    """Compares two answers (n, m) to the same measurements `rows` (n, p).

    They may differ by a margin (m,). With `ask`, which asks about one measurement at a time, also by as much
    as the answer changes within roundings of the measurement: where it is steep, or where two levels tie.

    Raises:
        BadInput: they differ by more.
    """
    off = np.abs(again - first) - margin
    if not (off > 0).any():
        return
    # A larger difference is a rounding, too, where the answer changes as much over one of the measurement.
    for i in np.argsort(-off.max(axis=1))[:4]:
        if ask is not None:
            # A network rounds sums of all that it sees, also where a column is zero.
            size = np.abs(rows).max(axis=0)
            signs = np.random.default_rng(0).uniform(-1, 1, (32, len(size)))
            shifts = np.vstack([np.zeros_like(size), ROUNDING * size * signs])
            near = ask(np.full(len(shifts), i), shifts)
            off[i] -= np.abs(near - near[0]).max(axis=0)
        if (off[i] > 0).any():
            raise BadInput(
                f"{name} answers the measurement {_row(rows[i])} with {_row(first[i])} and, {words}, with "
                f"{_row(again[i])}: give one whose answer depends on its own observation alone, without "
                "chance or memory"
            )


def _row(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.7g}" for value in values) + ")"


@dataclass
class Asked:
    """A controller in a closed loop, which at its end is asked again about some of what it has answered.

    Attributes:
        task: the task.
        controller: the controller.
    """

    task: Task
    controller: Controller
    _kept: list[tuple[np.ndarray, ...]] = field(default_factory=list)
    _next: int = 0

    def __call__(
        self, k: int, q: np.ndarray, measured: np.ndarray, past: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,) at sample k of runs, as `answer`."""
        u, after = answer(self.controller, q, measured, past)
        check_inputs(u, len(measured), len(self.task.inputs))
        # Samples 0, 1, 4, 16, ...; with many runs, which takes longer, the first two.
        if k == self._next and (k < 2 or len(measured) <= 256):
            rows = (q, measured, past, np.column_stack([u, after]))
            self._kept.append(tuple(values.copy() for values in rows))
            self._next = max(4 * k, 1)
        return u, after

    def again(self) -> None:
        """Asks about these measurements again, later ones first, and about a few of each at once.

        Raises:
            BadInput: an answer is another one.
        """
        controller = self.controller
        if isinstance(controller, PolicyController) and draws(controller.policy):
            return
        low, high = self.task.input_limits
        span = np.zeros_like(low) if self.task.input_levels is not None else high - low
        margin, name, words = ROUNDING * np.append(span, 0.0), "the controller", "asked again later"
        if isinstance(controller, PolicyController):
            name = getattr(controller.policy, "name", "the policy")
        for q, measured, past, first in reversed(self._kept):
            again = np.column_stack(answer(controller, q, measured, past))
            compare(name, measured, first, again, margin, words)
        if not self._kept:
            return
        few = ([values[:8] for values in batch] for batch in self._kept)
        q, measured, past, first = map(np.concatenate, zip(*few, strict=True))

        def ask(rows: np.ndarray, shift: np.ndarray) -> np.ndarray:
            moved = measured[rows] + shift
            return np.concatenate(
                [
                    np.column_stack(answer(controller, q[i : i + 1], row, past[i : i + 1]))
                    for i, row in zip(rows, moved[:, None], strict=True)
                ]
            )

        again = np.column_stack(answer(controller, q, measured, past))
        compare(name, measured, first, again, margin, f"in a batch of {len(q)}", ask)
