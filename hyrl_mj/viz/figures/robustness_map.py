"""The robustness map: what becomes of runs from each state under the worst noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle, Wedge

from hyrl_mj.game import MAP_CLASSES, OVER, UNWINNABLE, Score
from hyrl_mj.sets import Grid
from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures.charts import (
    INNER,
    OUTER,
    TICK,
    Artists,
    arcs,
    dots,
    is_ring,
    patch,
    ring,
    spokes,
)
from hyrl_mj.viz.figures.shown import ShownGame
from hyrl_mj.viz.figures.style import (
    CASING,
    COLUMNS,
    GREY,
    INK,
    WIDTH,
    axis_label,
    drawing,
    head,
    legend,
    mode_colour,
)
from hyrl_mj.viz.tables import NAMES, percent

# Of MAP_CLASSES, in their order; colour-blind readers can tell them apart, too.
CLASS_COLOURS = ("#7cc0e8", "#f2c530", mode_colour(1), "#5c2a6b", GREY)
SENTENCES = dict(enumerate(MAP_CLASSES)) | {
    UNWINNABLE: "not winnable, whatever the controller",
    OVER: "over: obstacle, or the run has ended",
}
# Radius of the dots of M*: inside the ring, where they hide no class.
CRITICAL = 0.6


def draw_robustness_map(shown: ShownGame, path: Path | None = None) -> Figure:
    """Draws a map for each controller: what becomes of runs from each state.

    Args:
        shown: the game, with its maps.
        path: where the PNG and the PDF are written, if anywhere.

    Returns:
        The figure.
    """
    task, result, maps = shown.task, shown.result, shown.maps
    names, grid = result.controllers, maps.grid(task.chart)
    rows = -(-len(names) // COLUMNS)
    columns = min(len(names), COLUMNS)
    with drawing(path, (WIDTH, 1.6 + rows * _panel_height(task))) as figure:
        where, unit = task.noise_on(result.everywhere)
        head(figure, task, f"the worst noise on {where} up to eps = {maps.eps:g} {unit}")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        handles: Artists = {}
        for panel, name in zip(panels, names, strict=False):
            draw = _ring if is_ring(task) else _box
            handles |= draw(panel, shown, grid, maps.map[name])
            _head(panel, name, max(result.scores[name], key=lambda score: score.eps))
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        classes = np.unique(np.concatenate([maps.map[name] for name in names]))
        legend(figure, {SENTENCES[k]: patch(CLASS_COLOURS[k]) for k in classes} | handles)
    return figure


def _panel_height(task: Task) -> float:
    """Returns the height [inches] of a panel with its title and labels."""
    if is_ring(task):
        return 4.1
    sides = np.subtract(task.chart.high, task.chart.low)
    return 1.1 + (float(3.2 * sides[1] / sides[0]) if len(sides) == 2 else 0.5)


def _head(panel: Axes, name: str, score: Score) -> None:
    """Writes the controller and what it wins above its panel."""
    won, won_any = percent(score.won), percent(score.won_any)
    panel.set_title(NAMES.get(name, name), fontsize=11, fontweight="bold", pad=36)
    panel.annotate(
        f"{won} of the winnable starts won,\n"
        + ("from every start mode" if won == won_any else f"{won_any} from every start mode"),
        (0.5, 1),
        xycoords="axes fraction",
        xytext=(0, 6),
        textcoords="offset points",
        ha="center",
    )


def _box(panel: Axes, shown: ShownGame, grid: Grid, classes: np.ndarray) -> Artists:
    """Draws a map as an image over the chart; a chart of one coordinate is a strip of height 1.

    Args:
        panel: to draw on.
        shown: the game.
        grid: of the map.
        classes: (N,) int, indices into `MAP_CLASSES`.

    Returns:
        The legend's entries, without the classes.
    """
    task, chart = shown.task, shown.task.chart
    half, flat = grid.spacing / 2, chart.dimension == 1
    low, high = _corner(chart.low, 0), _corner(chart.high, 1)
    start, end = _corner(task.start_low, 0), _corner(task.start_high, 1)
    first, last = _corner(grid.nodes[0] - half, 0), _corner(grid.nodes[-1] + half, 1)
    panel.imshow(
        classes.reshape(grid.counts[0], -1).T,
        cmap=ListedColormap(CLASS_COLOURS),
        vmin=-0.5,
        vmax=len(CLASS_COLOURS) - 0.5,
        extent=(first[0], last[0], first[1], last[1]),
        origin="lower",
        interpolation="nearest",
        aspect=0.12 * (high[0] - low[0]) if flat else "equal",
    )
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel=axis_label(task, 0))
    panel.set(yticks=[]) if flat else panel.set(ylabel=axis_label(task, 1))
    sides = end[0] - start[0], end[1] - start[1]
    for colour, width in CASING:
        box = Rectangle(
            start, *sides, fill=False, edgecolor=colour, linewidth=width, clip_on=False, zorder=3
        )
        panel.add_patch(box)
    z = shown.critical.points
    points = dots(panel, np.hstack([z, np.full_like(z, 0.5)]) if flat else z)
    return {"start region": box} | points


def _corner(ends: Sequence[float], side: float) -> tuple[float, float]:
    """Returns a corner (d,) of a chart as a point of the figure's plane."""
    return float(ends[0]), float(ends[1]) if len(ends) > 1 else side


def _ring(panel: Axes, shown: ShownGame, grid: Grid, classes: np.ndarray) -> Artists:
    """Draws a map over a periodic coordinate as arcs of a ring; arguments and result as of `_box`."""
    task = shown.task
    arcs(panel, task, classes, CLASS_COLOURS)
    ring(panel, task, (OUTER, INNER))
    handles: Artists = {}
    period = task.chart.high[0] - task.chart.low[0]
    first, last = (360 * corner[0] / period for corner in (task.start_low, task.start_high))
    if last - first < 360 - 360 / len(classes):
        handles["start region"] = panel.add_patch(
            Wedge((0, 0), TICK, first, last, width=0.03, color=INK, linewidth=0)
        )
    return handles | spokes(panel, task, shown.critical.points[:, 0], CRITICAL, OUTER)
