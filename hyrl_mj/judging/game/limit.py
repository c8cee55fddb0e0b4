"""The limits beside every score of the worst-case game: what is open, and what a split can win.

Open is what one who sees the state can win. The limit of a split is a controller that steers by the true
state, but has to choose the way by the measurement: it picks the side of the first measurement, and from
there follows each way as well as possible.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import count

import numpy as np

from hyrl_mj.judging.game.lattice import Lattice
from hyrl_mj.judging.game.solver import NEVER, Moves, by_target, count_down, entries, nodes_within
from hyrl_mj.sets import GridSet, within_reach


@dataclass(frozen=True)
class Limit:
    """The best that a controller that knows the state can do on each mode's way.

    Attributes:
        lattice: of the states.
        parts: (Q, N) bool, M_i at the nodes.
        sides: (Q, N) bool, the modes that a measurement there selects; several on the boundary.
        samples: (Q, N) fewest samples until arrival by each mode's way, `NEVER` where it is closed.
        level: (Q, N) input level that takes the fewest samples.
        hop: (d,) longest distance of one sample, along each coordinate.
    """

    lattice: Lattice
    parts: np.ndarray
    sides: np.ndarray
    samples: np.ndarray
    level: np.ndarray
    hop: np.ndarray

    @staticmethod
    def solve(lattice: Lattice, parts: Iterable[GridSet]) -> Limit:
        """Returns the limit on a lattice for the parts M_i, by backward recursion over the best input.

        A run goes mode i's way if it enters M_i and then stays there until it arrives; before that it may
        pass through other parts, but not where several overlap.
        """
        sets, nodes = tuple(parts), lattice.grid.nodes
        at = sets[0].grid.nearest(nodes)
        inside = np.stack([part.mask[at] for part in sets])
        depth = np.stack([part.signed_distance(nodes) for part in sets])
        samples, level = np.empty(inside.shape, dtype=int), np.empty(inside.shape, dtype=int)
        after = lattice.after[:, :1]  # the nearest node, which errs to the limit's side
        for i, part in enumerate(inside):
            # The place "arrived" is in every part, "failed" in none.
            shared = np.append(part & np.delete(inside, i, axis=0).any(axis=0), [True, False])
            allowed = np.where(part, np.append(part, [True, False])[after], ~shared[after])
            samples[i], level[i] = fewest_samples(lattice, after, allowed)
        ends = after[:, 0]
        moved = lattice.grid.chart.difference(nodes[np.minimum(ends, lattice.nodes - 1)], nodes)
        hop = np.abs(moved[ends < lattice.nodes]).max(axis=0)
        # Parts of the same depth meet there.
        sides = depth <= depth.min(axis=0) + 1e-9  # [chart units]
        return Limit(lattice, inside, sides, samples, level, hop)

    @cached_property
    def open(self) -> np.ndarray:
        """(N,) bool, the nodes from which one who sees the state arrives in time, whichever way."""
        lattice = self.lattice
        after = lattice.after[:, :1]
        samples, _ = fewest_samples(lattice, after, np.ones(after.shape, dtype=bool))
        return samples <= lattice.task.max_steps

    def held(self, bound: np.ndarray) -> np.ndarray:
        """Returns the most samples until arrival if the side of the first measurement is held: (N,) int.

        It is `NEVER` where noise within bounds (d,) can show a side whose way is closed.
        """
        shown = np.stack([self._reach(side, bound) for side in self.sides])
        return np.asarray(np.where(shown, self.samples, 0).max(axis=0))

    def winnable(self, bound: np.ndarray) -> np.ndarray:
        """Returns the nodes (N,) bool where holding the side of the first measurement wins in time."""
        return self.held(bound) <= self.lattice.task.max_steps

    def moves(self, bound: np.ndarray) -> Moves:
        """Returns the adversary's moves against the limit under noise within bounds (d,).

        The limit's flow sets are those of stage 5, with the ways that are open on the lattice as W_i.
        """
        lattice, modes = self.lattice, len(self.parts)
        noisy = np.where(bound > 0, self.hop, 0.0)
        goes, side = [], self.sides.argmax(axis=0)
        for i, part in enumerate(self.parts):
            roomy = ~self._reach(self.samples[i] >= NEVER, bound)
            flows = self._reach(part, 2 * bound + noisy) & roomy | self._reach(part, bound)
            goes.append(np.where(flows, i, side))
        rows = []
        for goal in (*goes, side):
            possible = np.stack([self._reach(goal == i, bound) for i in range(modes)], axis=-1)
            node, mode = np.nonzero(possible & lattice.running[:, None])
            rows.append((node, mode, lattice.after[self.level[mode, node], :1, node]))
        return Moves.gather(lattice, rows)

    def _reach(self, mask: np.ndarray, bound: np.ndarray) -> np.ndarray:
        """Returns the nodes (N,) bool from which noise within bounds (d,) can show a node of the mask."""
        grid = self.lattice.grid
        window = nodes_within(self.lattice, bound)
        return within_reach(mask.reshape(grid.counts), window, grid.chart.periodic).ravel()


def fewest_samples(
    lattice: Lattice, after: np.ndarray, allowed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the fewest samples until arrival without noise, over allowed transitions.

    Args:
        lattice: the lattice of the nodes.
        after: (A, C, N) places to which each level leads; the worst of the C places counts.
        allowed: (A, C, N) bool, allowed transitions.

    Returns:
        (N,) int samples, `NEVER` where there is no way, and (N,) int, the level to take.
    """
    levels, corners, n = after.shape
    samples = np.full(lattice.places, NEVER)
    samples[:-2][lattice.arrived] = 0
    samples[-2] = 0
    level = np.zeros(lattice.nodes, dtype=int)
    open_ = lattice.running & ~lattice.arrived
    usable = allowed.all(axis=1) & open_
    # A transition is number level * n + node; it leads on once all of its corners are reached.
    transition = np.broadcast_to(np.arange(levels * n).reshape(levels, 1, n), after.shape)
    used = np.broadcast_to(usable[:, None], after.shape)
    before, first = by_target(after[used], transition[used], lattice.places)
    waiting = np.full(levels * n, corners, dtype=np.int8)
    new = np.flatnonzero(samples == 0)
    for k in count(1):
        reaching = entries(before, first, new)
        count_down(waiting, reaching)
        by_level, node = np.divmod(reaching[waiting[reaching] == 0], n)
        fresh = samples[node] == NEVER
        by_level, node = by_level[fresh], node[fresh]
        if not len(node):
            break
        level[node] = levels
        np.minimum.at(level, node, by_level)
        samples[node] = k
        new = np.unique(node)
    return samples[:-2], level
