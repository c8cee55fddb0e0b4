"""The search for the critical set by outcome: bisection between starts whose runs go different ways."""

from __future__ import annotations

import numpy as np

from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.simulation import Sample, Signal, WayRuns, closed_loop, policy_runs, way_runs
from hyrl_mj.stages.ways import Ways
from hyrl_mj.tasks import Outcome, Task

# M* is found across failures up to this many noise bounds wide: the noise can push a run there.
WEDGE = 4.0


def critical_points(
    task: Task,
    policy: Policy,
    nodes: np.ndarray,
    neighbours: tuple[np.ndarray, np.ndarray],
    cell: float,
    resolution: float,
    noise: float = 0.0,
) -> np.ndarray:
    """Searches by outcome: returns middles (N, d) between close starts whose runs go different ways.

    Only runs that arrive show a way, and only ways that are modes count. Where others lie between two ways,
    as a policy with inertia may crash in between, the middle of these is critical.

    Args:
        task, policy, resolution, noise: as in `find_critical_set`.
        nodes: (n, d) starts.
        neighbours: (k,), (k,) indices of starts that lie next to each other.
        cell: the usual distance between two neighbours, in scaled units.
    """
    runs = WayRuns.of(task, way_runs(task, policy, nodes, label="critical set"))
    ways = Ways.of(task, runs, neighbours)
    works = ways.works(runs)
    if not works.any():
        return np.empty((0, task.chart.dimension))
    wedge = max(WEDGE * (task.noise_in_chart(noise) / task.chart.scale).max(), resolution * cell)
    longest = np.linalg.norm(_gap(task, nodes, *neighbours) / task.chart.scale, axis=1).max()
    first, second = _across(task, nodes, neighbours, works, runs.alive)
    first, second = first[pair := runs[first].differ(runs[second])], second[pair]
    gap = _gap(task, nodes, first, second)
    # Between two nodes that work, failures end up to an edge of the grid before each of them.
    near = np.linalg.norm(gap / task.chart.scale, axis=1) <= (wedge + 2 * longest) * (1 + 1e-9)
    first, second, gap = first[near], second[near], gap[near]
    a, b = nodes[first], nodes[first] + gap
    return _bisected(
        task, policy, ways, a, b, runs[first], runs[second], resolution * cell, wedge, cell
    )


def _gap(task: Task, nodes: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the ways (k, d) from the first to the second nodes of pairs (k,), (k,)."""
    return task.chart.difference(nodes[second], nodes[first])


def _across(
    task: Task,
    nodes: np.ndarray,
    neighbours: tuple[np.ndarray, np.ndarray],
    works: np.ndarray,
    alive: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns pairs (k,), (k,) of nodes that work: neighbours, and those on both sides of others.

    Nodes in between are alive. Each of them stands for the nearest node that works.
    """
    stands = np.arange(len(nodes))
    place = np.flatnonzero(works)
    failed = np.flatnonzero(alive & ~works)
    if len(failed):
        nearest = task.chart.tree(nodes[place]).query(task.chart.in_box(nodes[failed]))[1]
        stands[failed] = place[nearest]
    first, second = neighbours
    known = alive | works
    both = known[first] & known[second]
    pairs = np.sort(np.stack([stands[first[both]], stands[second[both]]]), axis=0)
    first, second = np.unique(pairs, axis=1)
    return first, second


def _bisected(
    task: Task,
    policy: Policy,
    ways: Ways,
    a: np.ndarray,
    b: np.ndarray,
    at_a: WayRuns,
    at_b: WayRuns,
    resolution: float,
    wedge: float,
    cell: float,
) -> np.ndarray:
    """Returns the middles (N, d) of pairs of starts a, b (n, d), bisected until only failures lie between.

    Args:
        at_a, at_b: the runs from a and b, which go different ways.
        resolution: the least distance from a way to what lies beside it.
        wedge: the greatest width of the failures.
        task, policy, ways, cell: as in `critical_points`.
    """
    # Failures are known between c and d; without any, c is b and d is a.
    c, d, known = b.copy(), a.copy(), np.zeros(len(a), dtype=bool)
    resolution *= 1 + 1e-9
    finished = 0
    while finished < 2:  # one after the other, both sides
        left = np.flatnonzero(np.linalg.norm((c - a) / task.chart.scale, axis=1) > resolution)
        finished = 0 if len(left) else finished + 1
        if len(left):
            middle = (a[left] + c[left]) / 2
            runs = WayRuns.of(task, way_runs(task, policy, middle))
            works = ways.works(runs)
            same = works & ~runs.differ(at_a[left])
            other = works & ~same
            fails = left[~works]
            d[fails] = np.where(known[fails, None], d[fails], middle[~works])
            c[fails], known[fails] = middle[~works], True
            a[left[same]], b[left[other]] = middle[same], middle[other]
            c[left[other]], known[left[other]] = middle[other], False
            at_a, at_b = (
                at_a.with_rows(left[same], runs[same]),
                at_b.with_rows(left[other], runs[other]),
            )
            # Without failures in between, c is b and d is a.
            d[left] = np.where(known[left, None], d[left], a[left])
        a, b, c, d, at_a, at_b = b, a, d, c, at_b, at_a
    apart = at_a.differ(at_b) & (
        np.linalg.norm((d - c) / task.chart.scale, axis=1) <= wedge * (1 + 1e-6)
    )
    failures = np.linalg.norm((d - c) / task.chart.scale, axis=1)
    wide = np.flatnonzero(apart & known & (failures > resolution))
    if len(wide):
        # Where no measurement within the wedge helps any more, there is nothing left to decide.
        middle, noisy = (a[wide] + b[wide]) / 2, task.noise_in_chart(1.0) > 0
        ends = (_arrives(task, policy, middle, noisy * (z[wide] - middle)) for z in (a, b))
        apart[wide] = np.logical_or(*ends)
    if task.gives_direction:
        apart &= _go_apart(task, policy, a, b, cell)
    return ((a + b) / 2)[apart]


def _arrives(task: Task, policy: Policy, z: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Returns whether runs from z (n, d) arrive with constant errors (n, d) of measurement: (n,) bool."""
    run = closed_loop(task, PolicyController(policy), z, _Constant(task, error))
    return np.asarray(run.outcome == Outcome.REACHED)


class _Constant(Signal):
    """Constant errors (n, d) of the measured chart points of n runs."""

    kind = "constant"

    def __init__(self, task: Task, error: np.ndarray):
        super().__init__(float(np.abs(error).max(initial=0.0)), np.array(task.noisy, dtype=float))
        self._task, self._error = task, error

    def sample(self, now: Sample) -> np.ndarray:
        task, true = self._task, now.measurement
        return np.asarray(task.with_z(true, task.z(true) + self._error[now.rows]) - true)


def _go_apart(task: Task, policy: Policy, a: np.ndarray, b: np.ndarray, far: float) -> np.ndarray:
    """Returns whether runs from a and b (n, d) get farther apart than `far` while both last: (n,) bool.

    Two runs that crash into a pillar on either side of its middle do not go apart, and neither do two that
    chatter around the same point: the longest hop of each run in one sample does not count.
    """
    n = len(a)
    if not n:
        return np.zeros(0, dtype=bool)
    rollout = policy_runs(task, policy, np.vstack([a, b]))
    moved = (rollout.path - rollout.path[0]) / task.chart.scale
    apart = np.linalg.norm(moved[:, :n] - moved[:, n:], axis=2)
    last = np.minimum(rollout.length[:n], rollout.length[n:])
    apart[np.arange(len(apart))[:, None] > last] = 0.0
    hop = np.linalg.norm(np.diff(moved, axis=0), axis=2).max(axis=0)
    return np.asarray(apart.max(axis=0) > far + hop[:n] + hop[n:])
