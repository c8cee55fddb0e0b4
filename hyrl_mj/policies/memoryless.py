"""Whether an agent is a function of what it sees: asked again, in other ways, it has to answer the same.

An agent that remembers, draws at random, or looks at the other rows of a batch would act otherwise in a
batch of runs, where it is examined, than on a robot. `check_memoryless` tries one when it is accepted;
`Asked` goes on trying it, at little cost, in every closed loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.policies.controllers import Controller, PolicyController, answer
from hyrl_mj.policies.mlp import Policy, SampledPolicy
from hyrl_mj.policies.preprocessing import PreprocessedPolicy, as_function
from hyrl_mj.tasks import Outcome, Task

# The trial of an agent: runs side by side, samples of them, and measurements that it is asked about one by one.
RUNS, SAMPLES, ALONE = 8, 64, 256
# Runs whose measurements a closed loop asks about again; it does after 1, 4, 16, ... samples and at its end.
KEPT, FACTOR = 8, 4
# Sums of 256 numbers in another order differ by some 16 roundings of float32, and a network has a few of them.
ROUNDING = 32 * float(np.finfo(np.float32).eps)
# A difference larger than that is a rounding, too, where the answer changes as much over a rounding of the
# measurement. So many measurements that far apart are asked about, for so many of the largest differences.
SHIFTS, DOUBTS = 32, 4
REMEDY = "give one whose answer depends on its own observation alone, without chance or memory"

# Returns answers (n, m) to n measurements, of the given rows of some table, moved by (n, p).
Ask = Callable[[np.ndarray, np.ndarray], np.ndarray]


def draws(policy: object) -> bool:
    """Returns whether a policy draws its inputs, as its user has asked for."""
    while isinstance(policy, PreprocessedPolicy):
        policy = policy.policy
    return isinstance(policy, SampledPolicy)


def check_memoryless(policy: Policy, task: Task, name: str = "the policy") -> None:
    """Tries whether a policy is a function of the measurement, where it would act.

    It acts in a few runs without noise, and is then asked about the measurements of these runs again: in the
    same batches, later first; in one batch, and in another order; one by one, hundreds of times, in an array
    that is used again; and once more in the first batches. Of a policy that draws its inputs, or sees several
    observations, this is about `as_function` of it.

    Raises:
        BadInput: it answers a measurement otherwise than before, or changes an array that is not its own.
    """
    _Trial(as_function(policy), task, getattr(policy, "name", name)).run()


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
        for order in (np.arange(len(rows)), rng.permutation(len(rows))):
            words = f"asked in a batch of {len(rows)}"
            self._compare(rows, first, order, self._ask(rows[order]), words)
        several = np.array_split(rng.permutation(len(rows)), max(len(rows) // 3, 1))
        for some in several[: SAMPLES // 4]:
            self._compare(rows, first, some, self._ask(rows[some]), f"asked in a batch of {len(some)}")
        one = np.empty((1, rows.shape[1]))
        for i in rng.permutation(len(rows))[:ALONE]:
            one[:] = rows[i]
            self._compare(rows, first, np.array([i]), self._ask(one), "asked alone")
        for k in range(len(self.batches)):
            self._again(k, f"asked again after {len(rows)} others")

    def _act(self) -> None:
        """Acts in runs from the start distribution; what has ended begins anew once all have."""
        task, rng = self.task, np.random.default_rng(0)
        plant, active = task.plant(RUNS), np.zeros(0, dtype=int)
        for _ in range(SAMPLES):
            measured = plant.measurement
            if len(active):
                outcome = task.outcome(measured, plant.unstable)[active]
                active = active[outcome == Outcome.RUNNING]
            if not len(active):
                plant.set_state(*task.state(task.starts(RUNS, rng), rng))
                measured, active = plant.measurement, np.arange(RUNS)
            self.batches.append(measured[active])
            self.answers.append(self._ask(self.batches[-1]))
            try:
                plant.step(self.answers[-1], active)
            except BadInput:  # inputs beyond the limits are named where a run is really made
                active = active[:0]

    def _ask(self, measured: np.ndarray) -> np.ndarray:
        """Returns a copy of the answers (n, m) to measurements (n, p)."""
        given = measured.copy()
        u = np.asarray(self.policy.act(given))
        shape = (len(measured), len(self.task.inputs))
        if u.shape != shape or u.dtype.kind not in "iuf" or not np.isfinite(u).all():
            raise BadInput(
                f"{self.name} gives {u.dtype} of shape {u.shape} for {shape[0]} measurements, "
                f"{self.task.name} takes finite inputs of shape {shape}"
            )
        if not np.array_equal(given, measured):
            raise BadInput(
                f"{self.name} changes the measurements that it is given: let it work on a copy"
            )
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
    doubtful = np.argsort(-off.max(axis=1))[:DOUBTS] if (off > 0).any() else []
    for i in doubtful:
        if ask is not None and (off[i] > 0).any():
            size = np.maximum(np.abs(rows[i]), np.abs(rows).max(axis=0) * ROUNDING)
            signs = np.random.default_rng(0).uniform(-1, 1, (SHIFTS, len(size)))
            shifts = np.vstack([np.zeros_like(size), ROUNDING * size * signs])
            near = ask(np.full(len(shifts), i), shifts)
            off[i] -= np.abs(near - near[0]).max(axis=0)
        if (off[i] > 0).any():
            raise BadInput(
                f"{name} answers the measurement {_row(rows[i])} with {_row(first[i])} and, {words}, with "
                f"{_row(again[i])}: {REMEDY}"
            )


def _row(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.7g}" for value in values) + ")"


@dataclass
class Asked:
    """A controller in a closed loop, which is asked again about what it has answered.

    Attributes:
        task: the task.
        controller: the controller.
    """

    task: Task
    controller: Controller
    _kept: list[tuple[np.ndarray, ...]] = field(default_factory=list)
    _next: int = 1

    def __call__(
        self, k: int, q: np.ndarray, measured: np.ndarray, past: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns inputs (n, m) and next modes (n,) at sample k of runs, as `answer`.

        Raises:
            BadInput: it answers otherwise than before.
        """
        u, after = answer(self.controller, q, measured, past)
        if k in (0, self._next):
            asked = (q, measured, past, np.column_stack([u, after]))
            self._kept.append(tuple(values[:KEPT].copy() for values in asked))
        if k == self._next:
            self.again()
            self._next *= FACTOR
        return u, after

    def again(self) -> None:
        """Asks about the first measurements again; raises `BadInput` if an answer is another one."""
        controller = self.controller
        if isinstance(controller, PolicyController) and draws(controller.policy):
            return
        if not self._kept:
            return
        q, measured, past, first = map(np.concatenate, zip(*self._kept, strict=True))

        def ask(rows: np.ndarray, shift: np.ndarray) -> np.ndarray:
            moved = measured[rows] + shift
            return np.concatenate(
                [
                    np.column_stack(answer(controller, q[i : i + 1], row, past[i : i + 1]))
                    for i, row in zip(rows, moved[:, None], strict=True)
                ]
            )

        again = np.column_stack(answer(controller, q, measured, past))
        low, high = self.task.input_limits
        span = np.zeros_like(low) if self.task.input_levels is not None else high - low
        name = "the controller"
        if isinstance(controller, PolicyController):
            name = getattr(controller.policy, "name", "the policy")
        words = "asked again later in the run"
        compare(name, measured, first, again, ROUNDING * np.append(span, 0.0), words, ask)
