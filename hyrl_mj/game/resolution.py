"""How fine the lattice of a task is: as many cells as fit into the memory."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from hyrl_mj.sets import MOST_NODES, Grid
from hyrl_mj.tasks import Task

# Cells along the longest side of the game's lattice, by the dimension of the chart.
LATTICE = {1: 12_000, 2: 480, 3: 160}
# The most cells where the game is played many times, or for an estimate.
CURVE_CELLS = {1: 3_000, 2: 240, 3: 80}
# Transitions of the largest lattice: the whole game takes up to 200 bytes for each.
MOST_TRANSITIONS = 2**23
# Share of the cells that is left where a lattice is too large.
FEWER = 0.97
# States from which a plant is stepped to find out how far it moves.
PROBES = 200


def lattice_grid(task: Task, cells: int = 0, most: int | None = None) -> Grid:
    """Returns the nodes of a task's lattice, or of a coarser one if these do not fit into the memory.

    Cells are square in chart units. On a chart of three dimensions, whose coordinates have different units,
    the sides of the cells are to each other as the distances that one sample moves the robot.

    Args:
        task: the robot and its problem.
        cells: cells along the longest side, 0 for the usual number.
        most: if given, no more cells than this.
    """
    cells = cells or LATTICE[task.chart.dimension]
    cells = cells if most is None else min(cells, most)
    hops = corner_hops(task)
    chart, sides = task.chart, task.chart.sides
    if chart.dimension > 2:
        sides = sides / np.maximum(longest(hops), sides / cells)
    while True:
        number = np.maximum(np.round(cells * sides / sides.max()).astype(int), 2)
        grid = Grid(chart, tuple(int(k) for k in number + ~np.array(chart.periodic)))
        nodes = math.prod(grid.counts)
        transitions = nodes * math.prod(level_counts(task, grid, hops))
        if (nodes <= MOST_NODES and transitions <= MOST_TRANSITIONS) or cells <= 2:
            return grid
        cells = int(cells * FEWER)


def corner_hops(task: Task) -> np.ndarray:
    """Returns how far one sample moves the robot under its least and greatest inputs.

    Returns:
        (2,) * m + (`PROBES`, d), from states all over the chart.
    """
    low, high = task.input_limits
    rng, chart = np.random.default_rng(0), task.chart
    z = rng.uniform(chart.low, chart.high, (PROBES, chart.dimension))
    plant, hops = task.plant(PROBES), []
    for u in product(*zip(low, high, strict=True)):
        plant.set_state(*task.state(z))
        before = task.z(plant.measurement)
        plant.step(np.tile(u, (PROBES, 1)))
        hops.append(chart.difference(task.z(plant.measurement), before))
    return np.array(hops).reshape(*(2,) * len(low), PROBES, chart.dimension)


def longest(hops: np.ndarray) -> np.ndarray:
    """Returns the greatest distance (d,) of one sample along each coordinate, from `corner_hops`."""
    return np.asarray(np.abs(hops).reshape(-1, hops.shape[-1]).max(axis=0))


def resolves(task: Task, grid: Grid) -> bool:
    """Returns whether one sample can move the robot by a cell: otherwise rounding holds it in its place."""
    return bool((longest(corner_hops(task)) >= grid.spacing * (1 - 1e-6)).any())


def level_counts(task: Task, grid: Grid, hops: np.ndarray) -> tuple[int, ...]:
    """Returns the number of levels of each input; neighbours of continuous ones lead at most a cell apart."""
    m = len(task.input_limits[0])
    if task.learning.levels is not None:
        return (task.learning.levels,) * m
    counts = []
    for i in range(m):
        reach = np.abs(np.diff(hops, axis=i)).reshape(-1, hops.shape[-1]).max(axis=0)
        counts.append(int(np.ceil((reach / grid.spacing).max() - 1e-9)) + 1)
    return tuple(counts)
