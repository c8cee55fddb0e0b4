"""How fine the lattice of a task is: as many cells as fit into the memory."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.sets import MOST_NODES, Grid
from hyrl_mj.tasks import Task

# Cells along the longest side of the game's lattice, by the dimension of the chart.
LATTICE = {1: 12_000, 2: 480, 3: 160}
# The most cells where the game is played many times.
CURVE_CELLS = {1: 3_000, 2: 240, 3: 80}
# Transitions of a lattice that is asked for, at most: the whole game takes up to 200 bytes for each. One that
# is chosen has as many as the task's effort says.
MOST_TRANSITIONS = 2**24
# States from which a plant is stepped to find out how far it moves.
PROBES = 200
# Distances that differ by less than this share of a chart's side are the same.
SAME = 1e-6


def lattice_grid(task: Task, cells: int = 0, most: int | None = None) -> Grid:
    """Returns the nodes of a task's lattice, or of a coarser one if these do not fit into the memory.

    Cells are about square in chart units: where every sample moves the robot by a multiple of some distance
    along a coordinate, and the side of the chart is one, too, samples lead from node to node. On a chart
    of three dimensions, whose coordinates have different units, the sides of the cells are to each other
    as the distances that one sample moves the robot.

    Args:
        task: the robot and its problem.
        cells: cells along the longest side, 0 for the usual number.
        most: if given, no more cells than this.

    Raises:
        BadInput: the chart has more than three dimensions.
    """
    chart, sides = task.chart, task.chart.sides
    if chart.dimension not in LATTICE:
        raise BadInput(f"no lattice has {chart.dimension} dimensions: give a chart of at most 3")
    cells = cells or LATTICE[chart.dimension]
    cells = cells if most is None else min(cells, most)
    hops = probed_hops(task)
    if chart.dimension > 2:
        sides = sides / np.maximum(longest(hops), sides / cells)
    hop_counts, most_of_all = common_hops(task, hops), task.effort.transitions
    while True:
        number = np.maximum(np.round(cells * sides / sides.max()).astype(int), 2)
        # Samples that lead from node to node are worth a change of the number of cells by 40%.
        aligned = np.round(number / hop_counts).astype(int) * hop_counts
        aligned = np.where(np.abs(aligned - number) <= 0.4 * number, aligned, number)
        for counts in (aligned, number):
            grid = Grid(chart, tuple(int(k) for k in counts + ~np.array(chart.periodic)))
            fits = (
                math.prod(grid.counts) <= MOST_NODES
                and transitions(task, grid, hops) <= most_of_all
            )
            if fits or cells <= 2:
                return grid
        cells = int(cells * 0.97)


def curve_grid(task: Task, cells: int = 0) -> Grid:
    """Returns the nodes of a lattice of at most `CURVE_CELLS`, of more where a sample is too short for it."""
    coarse = lattice_grid(task, cells, CURVE_CELLS[task.chart.dimension])
    return coarse if resolves(task, coarse, probed_hops(task)) else lattice_grid(task, cells)


def probed_hops(task: Task) -> np.ndarray:
    """Returns how far one sample moves the robot, from states all over the chart under many inputs.

    If walls stop the robot, this is how far it usually moves: less at a wall, and far out of one.

    Returns:
        Values of each of the m inputs..., `PROBES` states or the usual one, d coordinates.
    """
    low, high = task.input_limits
    m, levels = len(low), task.learning.levels
    # Values of each input. Without an inner loop the distance is linear in the inputs.
    values = levels or ({1: 17, 2: 9, 3: 5}.get(m, 3) if task.has_inner_loop else 2)
    rng, chart = np.random.default_rng(0), task.chart
    z = chart.draw(PROBES, rng)
    if task.abilities.stopped_by_walls:  # outside of them
        z = task.starts(PROBES, rng)
    plant, hops = task.plant(PROBES), []
    for u in product(*np.linspace(low, high, values).T):
        plant.set_state(*task.state(z))
        before = task.z(plant.measurement)
        plant.step(np.tile(u, (PROBES, 1)))
        hops.append(chart.difference(task.z(plant.measurement), before))
    moved = np.array(hops).reshape(*(values,) * m, PROBES, chart.dimension)
    return np.median(moved, axis=-2, keepdims=True) if task.abilities.stopped_by_walls else moved


def aligned_cells(task: Task, cells: int) -> int:
    """Returns the number of square cells along the longest side, near `cells`, that samples cross whole.

    It is `cells` itself if there is none.
    """
    sides, counts = task.chart.sides, common_hops(task, probed_hops(task))
    steps = (sides / counts)[counts > 1]
    for count in sorted(range(cells // 2, 2 * cells), key=lambda n: abs(np.log(n / cells))):
        across = steps / (sides.max() / count)
        if (np.abs(across - np.round(across)) < SAME * count).all() and (across > 0.5).all():
            return count
    return cells


def common_hops(task: Task, hops: np.ndarray) -> np.ndarray:
    """Returns how many of the longest distance that divides all hops a side of the chart holds: (d,) int.

    It is 1 where nothing divides them all, or the chart's side is no multiple of it.
    """
    counts: list[int] = []
    if task.chart.dimension > 2:
        return np.ones(task.chart.dimension, dtype=int)
    flat = hops.reshape(-1, hops.shape[-1])
    for along, side in zip(flat.T, task.chart.sides, strict=True):
        exact = SAME * side
        if (
            task.learning.levels is None
            and np.ptp(along) > exact
            and not task.abilities.stopped_by_walls
        ):
            counts.append(1)  # between its extremes an input leads anywhere
            continue
        step = 0.0
        for value in np.unique(np.abs(along)):
            while value > exact:  # Euclid's algorithm
                step, value = value, abs(step - value * np.round(step / value))
        count = side / step if step else 1.0
        whole = round(count)
        counts.append(whole if abs(count - whole) * step < exact else 1)
    return np.array(counts)


def longest(hops: np.ndarray) -> np.ndarray:
    """Returns the greatest distance (d,) of one sample along each coordinate, from `probed_hops`."""
    return np.asarray(np.abs(hops).reshape(-1, hops.shape[-1]).max(axis=0))


def resolves(task: Task, grid: Grid, hops: np.ndarray) -> bool:
    """Returns whether one sample can move the robot by a cell: otherwise rounding holds it in its place.

    It has to along each coordinate that an episode changes by half a cell, unless nodes are drawn around the
    end of a sample, which is right on average.
    """
    far = longest(hops)
    crosses = far >= grid.spacing * (1 - 1e-6)
    drawn = task.chart.dimension > 2 or task.abilities.stopped_by_walls
    held = (far * task.max_steps >= grid.spacing / 2) & ~crosses
    return bool(crosses.any() and (drawn or not held.any()))


def level_counts(task: Task, grid: Grid, hops: np.ndarray) -> tuple[int, ...]:
    """Returns the number of levels of each input; neighbours of continuous ones lead at most a cell apart."""
    m = len(task.input_limits[0])
    if task.learning.levels is not None:
        return (task.learning.levels,) * m
    counts = []
    for i in range(m):
        steps = np.abs(np.diff(hops, axis=i)).reshape(-1, hops.shape[-1]).max(axis=0)
        reach = steps * (hops.shape[i] - 1)
        counts.append(int(np.ceil((reach / grid.spacing).max() - SAME)) + 1)
    return tuple(counts)


def transitions(task: Task, grid: Grid, hops: np.ndarray) -> int:
    """Returns the number of nodes times that of levels."""
    return math.prod(grid.counts) * math.prod(level_counts(task, grid, hops))
