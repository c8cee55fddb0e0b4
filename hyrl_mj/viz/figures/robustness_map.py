"""The robustness map: what becomes of runs from each state under the worst noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, NoNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle, Wedge

from hyrl_mj.game import MAP_CLASSES, OVER, UNWINNABLE, Score
from hyrl_mj.sets import Grid
from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures import charts, style
from hyrl_mj.viz.figures.charts import INNER, OUTER, TICK
from hyrl_mj.viz.figures.shown import ShownGame
from hyrl_mj.viz.tables import NAMES, percent

# Of MAP_CLASSES, in their order; colour-blind readers can tell them apart, too.
CLASS_COLOURS = ("#7cc0e8", "#f2c530", style.mode_colour(1), "#5c2a6b", style.GREY)
SENTENCES = dict(enumerate(MAP_CLASSES)) | {
    UNWINNABLE: "not winnable, whatever the controller",
    OVER: "over: obstacle, or the run has ended",
}
# Radius of the dots of M*: inside the ring, where they hide no class.
CRITICAL = 0.6


def draw_robustness_map(shown: ShownGame, path: Path | None = None) -> Figure:
    """Draws a map for each controller: what becomes of runs from each state."""
    task, result, maps = shown.task, shown.result, shown.maps
    names, grid = result.controllers, maps.grid(task.chart)
    columns = min(len(names), style.COLUMNS)
    rows = -(-len(names) // style.COLUMNS)
    draw = _ring if charts.is_ring(task) else _box
    where, unit = task.noise_on(result.everywhere)
    title = f"the worst noise on {where} up to eps = {maps.eps:g} {unit}"
    with style.drawing(path, 1.6 + rows * _panel_height(task), task, title) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for k in np.unique(np.concatenate([maps.map[name] for name in names])):
            charts.legend_field(panels[0], SENTENCES[k], CLASS_COLOURS[k])
        for panel, name in zip(panels, names, strict=False):
            draw(panel, shown, grid, maps.map[name])
            _head(panel, name, max(result.scores[name], key=lambda score: score.eps))
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        style.legend(figure)
    return figure


def _panel_height(task: Task) -> float:
    """Returns the height [inches] of a panel with its title and labels."""
    if charts.is_ring(task):
        return 4.1
    sides = task.chart.sides
    return 1.1 + (float(3.2 * sides[1] / sides[0]) if len(sides) == 2 else 0.5)


def _head(panel: Axes, name: str, score: Score) -> None:
    """Writes the controller and what it wins above its panel."""
    won, won_any = percent(score.won), percent(score.won_any)
    panel.set_title(NAMES.get(name, name), fontsize=11, fontweight="bold", pad=36)
    every = "from every start mode" if won == won_any else f"{won_any} from every start mode"
    style.note_above(panel, f"{won} of the winnable starts won,\n{every}", 0.5, 6)


def _box(panel: Axes, shown: ShownGame, grid: Grid, classes: np.ndarray) -> None:
    """Draws classes (N,) of nodes as an image over the chart; one coordinate is a strip of height 1."""
    task, chart = shown.task, shown.task.chart
    strip = chart.dimension == 1
    charts.image(panel, grid, classes, cmap=ListedColormap(CLASS_COLOURS), norm=NoNorm())
    low, high = _corner(chart.low, 0), _corner(chart.high, 1)
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel=style.axis_label(task, 0))
    if strip:
        panel.set(yticks=[], aspect=0.12 * chart.sides[0])
    else:
        panel.set(ylabel=style.axis_label(task, 1))
    start = _corner(task.start_low, 0)
    sides = np.subtract(_corner(task.start_high, 1), start)
    for colour, width in style.CASING:
        looks: dict[str, Any] = {"edgecolor": colour, "linewidth": width, "clip_on": False}
        box = Rectangle(start, *sides, fill=False, zorder=3, label="start region", **looks)
        panel.add_patch(box)
    z = shown.critical.points
    charts.dots(panel, np.hstack([z, np.full_like(z, 0.5)]) if strip else z)


def _corner(ends: Sequence[float], side: float) -> tuple[float, float]:
    """Returns a corner (d,) of a chart as a point of the figure's plane."""
    return float(ends[0]), float(ends[1]) if len(ends) > 1 else side


def _ring(panel: Axes, shown: ShownGame, grid: Grid, classes: np.ndarray) -> None:
    """Draws classes (N,) of nodes as arcs of a ring."""
    task = shown.task
    charts.arcs(panel, task, classes, CLASS_COLOURS)
    charts.ring(panel, task, (OUTER, INNER))
    ends = task.start_low[0], task.start_high[0]
    first, last = (360 * end / task.chart.sides[0] for end in ends)  # [degrees]
    if last - first < 360 - 360 / len(classes):
        looks: dict[str, Any] = {"width": 0.03, "color": style.INK, "linewidth": 0}
        panel.add_patch(Wedge((0, 0), TICK, first, last, label="start region", **looks))
    charts.spokes(panel, task, shown.critical, CRITICAL)
