"""Panels of a chart: a plane, or the ring of a periodic coordinate, and the marks on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.patches import Circle, Wedge
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MultipleLocator

from hyrl_mj.errors import BadInput
from hyrl_mj.sets import Chart, Grid, GridSet
from hyrl_mj.tasks import Task
from hyrl_mj.viz.colours import GOOD, GREY, INK, PALE, WHITE
from hyrl_mj.viz.figures.style import angle, axis_label
from hyrl_mj.viz.section import Section

OUTER, INNER, TICK = 1.0, 0.7, 1.05  # radii of a ring, and the ends of its ticks


def is_ring(chart: Chart) -> bool:
    """Returns whether a chart is one periodic coordinate."""
    return chart.periodic == (True,)


def drawable(chart: Chart) -> bool:
    """Returns whether a chart, or a section of it, can be shown as a plane or a ring."""
    return is_ring(chart) or chart.dimension > 1


def check_drawable(task: Task) -> None:
    """Raises `BadInput` unless the task's chart is `drawable`."""
    if not drawable(task.chart):
        name = task.chart.names[0]
        raise BadInput(
            f"the chart of {task.name} has one coordinate, {name}, which is not periodic, so that there is "
            "no plane and no ring to draw: draw its runs, which are shown over time"
        )


def label_axis(axis: Axis, chart: Chart, coordinate: int) -> None:
    """Labels an axis with its coordinate of the chart; a periodic angle in multiples of pi."""
    axis.set_label_text(axis_label(chart, coordinate))
    if chart.units[coordinate] == "rad" and chart.periodic[coordinate]:
        axis.set_major_locator(MultipleLocator(np.pi / 2))
        axis.set_major_formatter(lambda value, _: angle(value))


# ---- planes


def plane(panel: Axes, section: Section) -> None:
    """Makes a panel the plane of a section, with the set-point and the states at which runs fail."""
    (left, bottom), (right, top) = section.chart.low, section.chart.high
    panel.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    label_axis(panel.xaxis, section.chart, 0)
    label_axis(panel.yaxis, section.chart, 1)
    if section.over is not None:
        region(panel, section.over, GREY, PALE, zorder=2.2)
        legend_field(panel, "obstacle, or out of bounds", GREY, PALE)
    if section.set_point is not None:
        cross(panel, *section.set_point)


def region(panel: Axes, members: GridSet, face: str, edge: str | None = None, **looks: Any) -> None:
    """Fills a set in a plane, and draws its outline if that has a colour."""
    grid, inside = members.regular, members.mask
    # The end of a period is no node: there the values are those of its beginning.
    ends = [(0, int(wraps)) for wraps in grid.chart.periodic]
    values = np.pad(members.values.reshape(grid.counts), ends, mode="wrap")
    x, y = (
        low + step * np.arange(count)
        for low, step, count in zip(grid.chart.low, grid.spacing, values.shape, strict=True)
    )
    if inside.any():
        panel.contourf(x, y, values.T, [values.min() - 1, 0], colors=[face], **looks)
    if edge and inside.any() and not inside.all():
        panel.contour(x, y, values.T, [0], colors=[edge], linewidths=1.2, **looks)


def image(panel: Axes, grid: Grid, values: np.ndarray, **looks: Any) -> None:
    """Draws values (N,) of nodes as an image; the nodes of one coordinate as a strip of height 1."""
    half = grid.spacing / 2
    low, high = grid.nodes[0] - half, grid.nodes[-1] + half
    if len(half) == 1:
        low, high = np.append(low, 0.0), np.append(high, 1.0)
    rows, extent = values.reshape(grid.counts[0], -1).T, (low[0], high[0], low[1], high[1])
    panel.imshow(rows, extent=extent, origin="lower", interpolation="nearest", **looks)


def legend_field(panel: Axes, label: str, face: str, edge: str = INK) -> None:
    """Gives the legend a filled field."""
    panel.fill([], [], facecolor=face, edgecolor=edge, linewidth=0.8, label=label)


def words(
    panel: Axes,
    text: str,
    x: float,
    y: float,
    off: tuple[float, float] = (0.0, 0.0),
    colour: str = INK,
) -> None:
    """Writes words at a point, or `off` it [points] to one side, with a white edge."""
    side = "center" if not off[0] else "left" if off[0] > 0 else "right"
    looks: dict[str, Any] = {"color": colour, "ha": side, "va": "center", "zorder": 7}
    looks |= {"textcoords": "offset points", "fontsize": 9.5, "annotation_clip": False}
    looks["path_effects"] = [withStroke(linewidth=2.5, foreground=WHITE)]
    panel.annotate(text, (x, y), off, **looks)


# ---- rings


def ring(panel: Axes, chart: Chart, radii: Sequence[float], note: str = "") -> None:
    """Makes a panel the ring of a periodic coordinate: circles, quarters, and a label with a note."""
    low, period = chart.low[0], chart.sides[0]
    for radius in radii:
        panel.add_patch(Circle((0, 0), radius, fill=False, edgecolor=INK, linewidth=0.8, zorder=3))
    # Quarters of the period, as hours on a clock face.
    for quarter in low + period * np.arange(4) / 4:
        at = np.array(on_ring(chart, quarter))
        panel.plot(*np.outer(at, (OUTER, TICK)), color=INK, linewidth=0.8)
        text = angle(quarter) if chart.units[0] == "rad" else f"{quarter:g}"
        panel.text(1.18 * at[0], 1.18 * at[1], text, ha="center", va="center")
    panel.text(0, 0, axis_label(chart, 0) + note, ha="center", va="center")
    panel.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25), aspect="equal", anchor="S")
    panel.set_axis_off()


def on_ring(chart: Chart, z: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Returns x (n,) and y (n,) on the unit circle of values (n,) of a periodic coordinate."""
    turned = 2 * np.pi * np.asarray(z) / chart.sides[0]
    return np.cos(turned), np.sin(turned)


def arcs(
    panel: Axes, chart: Chart, classes: np.ndarray, colours: Any, outer: float, inner: float
) -> None:
    """Draws classes (N,) of equally spaced values of a periodic coordinate as arcs of a ring.

    The classes are indices into `colours`, where None leaves the ring blank.
    """
    step = 360 / len(classes)  # [degrees]
    origin = 360 * chart.low[0] / chart.sides[0]
    # Arcs begin half-way between nodes of different classes; one class all round has no beginning.
    begins = np.flatnonzero(classes != np.roll(classes, 1))
    ends = np.append(begins[1:], begins[:1] + len(classes))
    if not len(begins):
        begins, ends = np.array([0]), np.array([len(classes)])
    # The shortest arcs last, with an edge, so that even those of a single node can be seen.
    for arc in np.argsort(begins - ends):
        theta = origin + step * (begins[arc] - 0.5), origin + step * (ends[arc] - 0.5)
        colour = colours[classes[begins[arc]]]
        if colour is not None:
            wedge = Wedge((0, 0), outer, *theta, width=outer - inner, color=colour, linewidth=0.8)
            panel.add_patch(wedge)


# ---- marks on planes and rings


def cross(panel: Axes, x: float, y: float) -> None:
    """Marks the set-point."""
    looks: dict[str, Any] = {"markersize": 11, "markeredgewidth": 2.5, "clip_on": False}
    panel.plot(x, y, "+", color=GOOD, zorder=5, label="set-point", **looks)


def set_point_lines(panel: Axes, task: Task, coordinate: int = 0) -> None:
    """Draws the set-point in a panel over time, once a period."""
    if task.set_point is None:
        return
    low, high = panel.get_ylim()
    # A run that turns more often has left the panel.
    turns = np.arange(-9, 10) if task.chart.periodic[coordinate] else np.zeros(1)
    looks: dict[str, Any] = {"linewidth": 1.2, "linestyle": "--", "label": "set-point"}
    for height in task.set_point[coordinate] + task.chart.sides[coordinate] * turns:
        if low <= height <= high:
            panel.axhline(height, color=GOOD, zorder=1, **looks)


def dots(panel: Axes, points: np.ndarray, colour: str = INK) -> None:
    """Marks points (n, 2) of M*, in the panel's coordinates."""
    if not len(points):
        return
    looks: dict[str, Any] = {"markeredgewidth": 0, "clip_on": False, "zorder": 3.5}
    # All white edges first, so that points close to each other merge into one line.
    panel.plot(*points.T, "o", markersize=5.0, color=WHITE, **looks)
    panel.plot(*points.T, "o", markersize=3.6, color=colour, label="critical set M*", **looks)


def spokes(panel: Axes, chart: Chart, z: np.ndarray, start: float, colour: str = INK) -> None:
    """Marks points (n, 1) of M* by lines from radius `start` to the ring's edge."""
    x, y = on_ring(chart, z[:, 0])
    for line, width in ((WHITE, 2.8), (colour, 1.4)):
        ends = [start * x, OUTER * x], [start * y, OUTER * y]
        panel.plot(*ends, color=line, linewidth=width, zorder=3)
    dots(panel, np.stack([start * x, start * y], axis=1), colour)
