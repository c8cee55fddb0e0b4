"""The search for the critical set by outcome: bisection between starts whose runs go different ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrl_mj.learning import WaySettings
from hyrl_mj.policies import Policy, PolicyController
from hyrl_mj.simulation import Rollout, Rows, Sample, Signal, WayRuns, closed_loop, way_runs
from hyrl_mj.stages.ways import HomotopyClasses
from hyrl_mj.tasks import Outcome, Task


def critical_points(
    task: Task,
    policy: Policy,
    nodes: np.ndarray,
    neighbours: tuple[np.ndarray, np.ndarray],
    cell: float,
    resolution: float,
    eps: float,
    settings: WaySettings,
) -> np.ndarray:
    """Searches by outcome: returns middles (N, d) between close starts whose runs go different ways.

    Only runs that arrive show a way, and only ways that are modes count. Where others lie between two ways,
    as a policy with inertia may crash in between, the middle of these is critical.

    Args:
        task, policy, resolution, eps, settings: as in `find_critical_set`.
        nodes: (n, d) starts.
        neighbours: (k,), (k,) indices of starts that lie next to each other.
        cell: the usual distance between two neighbours, in scaled units.
    """
    runs, rollout = way_runs(task, policy, nodes, label="critical set")
    paths = _paths(task, rollout)
    ways = HomotopyClasses.from_runs(task, runs, neighbours, settings=settings)
    works = ways.works(runs)
    if not works.any():
        return np.empty((0, task.chart.dimension))
    bound = (task.noise_in_chart(eps) / task.chart.scale).max()
    wedge = max(settings.wedge * bound, resolution * cell)
    longest = np.linalg.norm(_gap(task, nodes, *neighbours) / task.chart.scale, axis=1).max()
    first, second = _across(task, nodes, neighbours, works, runs.alive)
    first, second = first[pair := runs[first].differ(runs[second])], second[pair]
    gap = _gap(task, nodes, first, second)
    # Between two nodes that work, failures end up to an edge of the grid before each of them.
    near = np.linalg.norm(gap / task.chart.scale, axis=1) <= (wedge + 2 * longest) * (1 + 1e-9)
    first, second, gap = first[near], second[near], gap[near]
    a = _Side(nodes[first], runs[first], paths[first])
    b = _Side(nodes[first] + gap, runs[second], paths[second])
    return _bisected(task, policy, ways, a, b, resolution * cell, wedge, cell)


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
        _, nearest = task.chart.nearest(nodes[place], nodes[failed])
        stands[failed] = place[nearest]
    first, second = neighbours
    known = alive | works
    both = known[first] & known[second]
    pairs = np.sort(np.stack([stands[first[both]], stands[second[both]]]), axis=0)
    first, second = np.unique(pairs, axis=1)
    return first, second


@dataclass(frozen=True)
class _Side(Rows):
    """One side of pairs of starts.

    Attributes:
        z: (n, d) the starts.
        runs: the ways of the runs from them.
        paths: (n,) the paths of these runs, of `_paths`.
    """

    z: np.ndarray
    runs: WayRuns
    paths: np.ndarray


def _paths(task: Task, rollout: Rollout) -> np.ndarray:
    """Returns the paths of n runs: (n,) of arrays (samples + 1, d), each up to the end of its run.

    They are asked for only where a task gives directions; elsewhere they are None.
    """
    paths = np.full(len(rollout.length), None, dtype=object)
    if task.gives_direction:
        for i, samples in enumerate(rollout.length):
            paths[i] = rollout.path[: samples + 1, i].copy()
    return paths


def _bisected(
    task: Task,
    policy: Policy,
    ways: HomotopyClasses,
    a: _Side,
    b: _Side,
    resolution: float,
    wedge: float,
    cell: float,
) -> np.ndarray:
    """Returns the middles (N, d) of pairs of starts a, b (n, d), bisected until only failures lie between.

    Args:
        a, b: starts from which runs go different ways.
        resolution: the least distance from a way to what lies beside it.
        wedge: the greatest width of the failures.
        task, policy, ways, cell: as in `critical_points`.
    """
    # Failures are known between c and d; without any, c is b and d is a.
    c, d, known = b.z.copy(), a.z.copy(), np.zeros(len(a.z), dtype=bool)
    resolution *= 1 + 1e-9
    finished = 0
    while finished < 2:  # one after the other, both sides
        left = np.flatnonzero(np.linalg.norm((c - a.z) / task.chart.scale, axis=1) > resolution)
        finished = 0 if len(left) else finished + 1
        if len(left):
            middle = (a.z[left] + c[left]) / 2
            of_middle, rollout = way_runs(task, policy, middle)
            found = _Side(middle, of_middle, _paths(task, rollout))
            works = ways.works(found.runs)
            same = works & ~found.runs.differ(a.runs[left])
            other = works & ~same
            fails = left[~works]
            d[fails] = np.where(known[fails, None], d[fails], middle[~works])
            c[fails], known[fails] = middle[~works], True
            a.put(left[same], found[same])
            b.put(left[other], found[other])
            c[left[other]], known[left[other]] = middle[other], False
            # Without failures in between, c is b and d is a.
            d[left] = np.where(known[left, None], d[left], a.z[left])
        a, b, c, d = b, a, d, c
    failures = np.linalg.norm((d - c) / task.chart.scale, axis=1)
    apart = a.runs.differ(b.runs) & (failures <= wedge * (1 + 1e-6))
    wide = np.flatnonzero(apart & known & (failures > resolution))
    if len(wide):
        # Where no measurement within the wedge helps any more, there is nothing left to decide.
        middle, noisy = (a.z[wide] + b.z[wide]) / 2, task.noise_in_chart(1.0) > 0
        ends = (_arrives(task, policy, middle, noisy * (z[wide] - middle)) for z in (a.z, b.z))
        apart[wide] = np.logical_or(*ends)
    if task.gives_direction:
        pairs = zip(a.paths, b.paths, strict=True)
        apart &= np.array([_go_apart(task, *pair, cell) for pair in pairs], dtype=bool)
    return ((a.z + b.z) / 2)[apart]


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

    @property
    def limits(self) -> np.ndarray:
        """No limits: the errors are those of chart points, and a measurement may show them otherwise."""
        return np.full(len(self.shares), np.inf)

    def sample(self, now: Sample) -> np.ndarray:
        task, true = self._task, now.measurement
        return np.asarray(task.with_z(true, task.z(true) + self._error[now.rows]) - true)


def _go_apart(task: Task, a: np.ndarray, b: np.ndarray, far: float) -> bool:
    """Returns whether runs along paths a and b (samples + 1, d) get farther apart than `far` while both last.

    Two runs that crash into a pillar on either side of its middle do not go apart, and neither do two that
    chatter around the same point: the longest hop of each run in one sample does not count.
    """
    moved = [(path - path[0]) / task.chart.scale for path in (a, b)]
    last = min(map(len, moved))
    hops = (np.linalg.norm(np.diff(m, axis=0), axis=1).max(initial=0.0) for m in moved)
    apart = np.linalg.norm(moved[0][:last] - moved[1][:last], axis=1)
    return bool(apart.max() > far + sum(hops))
