"""The policy map: the input that the stage-1 policy gives at each measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure

from hyrl_mj.sets import Grid
from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures.charts import (
    INNER,
    OUTER,
    Artists,
    angles_on,
    arcs,
    check_drawable,
    dots,
    is_ring,
    measured_at,
    plane,
    ring,
    set_point_lines,
    spokes,
)
from hyrl_mj.viz.figures.paths import View, chosen_way, ends, plane_view, time_view
from hyrl_mj.viz.figures.shown import ShownPolicy
from hyrl_mj.viz.figures.style import (
    RED,
    WIDTH,
    axis_label,
    drawing,
    head,
    input_label,
    legend,
    noise_label,
)

# Nodes at which the policy is evaluated: of a ring, and along the longest side of a plane.
RING_NODES, PLANE_CELLS = 720, 240
INPUT_COLOURS = "PRGn"


def draw_policy_map(shown: ShownPolicy, path: Path | None = None) -> Figure:
    """Draws a map of each input of the policy, and the policy's runs from the paper's starts.

    Args:
        shown: has a chart that is a plane or a ring.
        path: where the PNG and the PDF are written, if anywhere.

    Returns:
        The figure.

    Raises:
        BadInput: the chart is neither a plane nor a ring.
    """
    task = shown.task
    check_drawable(task)
    with drawing(path, (WIDTH, 5.2)) as figure:
        head(figure, task, f"the {shown.algorithm} policy")
        *maps, panel = figure.subplots(1, len(task.inputs) + 1)
        handles: Artists = {}
        for i, input_panel in enumerate(maps):
            draw = _input_ring if is_ring(task) else _input_plane
            handles |= draw(input_panel, shown, i)
        legend(figure, handles | _paper_runs(panel, shown))
    return figure


def _paper_runs(panel: Axes, shown: ShownPolicy) -> Artists:
    """Draws the runs from the paper's starts beside the maps; returns the legend's entries."""
    task = shown.task
    label = noise_label(task, shown.paper[0].noise, shown.paper[0].bound)
    panel.set_title(label.replace(", ", ",\n"))
    view = _over_time(panel, task) if is_ring(task) else plane_view(task)
    fixed = {} if is_ring(task) else plane(panel, task)
    ways: Artists = {}
    marks: Artists = {}
    for arc in shown.paper:
        way, drawn = chosen_way(panel, task, view, arc, linewidth=2.0)
        ways[way] = drawn
        marks |= ends(panel, task, view, arc)
    if is_ring(task):
        fixed |= set_point_lines(panel, task, 0)
    return fixed | dict(sorted(ways.items())) | marks


def _over_time(panel: Axes, task: Task) -> View:
    """Makes a panel one of the chart's only coordinate over time."""
    panel.set(xlabel="time [s]", ylabel=axis_label(task, 0), xlim=(0, task.scene.time))
    angles_on(panel.yaxis, task, 0)
    return time_view(0)


def _input_plane(panel: Axes, shown: ShownPolicy, i: int) -> Artists:
    """Draws the map of an input over a plane; returns the legend's entries."""
    task = shown.task
    colours, scale, _ = _input_colours(task, i)
    grid = Grid.with_cells(task.chart, PLANE_CELLS)
    half = grid.spacing / 2
    (left, bottom), (right, top) = grid.nodes[0] - half, grid.nodes[-1] + half
    panel.imshow(
        _input_at(shown, grid.nodes, i).reshape(grid.counts).T,
        cmap=colours, norm=scale, extent=(left, right, bottom, top),
        origin="lower", interpolation="nearest",
    )  # fmt: skip
    _bar(panel, task, i)
    return plane(panel, task) | dots(panel, shown.critical.points, RED)


def _input_ring(panel: Axes, shown: ShownPolicy, i: int) -> Artists:
    """Draws the map of an input as a ring; returns the legend's entries."""
    task = shown.task
    colours, scale, _ = _input_colours(task, i)
    u = _input_at(shown, Grid(task.chart, (RING_NODES,)).nodes, i)
    shades, classes = np.unique(colours(scale(u)), axis=0, return_inverse=True)
    arcs(panel, task, classes.ravel(), shades)
    ring(panel, task, (OUTER, INNER))
    _bar(panel, task, i)
    return spokes(panel, task, shown.critical.points[:, 0], 0.6, OUTER, colour=RED)


def _input_at(shown: ShownPolicy, z: np.ndarray, i: int) -> np.ndarray:
    """Returns input i (n,) of the policy at chart points (n, d), measured without noise."""
    return shown.policy.act(measured_at(shown.task, z))[:, i]


def _input_colours(task: Task, i: int) -> tuple[Colormap, Normalize, np.ndarray | None]:
    """Returns the colours of an input, their scale, and the ticks of a discrete input."""
    low, high = (float(limit[i]) for limit in task.input_limits)
    # Without the darkest shades, on which no other mark can be seen.
    shades = ListedColormap(colormaps[INPUT_COLOURS](np.linspace(0.08, 0.92, 256)))
    if task.input_levels is None:
        return shades, Normalize(low, high), None
    levels = np.unique(task.input_levels[:, i])
    half = (levels[1] - levels[0]) / 2
    bounds = np.append(levels - half, high + half)
    colours = ListedColormap(shades(np.linspace(0, 1, len(levels))))
    return colours, BoundaryNorm(bounds, len(levels)), levels


def _bar(panel: Axes, task: Task, i: int) -> None:
    """Puts the colour bar of an input beside its map."""
    colours, scale, ticks = _input_colours(task, i)
    scalars = ScalarMappable(scale, colours)
    bar = panel.figure.colorbar(
        scalars, ax=panel, location="right", shrink=0.7, aspect=20, ticks=ticks
    )
    bar.set_label(input_label(task, i))
