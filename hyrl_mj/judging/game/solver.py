"""The solver of the worst-case noise game.

At every sample an adversary who knows everything picks the noise n, |n| <= eps, the controller answers the
measurement z + n in its mode q, and the plant moves. Backward recursion on a lattice gives a value for each
state (z, q): the samples until the episode fails, or until it arrives at the latest, or `NEVER`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import count

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game.lattice import Lattice, Places
from hyrl_mj.policies import Controller, is_memory, memory_at_start
from hyrl_mj.sets import within_reach

# The greater a value, the worse for the controller: k < NEVER means "arrives after k samples at the latest",
# LOST - k means "fails after k samples".
NEVER = 1 << 20
LOST = 1 << 21
FIRST = 1 << 22  # greater than all values
# Measurements that are answered or compared at once, which limits the memory.
AT_ONCE = 1 << 17


@dataclass(frozen=True)
class Answers:
    """A controller's answers at every node that can be measured, in every mode.

    The last row is for a run that has not started yet: there the controller picks its own mode.

    Attributes:
        lattice: lattice of the true states.
        modes: the controller's modes.
        pad: (d,) nodes by which the measured nodes reach beyond the lattice on either side.
        index: (Q + 1, measured nodes...) int, the answer as level * Q + number of the next mode.
        settled: (Q + 1, measured nodes...) bool, whether the answer is the same right beside the node.
            Where it is not, rounding decides the answer to a measurement there.
    """

    lattice: Lattice
    modes: tuple[int, ...]
    pad: np.ndarray
    index: np.ndarray
    settled: np.ndarray

    @staticmethod
    def ask(lattice: Lattice, controller: Controller, bound: np.ndarray) -> Answers:
        """Returns the answers of a controller to measurements with noise of at most `bound` (d,).

        Raises:
            BadInput: the controller has a memory, or gives an invalid input or an unknown mode.
        """
        if is_memory(memory_at_start(controller, 1)):
            raise BadInput(
                "the worst-case game takes a function of the measurement, and this policy has a memory: "
                "use noisy episodes or an attack"
            )
        grid, modes = lattice.grid, controller.modes
        pad = np.where(grid.chart.periodic, 0, nodes_within(lattice, bound))
        index = np.stack([*np.indices(tuple(grid.counts + 2 * pad))], axis=-1) - pad
        measured = grid.chart.origin + grid.spacing * index

        def answer(q: int | None, points: np.ndarray) -> np.ndarray:
            """Returns the answers (n,) at chart points (n, d) in a mode, or before the start if q is None."""
            points = lattice.task.at(points)
            mode = controller.initial_mode(points) if q is None else np.full(len(points), q)
            u, after = controller.step(mode, points)
            unknown = ~np.isin(after, modes)
            if unknown.any():
                raise BadInput(f"the controller went to mode {after[unknown][0]}, it has {modes}")
            return lattice.level_of(u) * len(modes) + np.searchsorted(modes, after)

        def answers_of(q: int | None, points: np.ndarray) -> np.ndarray:
            """As `answer`, for any number of points."""
            parts = [points[i : i + AT_ONCE] for i in range(0, len(points), AT_ONCE)]
            return np.concatenate([answer(q, part) for part in parts])

        answers, all_settled = [], []
        # An answer is settled if it is the same this far beside its measurement.
        beside = 1e-4 * grid.spacing * np.eye(len(pad))[bound > 0]
        for q in (*modes, None):
            index = answers_of(q, measured.reshape(-1, len(pad))).reshape(measured.shape[:-1])
            settled = np.ones(index.shape, dtype=bool)
            at = np.nonzero(_borders(index, grid.chart.periodic))
            if len(at[0]) and len(beside):
                others = [answer(q, measured[at] + side) for side in (*beside, *-beside)]
                settled[at] = (np.array(others) == index[at]).all(axis=0)
            answers.append(index)
            all_settled.append(settled)
        return Answers(lattice, modes, pad, np.stack(answers), np.stack(all_settled))

    @property
    def middle(self) -> tuple[slice, ...]:
        """The slices of the lattice in the arrays of measured nodes."""
        counts = self.lattice.grid.counts
        return tuple(slice(k, k + n) for k, n in zip(self.pad, counts, strict=True))


def _borders(index: np.ndarray, periodic: tuple[bool, ...]) -> np.ndarray:
    """Returns the nodes (n, ...) bool that have a neighbour with another answer."""
    borders = np.zeros(index.shape, dtype=bool)
    for axis, wraps in enumerate(periodic):
        differs = np.diff(index, axis=axis, append=index.take([0], axis=axis)) != 0
        if not wraps:
            differs[(slice(None),) * axis + (-1,)] = False
        borders |= differs | np.roll(differs, 1, axis=axis)
    return borders


def nodes_within(lattice: Lattice, bound: np.ndarray) -> np.ndarray:
    """Returns the number of nodes within noise bounds (d,) on either side: (d,) int.

    Where the game is an estimate this is the nearest number, and at least 1 for a coordinate with noise.
    """
    cells = bound / lattice.grid.spacing
    if lattice.estimate:
        return np.where(bound > 0, np.maximum(np.round(cells), 1), 0).astype(int)
    return np.floor(cells + 1e-6).astype(int)


@dataclass(frozen=True)
class Moves:
    """The adversary's moves: the states that each state can reach in one sample.

    States are numbered row * places + place.

    Attributes:
        lattice: the places.
        rows: number of modes, plus one for runs that have not started yet.
        state: (S,) states that have moves.
        counts: (S,) number of moves of each state.
        target: (E,) states that the moves lead to.
    """

    lattice: Places
    rows: int
    state: np.ndarray
    counts: np.ndarray
    target: np.ndarray

    @cached_property
    def backward(self) -> tuple[np.ndarray, np.ndarray]:
        """States (E,) that have a move, by its target, and where those of each target begin (states + 1,)."""
        states = np.repeat(self.state, self.counts)
        return by_target(self.target, states, self.rows * self.lattice.places)

    @staticmethod
    def gather(lattice: Places, rows: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Moves:
        """Returns the moves, from each row's nodes (m,) ascending, next modes (m,) and places (m, C)."""
        state, counts, target = [], [], []
        for row, (node, mode, ends) in enumerate(rows):
            target.append((ends + (mode * lattice.places)[:, None]).ravel())
            moves = np.bincount(node, minlength=lattice.nodes) * ends.shape[1]
            state.append(np.flatnonzero(moves) + row * lattice.places)
            counts.append(moves[moves > 0])
        return Moves(lattice, len(state), *map(np.concatenate, (state, counts, target)))


def noisy_moves(answers: Answers, bound: np.ndarray, settled_only: bool = False) -> Moves:
    """Returns the moves that noise within bounds (d,) gives the adversary against a controller.

    `settled_only` leaves out moves that need a measurement on the very border of two answers; the move
    without noise always stays.
    """
    lattice, modes = answers.lattice, len(answers.modes)
    window, periodic = nodes_within(lattice, bound), lattice.grid.chart.periodic
    rows = []
    for index, settled in zip(answers.index, answers.settled, strict=True):
        counts = settled | (not settled_only)
        used = np.unique(index)
        masks = [within_reach((index == x) & counts, window, periodic) | (index == x) for x in used]
        possible = np.stack([mask[answers.middle] for mask in masks], axis=-1)
        node, which = np.nonzero(possible.reshape(lattice.nodes, -1) & lattice.running[:, None])
        level, mode = np.divmod(used[which], modes)
        rows.append((node, mode, lattice.after[level, :, node]))
    return Moves.gather(lattice, rows)


def solve(
    moves: Moves, samples: int | None = None, arrived: np.ndarray | None = None
) -> np.ndarray:
    """Returns the value of every state by backward recursion: (rows, places) int.

    An episode is over where it arrives. A state from which it may neither fail nor arrive is worth `NEVER`.

    Args:
        moves: the adversary's moves.
        samples: duration of an episode; what happens later does not count. By default, episodes have no
            time limit.
        arrived: (rows, N) bool, further states that count as arrived.
    """
    lattice = moves.lattice
    value = np.full((moves.rows, lattice.places), NEVER, dtype=np.int32)
    value[:, :-2][:, lattice.failed] = LOST
    value[:, :-2][:, lattice.arrived] = 0
    value[:, -2], value[:, -1] = 0, LOST
    if arrived is not None:
        value[:, :-2][arrived] = 0
    flat = value.ravel()
    before, first = moves.backward
    waiting = np.zeros(flat.size, dtype=np.int32)  # moves that have not arrived yet
    waiting[moves.state] = moves.counts
    new, stamp = np.flatnonzero(flat != NEVER), np.empty(flat.size, dtype=np.int32)
    # The k-th pass finds the states that fail or arrive in k samples.
    for k in count(1) if samples is None else range(1, samples + 1):
        lost = flat[new] > NEVER
        failing, arriving = (entries(before, first, part) for part in (new[lost], new[~lost]))
        # Each state gets its value once: at the earliest failure, or when all its moves have arrived.
        failing = failing[flat[failing] == NEVER]
        flat[failing] = LOST - k
        count_down(waiting, arriving)
        arriving = arriving[(waiting[arriving] == 0) & (flat[arriving] == NEVER)]
        flat[arriving] = k
        new = once(np.concatenate([failing, arriving]), stamp)
        if not len(new):
            break
    return value


def count_down(waiting: np.ndarray, at: np.ndarray) -> None:
    """Subtracts 1 from `waiting` for each entry of `at`, also where entries repeat."""
    np.subtract.at(
        waiting, at, waiting.dtype.type(1)
    )  # a number of another type takes forty times as long


def once(values: np.ndarray, stamp: np.ndarray) -> np.ndarray:
    """Returns each of the values (n,) once, without sorting; `stamp` is scratch space, one for each value."""
    order = np.arange(len(values), dtype=stamp.dtype)
    stamp[values] = order
    return np.asarray(values[stamp[values] == order])


def by_target(
    target: np.ndarray, source: np.ndarray, targets: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sources (E,) of transitions by their targets (E,), and where those of each begin."""
    from scipy.sparse import csr_array  # slow to import

    n = len(target)
    ones, one_each = np.ones(n, dtype=np.int8), np.arange(n + 1)
    sorted_ = csr_array((ones, target, one_each), shape=(n, targets)).tocsc()
    return source[sorted_.indices], sorted_.indptr


def entries(values: np.ndarray, first: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Returns the values of some rows, one after the other; row i holds values[first[i] : first[i + 1]]."""
    counts = first[rows + 1] - first[rows]
    skipped = np.cumsum(counts) - counts
    at = np.arange(counts.sum()) + np.repeat(first[rows] - skipped, counts)
    return np.asarray(values[at])


def lasting(moves: Moves, start: np.ndarray | None = None) -> np.ndarray:
    """Returns the nodes (N,) bool where a run can still be after any number of samples, in some mode.

    Runs start in any mode at the nodes `start` (N,) bool, by default at all nodes.
    """
    lattice = moves.lattice
    runs = np.zeros((moves.rows, lattice.places), dtype=bool)
    runs.reshape(-1)[moves.state] = True
    runs[-1] = False  # after one sample every run has started
    alive = runs.copy()
    if start is not None:
        alive[:, :-2] &= start
    # First add all nodes that can be reached, then remove those that runs leave.
    grows = start is not None
    while True:
        reached = np.zeros(runs.size, dtype=bool)
        reached[moves.target[np.repeat(alive.reshape(-1)[moves.state], moves.counts)]] = True
        after = reached.reshape(runs.shape) & runs
        if grows:
            after |= alive
        if (after == alive).all():
            if not grows:
                return np.asarray(alive[:, :-2].any(axis=0))
            grows = False
        alive = after
