"""Whether an agent is a function of what it sees: asked again, in other ways, it has to answer the same.

What it sees is a measurement and the memory that it has declared, if any. An agent that remembers anything
else, draws at random, or looks at the other rows of a batch would act otherwise in a batch of runs, where it
is examined, than on a robot. `check_memoryless` tries one when it is accepted;
`Asked` goes on trying it, at little cost, in every closed loop.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import Pipe
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrl_mj.errors import BadInput, brief
from hyrl_mj.policies.controllers import (
    Controller,
    PolicyController,
    answer,
    check_inputs,
    memory_at_start,
)
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

# Returns answers (n, m + k) to what is asked: arrays of n rows, the last two measurements and memories.
Ask = Callable[..., np.ndarray]


def draws(policy: object) -> bool:
    """Returns whether a policy draws its inputs and says so, as its user has asked for."""
    while isinstance(policy, PreprocessedPolicy):
        policy = policy.policy
    return isinstance(policy, SampledPolicy) or getattr(policy, "draws", False)


def check_memoryless(policy: Policy, task: Task, name: str = "the policy") -> None:
    """Tries whether a policy is a function of the measurement, and of its memory, where it would act.

    It acts in a few runs without noise, and watches as many that random inputs drive elsewhere. It is then
    asked about their measurements again: in the same batches, later first, and with only the first row in its
    place; in one batch, and in another order; in a few rows, and one by one, many times, in an array
    that is used again; and once more in the first batches. Where processes can be forked, it is also asked
    in one that is as before all of this, after others near them. This is about `as_function` of it, which
    neither draws its inputs nor sees several observations.

    Raises:
        BadInput: it answers a measurement otherwise than before, or changes an array that is not its own.
    """
    _Trial(as_function(policy), task, getattr(policy, "name", name)).run()


def answers(
    policy: Policy, task: Task, measured: np.ndarray, memory: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Returns what a policy answers to measurements (n, p) and memories (n, ...), and the next memories.

    The answers (n, m) are the policy's own array.

    Raises:
        BadInput: it raises an error, changes the measurements, or gives no finite inputs of that shape.
    """
    kept = measured.copy()
    try:
        u, _, memory = answer(PolicyController(policy), np.zeros(len(kept), int), measured, memory)
        u = np.asarray(u)
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
    return u, memory


# Measurements (n, p) that were asked about together, memories (n, ...) with them, and the first answers
# (n, m + k) to them: inputs, and the numbers of the next memories.
Batch = tuple[np.ndarray, np.ndarray, np.ndarray]


@contextmanager
def _forked(work: Callable[[Any], str]) -> Iterator[Callable[[Any], str]]:
    """Yields what gives work to this process as it is now: in a forked one, whatever comes in between.

    What cannot be forked, or does not work there, as a GPU, answers "".
    """
    if not hasattr(os, "fork"):
        yield lambda _: ""
        return
    ours, theirs = Pipe()
    with warnings.catch_warnings():  # of threads, which stay here
        warnings.simplefilter("ignore")
        child = os.fork()
    if not child:
        try:
            ours.close()
            theirs.send(work(theirs.recv()))
        finally:
            os._exit(0)
    theirs.close()

    def told(given: Any) -> str:
        with suppress(EOFError, OSError):
            ours.send(given)
            return str(ours.recv()) if ours.poll(10.0) else ""  # [s], since it may hang
        return ""

    try:
        yield told
    finally:
        ours.close()
        os.kill(child, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(child, 0)


class _Trial:
    """The trial of one policy."""

    def __init__(self, policy: Policy, task: Task, name: str):
        self.policy, self.task, self.name = policy, task, name
        self.asked: list[Batch] = []
        self._before = (np.zeros(0), np.zeros(0))  # the latest answer, and a copy of it
        self._span = _span(task)

    def run(self) -> None:
        with _forked(self._anew) as told:
            self._act()
            self._ask_again()
            if problem := told(self.asked[::SOME]):
                raise BadInput(problem)

    def _ask_again(self) -> None:
        for batch in reversed(self.asked):
            self._compare(batch, "asked again later", again=True)
        measured, memory, first = map(np.concatenate, zip(*self.asked, strict=True))
        rng, whole = np.random.default_rng(1), np.arange(len(measured))
        ends = np.cumsum([len(rows) for rows, _, _ in self.asked])
        orders = [whole, rng.permutation(whole)]
        orders += np.array_split(rng.permutation(whole), max(len(whole) // 3, 1))[: SAMPLES // SOME]
        for (rows, _, _), end in zip(self.asked[::SOME], ends[::SOME], strict=True):
            others = rng.choice(whole, len(rows) - 1)
            orders.append(np.append(end - len(rows), others))
        for order in orders:
            batch = measured[order], memory[order], first[order]
            self._compare(batch, f"in a batch of {len(order)}")
        one = np.empty((1, measured.shape[1]))
        for i in rng.permutation(len(whole))[:128, None]:
            one[:] = measured[i]
            self._compare((one, memory[i], first[i]), "alone")
        for batch in self.asked[::SOME]:
            self._compare(batch, f"asked again after {len(whole)} others", again=True)

    def _anew(self, batches: Sequence[Batch]) -> str:
        """Returns how answers differ where others near them are asked for first, "" if they do not."""
        rng = np.random.default_rng(2)
        if "torch" in sys.modules:  # its threads are in the process that this one was forked from
            sys.modules["torch"].set_num_threads(1)
        for measured, memory, first in batches:
            off = 10.0 ** rng.uniform(-4, -1.5, (len(measured), 1)) * np.abs(measured).max(axis=0)
            self._ask(measured + off * rng.uniform(-1, 1, measured.shape), memory)
            try:
                self._compare((measured, memory, first), "after others near it")
            except BadInput as error:
                return str(error)
        return ""

    def _act(self) -> None:
        """Acts in runs from the start distribution; what has ended begins anew once all have."""
        task, rng = self.task, np.random.default_rng(0)
        plant, active, m = task.plant(RUNS), np.zeros(0, dtype=int), len(task.inputs)
        for k in range(SAMPLES):
            measured = plant.measurement
            if len(active):
                outcome = task.outcome(measured, plant.unstable)[active]
                active = active[outcome == Outcome.RUNNING]
            if not len(active):
                plant.set_state(*task.state(task.starts(RUNS, rng), rng))
                measured, active = plant.measurement, np.arange(RUNS)
                memory = memory_at_start(PolicyController(self.policy), RUNS)
            asked = measured[active], memory[active]
            answered = self._ask(*asked)
            self.asked.append((*asked, answered))
            memory[active] = answered[:, m:].reshape(asked[1].shape)
            if k % 8 == 0:  # inputs are held for so many samples
                low, high = task.input_limits
                drawn = rng.uniform(low, high, (RUNS, len(low)))
            mine = (active < RUNS // 2)[:, None]
            try:
                plant.step(np.where(mine, answered[:, :m], drawn[active]), active)
            except BadInput:  # inputs beyond the limits are named where a run is really made
                active = active[:0]

    def _ask(self, measured: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """Returns a copy of the answers (n, m + k) to measurements (n, p) and memories (n, ...)."""
        u, after = answers(self.policy, self.task, measured, memory, self.name)
        latest, copy = self._before
        if not np.array_equal(latest, copy):
            raise BadInput(
                f"{self.name} changes an answer that it gave before: let it return a new array each time"
            )
        self._before = u, u.copy()
        return np.column_stack([u.astype(float), after.reshape(len(u), -1)])

    def _compare(self, batch: Batch, words: str, again: bool = False) -> None:
        *asked, first = batch
        compare(self.name, self._ask, asked, first, self._span, words, again)


def _span(task: Task) -> np.ndarray:
    """Returns the range of the inputs (m,); of levels, which do not round, zero."""
    low, high = task.input_limits
    return np.zeros_like(low) if task.input_levels is not None else high - low


def compare(
    name: str,
    ask: Ask,
    asked: Sequence[np.ndarray],
    first: np.ndarray,
    span: np.ndarray,
    words: str,
    again: bool,
) -> None:
    """Asks once more, and compares the answers (n, m + k), inputs and next memories, with the first ones.

    Inputs may differ by roundings of their `span` (m,), the range of the inputs, and memories by those of
    their largest number. Unless it is asked `again`, where not even sums differ, also by as much as the
    answer to a single measurement changes within roundings of it: where it is steep, or where two levels tie.

    Raises:
        BadInput: they differ by more.
    """
    later, (*others, rows, memory), m = ask(*asked), asked, len(span)
    largest = np.nan_to_num(np.abs(first[:, m:])).max(initial=0.0)
    margin = ROUNDING * np.append(span, np.full(first.shape[1] - m, largest))
    off = np.nan_to_num(np.abs(later - first)) - margin
    if not (off > 0).any():
        return
    # A larger difference is a rounding, too, where the answer changes as much over one of the measurement.
    for i in np.argsort(-off.max(axis=1))[:4]:
        if not again:
            # A network rounds sums of all that it sees, also where a column is zero.
            size = np.abs(rows).max(axis=0)
            signs = np.random.default_rng(0).uniform(-1, 1, (32, len(size)))
            shifts = np.vstack([np.zeros_like(size), ROUNDING * size * signs])
            alone, kept = [values[[i]] for values in others], memory[[i]]
            near = np.concatenate([ask(*alone, rows[[i]] + shift, kept) for shift in shifts])
            off[i] -= np.abs(near - near[0]).max(axis=0)
        if (off[i] > 0).any():
            shown, what = slice(m), ""
            if not (off[i, :m] > 0).any():
                shown, what = slice(off[i].argmax(), off[i].argmax() + 1), "a memory of "
            needed = "observation alone, without chance or memory"
            if m < first.shape[1]:
                needed = (
                    "observation and the memory that it is given, without chance or another memory"
                )
            raise BadInput(
                f"{name} answers the measurement {_row(rows[i])} with {what}{_row(first[i, shown])} and, "
                f"{words}, with {what}{_row(later[i, shown])}: give one whose answer depends on its own "
                f"{needed}"
            )


def _row(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.7g}" for value in values) + ")"


class Asked:
    """A controller in a closed loop, which at its end is asked again about some of what it has answered."""

    def __init__(self, task: Task, controller: Controller):
        self._task, self._controller, self._next = task, controller, 0
        self._kept: list[tuple[np.ndarray, ...]] = []
        self._few: list[tuple[np.ndarray, ...]] = []

    def __call__(
        self, k: int, q: np.ndarray, measured: np.ndarray, memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns inputs (n, m), next modes (n,) and memories (n, ...) at sample k of runs, as `answer`."""
        answered = answer(self._controller, q, measured, memory)
        check_inputs(answered[0], len(measured), len(self._task.inputs))
        # Samples 0, 1, 4, 16, ...; with many runs, which takes longer, few of them after the first two.
        if k == self._next:
            rows = (q, measured, memory, _beside(answered))
            if k < 2 or len(measured) <= 256:
                self._kept.append(tuple(values.copy() for values in rows))
            self._few.append(tuple(values[:8].copy() for values in rows))
            self._next = max(4 * k, 1)
        return answered

    def again(self) -> None:
        """Asks about these measurements again, later ones first, about a few of each at once, and one alone.

        Raises:
            BadInput: an answer is another one.
        """
        controller, name = self._controller, "the controller"
        if isinstance(controller, PolicyController):
            if draws(controller.policy):
                return
            name = getattr(controller.policy, "name", "the policy")
        span = np.append(_span(self._task), 0.0)

        def ask(*asked: np.ndarray) -> np.ndarray:
            return _beside(answer(controller, *asked))

        for *asked, first in reversed(self._kept):
            compare(name, ask, asked, first, span, "asked again later", again=True)
        if self._few:
            *asked, first = map(np.concatenate, zip(*self._few, strict=True))
            compare(name, ask, asked, first, span, f"in a batch of {len(first)}", again=False)
            alone = [values[-1:] for values in asked]
            compare(name, ask, alone, first[-1:], span, "alone", again=False)


def _beside(answered: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Returns inputs (n, m), modes (n,) and memories (n, ...) beside each other, (n, m + 1 + k)."""
    u, q, memory = answered
    return np.column_stack([u, q, memory.reshape(len(u), -1)])
