"""Stages 3 and 4 (paper, Steps 3 and 4): the parts M_i of the chart, and a policy pi_i for each part."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.files.artifacts import Saved
from hyrl_mj.judging.game import NEVER, Limit
from hyrl_mj.learning import WaySettings
from hyrl_mj.policies import Policy
from hyrl_mj.sets import GridSet, Nodes, check_points, resolving, shortest_ways
from hyrl_mj.simulation import policy_runs, way_runs
from hyrl_mj.stages.refinement import refined, thinned
from hyrl_mj.stages.ways import HomotopyClasses
from hyrl_mj.tasks import ANY, Outcome, Task, number_of


@dataclass(frozen=True)
class Partition(Saved):
    """The parts M_i (paper, Step 3).

    States from which nothing is left to decide (beyond the obstacle, at the set-point) belong to every
    part. Those from which a run fails belong to the parts of the nearest one from which it arrives.

    Attributes:
        modes: the modes.
        parts: M_i of each mode, in the same order.
        succeeds: (N,) bool, the grid's nodes from which the stage-1 policy reaches the set-point.
        dropped: ways that too few of the nodes go to be modes.
        unparted: without a critical set, the ways that runs go all the same.
    """

    KIND: ClassVar[str] = "partition"

    modes: tuple[int, ...]
    parts: tuple[GridSet, ...]
    succeeds: np.ndarray
    dropped: tuple[int, ...] = ()
    unparted: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        check_sets(self.modes, self.parts, (self.succeeds,))

    def __repr__(self) -> str:
        shares = [f"{q}: {p.share:.1%}" for q, p in zip(self.modes, self.parts, strict=True)]
        return f"Partition({', '.join(shares)} of {self.grid})"

    def __iter__(self) -> Iterator[GridSet]:
        return iter(self.parts)

    @property
    def grid(self) -> Nodes:
        """The nodes of the parts: a grid or a cloud."""
        return self.parts[0].grid

    def astray(self, part: GridSet, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Returns whether runs from outside M_i come into it by another way than its own: (k,) bool.

        They do if they end where M_i overlaps with a part that holds their start: nothing was left to decide
        there, and they went as that part does.

        Args:
            part: M_i.
            starts: (k,) indices of nodes outside M_i.
            ends: (k,) indices of nodes.
        """
        masks = np.stack([other.mask for other in self.parts])
        return np.asarray(part.mask[ends] & (masks[:, starts] & masks[:, ends]).any(axis=0))

    def sentence(self, task: Task, settings: WaySettings = WaySettings()) -> str:
        """Returns a one-line description; `settings` are those that the partition was made with."""
        shares = ", ".join(
            f"{task.mode_name(q)} {100 * part.share:.0f}%"
            for q, part in zip(self.modes, self.parts, strict=True)
        )
        notes = ""
        if self.dropped:
            rare = ", ".join(map(task.mode_name, self.dropped))
            notes += f"; less than {settings.least_share:.0%} goes {rare}: no mode"
        if self.unparted:
            found = ", ".join(map(task.mode_name, self.unparted))
            notes += (
                f"; runs go {found}, but no critical set was found between these ways, so that they are no "
                f"modes: if the policy fails over more than {settings.wedge:g} eps between them, train it "
                "longer"
            )
        if len(self.modes) > 1 and (unseen := self._unseen(task)):
            notes += f"; no run that arrives goes {', '.join(map(task.mode_name, unseen))}"
        return f"share of the chart by mode: {shares}{notes}"

    def _unseen(self, task: Task) -> list[int]:
        """Returns the ways that the task's scene names and that no run goes."""
        named = task.scene.mode_names if task.gives_direction or len(task.obstacles) == 1 else ()
        return [q for q in range(len(named)) if q not in (*self.modes, *self.dropped)]


def check_sets(
    modes: tuple[int, ...], sets: tuple[GridSet, ...], masks: tuple[np.ndarray, ...]
) -> None:
    """Raises `BadInput` unless there is one set for each mode, and all sets and masks (N,) have one size."""
    if not sets or len(sets) != len(modes):
        raise BadInput(f"{len(sets)} sets do not fit {len(modes)} modes: give one for each mode")
    shapes = {members.values.shape for members in sets} | {mask.shape for mask in masks}
    if len(shapes) > 1:
        raise BadInput(f"sets and masks of shapes {shapes} do not lie on one grid")


def make_partition(
    task: Task,
    policy: Policy,
    points: np.ndarray,
    cells: int,
    eps: float = 0.0,
    settings: WaySettings = WaySettings(),
) -> Partition:
    """Splits the nodes of a grid by the way that the closed loop goes from each (paper, Step 3).

    If M* is empty, there is one part that holds the whole chart: of mode 0, or past several obstacles of the
    mode of any way.

    Args:
        task: gives chart, plant, and the way of a run.
        policy: the stage-1 policy.
        points: (N, d) of M*, from stage 2.
        cells: cells of the grid along the longest side of the chart, if they were square.
        eps: bound of the measurement noise; in charts of three and more dimensions the nodes lie close
            enough to tell states apart that it does, as far as `cells` allows.
        settings: which ways are modes.
    """
    points = check_points(task.chart, points, task.name)
    grid = resolving(task.chart, cells, points, task.noise_in_chart(max(eps, 1e-6)))
    simulated, neighbours = thinned(task, grid)
    first, _ = way_runs(task, policy, grid.nodes[simulated], label="partition")
    nodes, near = grid.nodes[simulated], None
    if first.passing is not None and eps and len(points):
        width = _strip_width(task, eps, longest_hop(task, policy, grid))
        hidden = float((task.noise_in_chart(eps) / task.chart.scale).max())
        a, b = neighbours
        across = _across(task, nodes, points, 2 * max(hidden, grid.cell))
        neighbours = np.append(a, across[0]), np.append(b, across[1])

        def near(rows: np.ndarray) -> np.ndarray:
            return shortest_ways(task.chart, nodes, (a, b), first.alive, rows, width) <= width

    ways = HomotopyClasses.from_runs(task, first, neighbours, near, settings)
    modes = ways.modes if len(points) else ()

    def tell(rows: np.ndarray) -> np.ndarray:
        """Returns the modes of nodes, whether their runs work, and whether they arrive: (k, Q + 2)."""
        runs = first
        if not np.array_equal(rows, simulated):
            runs, _ = way_runs(task, policy, grid.nodes[rows], label="partition")
        return np.column_stack([ways.members(runs), ways.works(runs), runs.arrived])

    everywhere, columns = np.ones(grid.size, dtype=bool), len(ways.modes) + 2
    wedge = settings.wedge * eps
    known = refined(task, grid, everywhere, points, wedge, tell, columns).astype(bool)
    members, succeeds = known[:, :-2], known[:, -1]
    works, failed = np.flatnonzero(known[:, -2]), np.flatnonzero(~known[:, -2])
    if modes and len(failed):
        _, nearest = task.chart.nearest(grid.nodes[works], grid.nodes[failed])
        members[failed] = members[works[nearest]]
    masks = members.T if modes else np.ones((1, len(grid.nodes)), dtype=bool)
    parts = tuple(GridSet.from_mask(grid, mask) for mask in masks)
    unparted = () if modes or len(ways.modes) < 2 else ways.modes
    alone = 0 if ways.end.size < 2 else int(number_of(np.full((1, ways.end.size), ANY))[0])
    return Partition(modes or (alone,), parts, succeeds, ways.dropped, unparted)


# ---- the strips of a part beside M*: how wide one is for the set of the other mode to end there
#
# A state from which nothing is left to decide belongs to every part. If the policy decides late, such states
# lie close behind M*, and the set of the mode on the other side would reach over the strip between them. That
# mode would then never end, and would itself have to decide where it turns back.


def _strip_width(task: Task, eps: float, hop: np.ndarray) -> float:
    """Returns the width that a strip needs, in scaled units.

    The set of the other mode reaches 2 eps and a hop over M*, and eps and a hop over the other edge of the
    strip. Between them a robot must not be able to pass unseen, which takes 2 eps and a hop. All of these act
    along each coordinate, so that they are longer where M* lies across several.

    Args:
        task: gives the noisy coordinates.
        eps: bound of the measurement noise.
        hop: (d,) longest hop in one sample.
    """
    bounds = task.noise_in_chart(eps)
    return float(np.linalg.norm((5 * bounds + 3 * hop) * (bounds > 0) / task.chart.scale))


def _across(task: Task, nodes: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """Returns indices (2, k) of those of nodes (N, d) that lie opposite to each other across points of M*.

    Runs from adjacent nodes so close to M* often fail, so pairs are taken across M*.

    Args:
        task: gives the chart.
        nodes: (N, d).
        points: (K, d) of M*.
        reach: how far from a point both may lie, in scaled units.
    """
    chart = task.chart
    # Of many points of M* a few hundred show the same nodes.
    points = points[np.unique(np.linspace(0, len(points) - 1, 500).astype(int))]
    tree = chart.tree(nodes)
    close = tree.query_ball_point(chart.in_box(points), reach)
    first = np.concatenate([np.empty(0, dtype=int), *map(np.asarray, close)]).astype(int)
    over = np.repeat(points, [len(rows) for rows in close], axis=0)
    mirrored = chart.wrap(over + chart.difference(over, nodes[first]))
    return np.unique([first, tree.query(chart.in_box(mirrored))[1]], axis=1)


# ---- room for an agent's modes, and a policy for each part


def with_room(
    task: Task, policy: Policy, partition: Partition, ways: Sequence[np.ndarray], eps: float
) -> Partition:
    """Returns the parts, changed where the policy goes a way that is about to close while another is not.

    A policy that drives towards the middle of an obstacle and decides at the last moment, or goes one way
    from wherever it just succeeds, leaves no room for an overlap. A state with less room for its way than
    2 eps and one sample is therefore assigned to the mode whose way has the most room. Where every way has
    that room, or none has any, the decision of the policy stands.

    Args:
        task: gives the noisy coordinates.
        policy: the stage-1 policy, or the agent.
        partition: M_i, by the way that the policy goes.
        ways: (N,) bool over the nodes for each mode, from where its way is open.
        eps: bound of the measurement noise.
    """
    grid = partition.grid
    if len(partition.parts) < 2:
        return partition
    hop = longest_hop(task, policy, grid) * (task.noise_in_chart(1.0) > 0)
    wanted = float((2 * task.noise_in_chart(eps) + hop).max())
    room = -np.stack([GridSet.from_mask(grid, open_).values for open_ in ways])
    masks = np.stack([part.mask for part in partition.parts])
    own = np.where(masks, room, -np.inf).max(axis=0)
    best = room.argmax(axis=0)
    moved = (masks.sum(axis=0) == 1) & (own < wanted) & (room.max(axis=0) > np.maximum(own, 0))
    if not moved.any():
        return partition
    parts = tuple(
        GridSet.from_mask(grid, np.where(moved, best == i, mask)) for i, mask in enumerate(masks)
    )
    return replace(partition, parts=parts)


def open_ways(limit: Limit, grid: Nodes) -> tuple[np.ndarray, ...]:
    """Returns the nodes (N,) bool of a grid from which each mode's way is open."""
    at = limit.lattice.grid.nearest(grid.nodes)
    return tuple(samples[at] < NEVER for samples in limit.samples)


def boundary(partition: Partition) -> np.ndarray:
    """Returns points (N, d) between neighbouring nodes of which no part holds both."""
    grid = partition.grid
    first, second = grid.neighbours()
    shared = np.any([part.mask[first] & part.mask[second] for part in partition.parts], axis=0)
    a, b = grid.nodes[first[~shared]], grid.nodes[second[~shared]]
    return np.asarray(a + grid.chart.difference(b, a) / 2)


@dataclass(frozen=True)
class PartPolicy:
    """pi_i (paper, Step 4): the stage-1 policy on M_i; elsewhere, its input at the nearest point of M_i.

    Near M* a continuous policy decides for neither way. The neighbourhood of the boundary therefore counts
    as elsewhere: there, too, pi_i takes the input of the nearest point at which the policy has decided.

    Attributes:
        task: gives the chart.
        policy: the stage-1 policy.
        inside: M_i without the neighbourhood of its boundary.
        near: width of that neighbourhood, in scaled units.
        whole: whether nothing counts as elsewhere, so that it is the stage-1 policy itself.
    """

    KIND: ClassVar[str] = "part policy"

    task: Task
    policy: Policy
    inside: GridSet
    near: float
    whole: bool = False

    @property
    def undivided(self) -> PartPolicy:
        """The stage-1 policy itself, everywhere."""
        return replace(self, whole=True)

    def act(self, measured: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for measurements (n, p)."""
        if self.whole:
            return self.policy.act(measured)
        nearest = self.inside.project(self.task.z(measured))
        return self.policy.act(self.task.with_z(measured, nearest))

    def save(self, path: Path) -> None:
        """Writes a JSON file beside a path; the stage-1 policy and M_i are in other files."""
        path = path.with_name(f"{path.stem}_part.json")
        artifacts.write_json(path, {"near": self.near, "whole": self.whole}, self.KIND)

    @staticmethod
    def load(path: Path, task: Task, policy: Policy, partition: Partition, mode: int) -> PartPolicy:
        """Reads what `save` wrote; raises `BadArtifact` if it is missing, damaged, or of another version."""
        near, whole = artifacts.read_json(
            path,
            PartPolicy.KIND,
            lambda content: (float(content["near"]), bool(content.get("whole", False))),
        )
        part = partition.parts[partition.modes.index(mode)]
        return PartPolicy(task, policy, part.eroded(near), near, whole)


def part_policies(
    task: Task, policy: Policy, partition: Partition, eps: float
) -> dict[int, PartPolicy]:
    """Returns pi_i of each mode, with as wide a neighbourhood of M* as the noise and the steps need."""
    near = neighbourhood(partition, eps, longest_hop(task, policy, partition.grid))
    parts = zip(partition.modes, partition.parts, strict=True)
    return {mode: PartPolicy(task, policy, part.eroded(near), near) for mode, part in parts}


def neighbourhood(partition: Partition, eps: float, hop: np.ndarray) -> float:
    """Returns the width of the neighbourhood of M*: the noise, some cells, or one sample's hop (d,)."""
    grid = partition.grid
    # M* is known to about a cell, and four are a margin. Of more than two parts some are wedges: so wide a
    # neighbourhood would cut them back far from M*, to where a policy goes straight on, clear of it.
    cells = 4 if len(partition.parts) <= 2 else 1.5
    return max(eps, cells * grid.cell, float(np.linalg.norm(hop / grid.chart.scale)))


def longest_hop(task: Task, policy: Policy, grid: Nodes) -> np.ndarray:
    """Returns the longest hop (d,) of the closed loop in one sample, along each coordinate.

    A collision can change velocities by more than any input does: runs that crash at once do not count,
    unless all do.
    """
    nodes = grid.nodes[thinned(task, grid)[0]]
    rollout = policy_runs(task, policy, nodes, steps=1)
    hops = np.abs(rollout.path[-1] - rollout.path[0])
    goes_on = ~np.isin(rollout.outcome, (Outcome.CRASHED, Outcome.UNSTABLE))
    return np.asarray((hops[goes_on] if goes_on.any() else hops).max(axis=0))
