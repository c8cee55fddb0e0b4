"""Stage 5 (paper, Step 5): the extended sets M_ext_i, which overlap over the critical set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import product
from typing import ClassVar

import numpy as np

from hyrl_mj.errors import BadInput, counted
from hyrl_mj.files.artifacts import Saved
from hyrl_mj.judging.game import Lattice, nearest_of
from hyrl_mj.learning import OverlapSettings
from hyrl_mj.policies import Policy
from hyrl_mj.sets import Cloud, Grid, GridSet, Nodes, check_points, distance_to
from hyrl_mj.simulation import Rollout, policy_runs
from hyrl_mj.stages.meeting import least_room, where
from hyrl_mj.stages.partition import (
    Partition,
    PartPolicy,
    check_sets,
    longest_hop,
    neighbourhood,
)
from hyrl_mj.stages.refinement import refined
from hyrl_mj.tasks import Outcome, Task, stands_still


@dataclass(frozen=True)
class ExtendedSets(Saved):
    """The extended sets M_ext_i (paper, Step 5).

    Attributes:
        modes: the modes.
        sets: M_ext_i of each mode, in the same order.
        winning: W_i, the winning region of each mode, as (N,) bool over the grid's nodes: from there pi_i
            reaches the set-point.
        horizon: time T of the backward propagation [s]; 0 without propagation.
        eps: bound of the measurement noise that the sets are made for.
        points: (K, d) points of M* where modes meet, and the way of one of them is open.
        room: (K,) how far across M* two modes that meet there both win, in the unit of the noise; 2 eps are
            needed.
        between: (K, 2) the numbers of these two modes: of all that meet there those with the least room.
    """

    KIND: ClassVar[str] = "extended sets"

    modes: tuple[int, ...]
    sets: tuple[GridSet, ...]
    winning: tuple[np.ndarray, ...]
    horizon: float
    eps: float
    points: np.ndarray
    room: np.ndarray
    between: np.ndarray = field(default_factory=lambda: np.empty((0, 2), dtype=int))

    def __post_init__(self) -> None:
        check_sets(self.modes, self.sets, self.winning)
        k, kinds = len(self.points), [a.dtype.kind for a in (self.points, self.room, self.between)]
        fits = self.room.shape == (k,) and self.between.shape == (k, 2) and kinds == ["f", "f", "i"]
        if not (fits and np.isin(self.between, self.modes).all()):
            raise BadInput(
                f"room of shape {self.room.shape} between modes of shape {self.between.shape} does not fit "
                f"{k} points of M* and modes {self.modes}: give ({k},) and ({k}, 2)"
            )

    def __repr__(self) -> str:
        shares = [f"{q}: {m.share:.1%}" for q, m in zip(self.modes, self.sets, strict=True)]
        return f"ExtendedSets({', '.join(shares)} of the chart, eps {self.eps:g})"

    def sentence(self, task: Task) -> str:
        """Returns a one-line description."""
        reach = f"T = {self.horizon:.2g} s" if self.horizon else "as far as the ways are open"
        text = f"{len(self.sets)} extended sets, {reach}{self._shared()}"
        if len(self.sets) < 2:
            text = "one mode, whose set is the whole chart"
        return "; ".join([text, *self._narrow_places(task), *self._without_starts(task)])

    def _without_starts(self, task: Task) -> Iterator[str]:
        """Yields the modes whose set holds starts of the task, but whose winning region none."""
        for mode, inside, wins in zip(self.modes, self.sets, self.winning, strict=True):
            starts = task.may_start(inside.grid.nodes)
            if wins.any() and (starts & inside.mask).any() and not (starts & wins).any():
                yield (
                    f"no start of the task is known to arrive in mode {task.mode_name(mode)}: stage 6 trains "
                    "and tests it from other states alone"
                )

    @property
    def narrow(self) -> np.ndarray:
        """Whether the noise needs more room than two modes have at each of the points: (K,) bool."""
        return np.asarray(self.room < 2 * self.eps - self.sets[0].grid.cell)

    def _narrow_places(self, task: Task) -> Iterator[str]:
        """Yields between which modes nobody can switch in time, and where."""
        unit, narrow = task.noise_on()[1], self.narrow
        pairs, counts = np.unique(self.between[narrow], axis=0, return_counts=True)
        most = np.argsort(-counts, kind="stable")[:3]
        for pair in pairs[most]:
            here = (self.between == pair).all(axis=1)
            first, second = map(task.mode_name, pair.tolist())
            left = self.room[here & narrow].min()
            place = where(task.chart, self.points[here], narrow[here])
            yield (
                f"between {first} and {second}, {place}, the room in which both win is only {left:.2g} "
                f"{unit} wide; switching safely needs {2 * self.eps:g} {unit}"
            )
        if more := len(pairs) - len(most):
            yield f"so it is in places between {counted(more, 'other pair')} of modes"

    def _shared(self) -> str:
        """Returns how much of the chart the sets of modes that meet share."""
        sets = dict(zip(self.modes, self.sets, strict=True))
        pairs = np.unique(self.between, axis=0).tolist()
        shares = [100 * (sets[a] & sets[b]).share for a, b in pairs]
        if not shares:
            return ""
        if len(self.sets) == 2:
            return f", which share {shares[0]:.1f}% of the chart"
        least, most = min(shares), max(shares)
        much = f"{least:.1f}%" if most - least < 0.05 else f"{least:.1f} to {most:.1f}%"
        return f", those of two modes that meet share {much} of the chart"


def extend(
    task: Task,
    policy: Policy,
    points: np.ndarray,
    partition: Partition,
    eps: float,
    horizon: float | None = None,
    ways: Sequence[np.ndarray] | None = None,
    settings: OverlapSettings = OverlapSettings(),
) -> ExtendedSets:
    """Extends the parts over M* (paper, Steps 4 and 5).

    X_i are the states outside M_i that x' = -f(x, pi_i(x)) reaches from the neighbourhood of M* within the
    horizon; for a plant that cannot run backward, those that pi_i brings into M_i within the horizon. They
    are trimmed to where mode i still succeeds, with room for the noise. Every part is widened by the noise
    bound, so that a wrong measurement does not switch back:

        M_ext_i = ((M_i u X_i) n (W_i eroded by eps)) u (M_i dilated by eps)

    Erosion and dilation act along the noisy coordinates. For a plant with dynamics the dilation is by the
    longest hop in one sample more. A wall that only stops the robot is not eroded from, and its inside
    belongs to the sets of the states beside it.

    Args:
        task: gives plant and chart.
        policy: the stage-1 policy.
        points: (N, d) of M*, from stage 2.
        partition: M_i, from stage 3.
        eps: bound of the measurement noise.
        horizon: time T of the backward propagation [s]. By default, the shortest with which every set
            reaches 2 eps and one sample over M* wherever its mode succeeds; the sets end there.
        ways: (N,) bool over the nodes for each mode, from where its way is known to be open. Beyond its
            decision a policy may be unable to go the other way, but stage 6 trains the mode to do so: W_i is
            then where way i is open. Without a horizon, every set reaches 2 eps and one sample over the
            boundary of its part.
        settings: when a horizon is long enough, and what is a gap.
    """
    points = check_points(task.chart, points, task.name)
    grid, parts = partition.grid, partition.parts
    noise, hop = task.noise_in_chart(eps), longest_hop(task, policy, grid)
    near = neighbourhood(partition, eps, hop)
    pis = [PartPolicy(task, policy, part.eroded(near), near) for part in parts]
    # Each part with 2 eps and one sample around it.
    by = 2 * noise + hop * (task.noise_in_chart(1.0) > 0)
    wanted = [part.dilated_by_box(by) for part in parts]
    # The extended sets lie among these candidates.
    radius = 3 * eps + near + (0.0 if horizon is None else horizon / task.dt * near)
    candidates = [part.dilated(radius).mask for part in parts]
    off = distance_to(task.chart, points, grid.nodes)
    rims = [part.mask & (off <= near) for part in parts]
    # The cells that backward runs visit are those of a grid.
    backward = task.kinematic and isinstance(grid, Grid) and stands_still(task)
    longest = round(settings.longest / task.dt)
    held = None if ways is not None else held_inputs(task, grid)

    @cache
    def told(i: int) -> np.ndarray:
        """Returns what runs from outside of a part tell: from where its way succeeds, and when they enter."""
        rim = None if backward else rims[i]
        tell = partial(runs_from_outside, task, pis[i], partition, parts[i], rim, longest, held)
        return refined(task, grid, candidates[i] & ~parts[i].mask, points, radius, tell, 2)

    nowhere = np.zeros(grid.size, dtype=bool)
    walls = ~task.goes_on(grid.nodes) if task.abilities.stopped_by_walls else nowhere
    winning = (
        tuple((partition.succeeds & p.mask) | (told(i)[:, 0] > 0) for i, p in enumerate(parts))
        if ways is None
        else tuple(ways)
    )
    # W_i with room for the noise. Noise that shows the robot in a wall that only stops it does not show it
    # where its mode fails.
    roomy = [
        GridSet.from_mask(grid, wins | ~candidate | walls).eroded_by_box(noise)
        for wins, candidate in zip(winning, candidates, strict=True)
    ]
    reached, propagated = wanted, horizon or 0.0
    if len(parts) < 2:
        reached = wanted if horizon is None else [*parts]
    elif ways is None or horizon is not None:
        within = [
            backward_reach(task, pi, part, rim, settings.gap)
            if backward
            else forward_reach(part, told(i)[:, 2])
            for i, (pi, part, rim) in enumerate(zip(pis, parts, rims, strict=True))
        ]
        # Nodes near to M* have to be covered: where parts meet elsewhere, as at the set-point, nothing is
        # left to decide.
        around = off <= float(np.linalg.norm((2 * noise + hop) / task.chart.scale))
        goals = [
            (w & room).mask & ~part.mask & around
            for w, room, part in zip(wanted, roomy, parts, strict=True)
        ]
        given = max(round(horizon / task.dt), 1) if horizon else None
        k = given or shortest(task, within, goals, settings)
        reached = [part | reach(k) for part, reach in zip(parts, within, strict=True)]
        if horizon is None:
            reached = [r & w for r, w in zip(reached, wanted, strict=True)]
        propagated = horizon or k * task.dt
    # With inertia a run goes on for a sample before the new mode tells: chattering would cross a set that is
    # just as wide as the noise.
    wide = noise if task.kinematic else noise + hop * (noise > 0)
    sets = tuple(
        (r & room) | part.dilated_by_box(wide)
        for r, room, part in zip(reached, roomy, parts, strict=True)
    )
    if walls.any():  # where noise shows the robot in a wall, it is beside it
        beside = nearest_of(grid, ~walls)
        sets = tuple(GridSet.from_mask(grid, own.mask[beside]) for own in sets)
    rows, pair, room = least_room(points, parts, winning, noise)
    between = np.array(partition.modes)[pair]
    return ExtendedSets(
        partition.modes, sets, winning, propagated, eps, points[rows], 2 * eps * room, between
    )


# ---- how far a part reaches over M*: backward from its rim, or by the runs that enter it


def shortest(
    task: Task,
    reach: list[Callable[[int], GridSet]],
    goals: list[np.ndarray],
    settings: OverlapSettings,
) -> int:
    """Returns the least number of samples with which every set fills its goal (N,) bool.

    What some set never reaches does not count, as a corner behind the place where three parts meet.
    """
    most, best = [0] * len(goals), 1
    for k in range(1, round(settings.longest / task.dt) + 1):
        pairs = zip(reach, goals, strict=True)
        filled = [int(np.count_nonzero(within(k).mask[goal])) for within, goal in pairs]
        if all(n >= settings.filled * goal.sum() for n, goal in zip(filled, goals, strict=True)):
            return k
        if any(n > before for n, before in zip(filled, most, strict=True)):
            most, best = np.maximum(filled, most).tolist(), k
        if k * task.dt > settings.patience + best * task.dt:
            break
    return best


def runs_from_outside(
    task: Task,
    pi: PartPolicy,
    partition: Partition,
    part: GridSet,
    rim: np.ndarray | None,
    longest: int,
    held: np.ndarray | None,
    rows: np.ndarray,
) -> np.ndarray:
    """Returns what is known of nodes `rows` (k,) by the runs of pi_i from those outside of M_i: (k, 3).

    These are whether they belong to W_i, from where pi_i arrives by its own way, whether the runs enter M_i
    on the rim (N,) bool, and after how many samples, infinite for others and beyond the `longest`. Past
    obstacles, a run from outside M_i may go another way into it (see `Partition.astray`). Scattered nodes
    lie too far apart for a rim: there it counts wherever the runs enter M_i. Without a rim, only W_i is asked
    for.

    pi_i says little of what a mode can do from where the stage-1 policy goes the other way. Where its run
    fails, each of the `held` inputs (A, m) is held until the robot is in M_i, a cell from its boundary, and
    the stage-1 policy goes on from there: a run that arrives shows that a mode can.
    """
    arrives = partition.succeeds & part.mask
    entry = np.full(len(rows), np.inf)
    wins = arrives[rows]
    if rim is not None:
        entry[part.mask[rows] & rim[rows]] = 1.0  # of those beside them
    outside = np.flatnonzero(~part.mask[rows])
    if len(outside):
        nodes = part.grid.nodes[rows[outside]]
        rollout = policy_runs(task, pi, nodes, label="extended sets")
        wins[outside] = rollout.outcome == Outcome.REACHED
        if not task.gives_direction:
            wins[outside] &= ~_astray(partition, part, arrives, rows[outside], rollout)
        if rim is not None:
            entry[outside] = _entries(part, rim, rollout, longest)
    inside = part.eroded(part.grid.cell)
    for u in () if held is None else held:
        lost = outside[~wins[outside]]
        if not len(lost):
            break
        starts = part.grid.nodes[rows[lost]]
        rollout = policy_runs(
            task, _Entering(pi, inside, u), starts, label="extended sets, held inputs"
        )
        won = rollout.outcome == Outcome.REACHED
        won &= ~_astray(partition, part, arrives, rows[lost], rollout)
        wins[lost] = won
        if rim is not None:
            entry[lost[won]] = _entries(part, rim, rollout, longest)[won]
    return np.column_stack([wins, np.isfinite(entry), entry])


@dataclass(frozen=True)
class _Entering:
    """Holds inputs u (m,) where the robot is not `inside` M_i, and goes on as the stage-1 policy there.

    pi_i would go on as at the nearest point at which that policy has decided, which with inertia may be far.
    """

    pi: PartPolicy
    inside: GridSet
    u: np.ndarray

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for measurements (n, p)."""
        inside = self.inside.contains(self.pi.task.z(measured))
        u = np.tile(self.u, (len(measured), 1)).astype(float)
        if inside.any():
            u[inside] = self.pi.policy.act(measured[inside])
        return u


def held_inputs(task: Task, grid: Nodes) -> np.ndarray | None:
    """Returns the inputs (A, m) that show what a mode can do at the nodes of a grid.

    They are the levels of a task, or the ends and the middle of the limits of each input. There are none
    where the worst-case game decides, or samples take too long to try them.
    """
    if task.effort.attacked or Lattice.decides(task, grid):
        return None
    if task.input_levels is not None:
        return np.asarray(task.input_levels)
    return np.array([*product(*np.linspace(*task.input_limits, 3).T)])


def _astray(
    partition: Partition, part: GridSet, arrives: np.ndarray, starts: np.ndarray, rollout: Rollout
) -> np.ndarray:
    """Returns which runs (k,) bool from nodes `starts` enter M_i by another way than its own.

    They enter M_i where they first come to one of the nodes (N,) bool of it from which pi_i `arrives`.
    """
    entered, astray = np.zeros((2, len(rollout.outcome)), dtype=bool)
    for z in rollout.path[1:]:
        at = part.grid.nearest(z)
        rows = np.flatnonzero(~entered & arrives[at])
        astray[rows] = partition.astray(part, starts[rows], at[rows])
        entered[rows] = True
    return astray


def _entries(part: GridSet, rim: np.ndarray, rollout: Rollout, longest: int) -> np.ndarray:
    """Returns after how many samples runs enter M_i on the rim (N,) bool: (k,), infinite for the others.

    No more samples are looked at than the `longest`.
    """
    entry = np.full(len(rollout.outcome), np.inf)
    under_way = np.ones(len(entry), dtype=bool)
    for k, z in enumerate(rollout.path[1 : longest + 1], 1):
        rows = np.flatnonzero(under_way)
        rows = rows[part.contains(z[rows])]
        on_rim = rows if isinstance(part.grid, Cloud) else rows[rim[part.grid.nearest(z[rows])]]
        entry[on_rim] = k
        under_way[rows] = False
    return entry


def backward_reach(
    task: Task, pi: PartPolicy, part: GridSet, rim: np.ndarray, gap: float
) -> Callable[[int], GridSet]:
    """Returns M_i u X_i as a function of the number of samples.

    X_i are the states that backward runs reach from the rim (N,) bool, the nodes of M_i near M*. A `gap` of
    so many cells between their samples is closed.
    """
    grid, gap = part.regular, gap * part.grid.cell
    nodes = grid.nodes[rim]
    path = nodes[None]

    def within(samples: int) -> GridSet:
        nonlocal path
        visited = np.zeros(len(grid.nodes), dtype=bool)
        if len(nodes):
            if len(path) <= samples:  # more than asked for: longer times are asked for in turn
                steps = max(samples, 2 * len(path))
                path = policy_runs(
                    task, pi, nodes, steps=steps, backward=True, label="backward"
                ).path
            z = _between_samples(path[: samples + 1], grid)
            visited[grid.nearest(z[task.chart.contains(z)])] = True
        # A closing, together with M_i, fills the gaps between the samples.
        wide = GridSet.from_mask(grid, visited | part.mask).dilated(gap)
        return GridSet.from_mask(grid, wide.mask).eroded(gap)

    return within


def forward_reach(part: GridSet, entry: np.ndarray) -> Callable[[int], GridSet]:
    """As `backward_reach`, but X_i are the nodes whose forward runs enter M_i on its rim.

    `entry` (N,) is after how many samples they do, not above zero where that is not known.
    """
    entry = np.where(entry > 0, entry, np.inf)
    return lambda samples: GridSet.from_mask(part.grid, part.mask | (entry <= samples))


def _between_samples(path: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns points (N, d) along paths (K + 1, n, d), so close that they miss no cell of the grid."""
    hops = np.diff(path, axis=0)
    count = max(int(np.ceil(np.abs(hops / grid.spacing).max(initial=0.0))), 1)
    shares = np.arange(count)[:, None, None, None] / count
    d = path.shape[-1]
    return np.concatenate([(path[:-1] + shares * hops).reshape(-1, d), path[-1]])
