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
from hyrl_mj.viz.figures import charts, paths, style
from hyrl_mj.viz.figures.charts import INNER, OUTER
from hyrl_mj.viz.figures.shown import ShownPolicy

# Nodes at which the policy is evaluated: of a ring, and along the longest side of a plane.
RING_NODES, PLANE_CELLS = 720, 240
INPUT_COLOURS = "PRGn"


def draw_policy_map(shown: ShownPolicy, path: Path | None = None) -> Figure:
    """Draws a map of each input of the policy, and the policy's runs from the paper's starts.

    Raises:
        BadInput: the chart is neither a plane nor a ring.
    """
    task = shown.task
    charts.check_drawable(task)
    with style.drawing(path, 5.2, task, f"the {shown.algorithm} policy") as figure:
        *maps, panel = figure.subplots(1, len(task.inputs) + 1)
        for i, input_panel in enumerate(maps):
            _input_map(input_panel, shown, i)
        _paper_runs(panel, shown)
        style.legend(figure, by_label=True)
    return figure


def _paper_runs(panel: Axes, shown: ShownPolicy) -> None:
    """Draws the runs from the paper's starts."""
    task, ring = shown.task, charts.is_ring(shown.task)
    label = style.noise_label(task, shown.paper[0].noise, shown.paper[0].bound)
    panel.set_title(label.replace(", ", ",\n"))
    if ring:
        panel.set(xlim=(0, task.scene.time))
        view = paths.time_view(panel, task, 0)
    else:
        charts.plane(panel, task)
        view = paths.plane_view(task)
    for arc in shown.paper:
        paths.chosen_way(panel, task, view, arc, linewidth=2.0)
        paths.ends(panel, task, view, arc)
    if ring:
        charts.set_point_lines(panel, task, 0)


def _input_map(panel: Axes, shown: ShownPolicy, i: int) -> None:
    """Draws the map of an input, measured without noise, with its colour bar."""
    task, ring, chart = shown.task, charts.is_ring(shown.task), shown.task.chart
    colours, scale, ticks = _input_colours(task, i)
    grid = Grid(chart, (RING_NODES,)) if ring else Grid.with_cells(chart, PLANE_CELLS)
    values = shown.policy.act(charts.measured_at(task, grid.nodes))[:, i]
    if ring:
        shades, classes = np.unique(colours(scale(values)), axis=0, return_inverse=True)
        charts.arcs(panel, task, classes.ravel(), shades)
        charts.ring(panel, task, (OUTER, INNER))
        charts.spokes(panel, task, shown.critical, 0.6, style.RED)
    else:
        charts.image(panel, grid, values, cmap=colours, norm=scale)
        charts.plane(panel, task)
        charts.dots(panel, shown.critical.points, style.RED)
    # After the ring, whose place in the panel the colour bar sets.
    bar = panel.figure.colorbar(
        ScalarMappable(scale, colours),
        ax=panel, location="right", shrink=0.7, aspect=20, ticks=ticks,
    )  # fmt: skip
    bar.set_label(style.input_label(task, i))


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
