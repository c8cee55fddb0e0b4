"""The extended sets of the modes, and where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hyrl_mj.sets import Chart, GridSet
from hyrl_mj.viz.colours import BAD, INK, OVERLAP, mode_colour
from hyrl_mj.viz.figures import charts, style
from hyrl_mj.viz.figures.charts import OUTER
from hyrl_mj.viz.figures.shown import Shown
from hyrl_mj.viz.tables import NAMED

CORE, GAP = 0.6, 0.05  # the inner radius of the innermost ring, and the gap between rings


def draw_extended_sets(shown: Shown) -> Figure:
    """Draws the extended sets and their overlap; in a plane, with an enlargement around M*.

    Where they are more than can be told apart, each has a panel of its own.
    """
    task, sets = shown.task, shown.sets
    charts.check_drawable(task)
    horizon = f", T = {sets.horizon:.2g} s" if sets.horizon else ""
    title = f"extended sets for noise up to eps = {sets.eps:g} {task.noise_on()[1]}{horizon}"
    # The nodes (N,) that several sets hold.
    shared = np.asarray(np.sum([members.mask for members in sets.sets], axis=0) > 1)
    ring = charts.is_ring(task.chart)
    if len(sets.sets) > NAMED and not ring:
        return _draw_each(shown, shared, title)
    enlarged = not ring and len(shown.critical.points) > 0 and sets.eps > 0
    with style.drawing(5.6, shown.section, title) as figure:
        panels = figure.subplots(1, 1 + enlarged, squeeze=False).ravel()
        for i, mode in enumerate(sets.modes):
            label = f"{style.set_label(mode, extended=True)}, of mode {task.mode_name(mode)}"
            colour, tint = mode_colour(i), style.mode_tint(i)
            charts.legend_field(panels[0], label, colour if ring else tint, colour)
        if shared.any():
            charts.legend_field(panels[0], "in several of them", OVERLAP, OVERLAP)
        for panel in panels:
            if ring:
                _set_rings(panel, shown, shared)
            else:
                _set_plane(panel, shown, shared, range(len(sets.sets)))
        if enlarged:
            _enlarge(panels[0], panels[1], shown)
        style.legend(figure)
    return figure


def _draw_each(shown: Shown, shared: np.ndarray, title: str) -> Figure:
    """Draws each set of a plane in a panel of its own, and what of it other sets hold, too (N,)."""
    sets, (width, height) = shown.sets, shown.section.chart.sides
    rows = -(-len(sets.sets) // style.COLUMNS)
    # With labels beside and around.
    panel_height = 0.8 * style.WIDTH / style.COLUMNS * height / width + 0.8
    with style.drawing(1.5 + rows * panel_height, shown.section, title) as figure:
        panels = figure.subplots(rows, style.COLUMNS, squeeze=False).ravel()
        charts.legend_field(panels[0], "in another set, too", OVERLAP, OVERLAP)
        for i, (panel, mode) in enumerate(zip(panels, sets.modes, strict=False)):
            _set_plane(panel, shown, shared & sets.sets[i].mask, [i])
            name = f"{style.set_label(mode, extended=True)}, of mode {shown.task.mode_name(mode)}"
            title = fill(name, 40)  # letters of a line above a panel of two
            panel.set_title(title, color=mode_colour(i), fontweight="bold")
        for panel in panels[len(sets.sets) :]:
            panel.set_axis_off()
        style.legend(figure)
    return figure


def _set_rings(panel: Axes, shown: Shown, shared: np.ndarray) -> None:
    """Draws a ring for each set, with its ends beside it."""
    chart, sets = shown.task.chart, shown.sets
    charts.arcs(panel, chart, shared.astype(int), (None, OVERLAP), OUTER, CORE)
    width = (OUTER - CORE - GAP) / len(sets.sets)
    for i, members in enumerate(sets.sets):
        outer, colour = OUTER - GAP - i * width, mode_colour(i)
        inside = members.mask.astype(int)
        charts.arcs(panel, chart, inside, (None, colour), outer, outer - width + GAP)
        # The first set's ends are written outside the rings, the others' inside, one below the other.
        _ends(panel, chart, members, 1.14 if i == 0 else 0.47 - 0.1 * (i - 1), colour)
    charts.ring(panel, chart, (OUTER, CORE))
    charts.spokes(panel, chart, shown.critical.points, CORE - 0.06)


def _ends(panel: Axes, chart: Chart, members: GridSet, radius: float, colour: str) -> None:
    """Writes the ends of the pieces of a set at a radius of its ring."""
    if members.mask.all():
        return
    for value in np.ravel(members.pieces()):
        x, y = radius * np.array(charts.on_ring(chart, value))
        text = f"{value / np.pi:.2f}π" if chart.units[0] == "rad" else f"{value:.3g}"
        panel.text(x, y, text, color=colour, ha="center", va="center", fontsize=9)


def _set_plane(panel: Axes, shown: Shown, shared: np.ndarray, places: Sequence[int]) -> None:
    """Fills the sets at some places in a plane, with what of them (N,) others hold, too, and outlines."""
    sets = shown.sets.sets
    for i in places:
        charts.region(panel, sets[i], style.mode_tint(i))
    charts.region(panel, GridSet.from_mask(sets[0].grid, shared), OVERLAP)
    for i in places:
        charts.region(panel, sets[i], "none", mode_colour(i), zorder=2)
    charts.plane(panel, shown.section)
    charts.dots(panel, shown.critical.points)


def _enlarge(whole: Axes, near: Axes, shown: Shown) -> None:
    """Shows four noise bounds around M* in the second panel, with the width that noise requires."""
    section, points, eps = shown.section, shown.critical.points, shown.sets.eps
    noise = section.noise(eps)
    around = 4 * np.where(noise > 0, noise, eps)
    low = np.maximum(points.min(axis=0) - around, section.chart.low)
    high = np.minimum(points.max(axis=0) + around, section.chart.high)
    near.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title="around M*")
    box = Rectangle(low, *(high - low), fill=False, edgecolor=INK, linestyle=":", zorder=3)
    whole.add_patch(box)
    for drawn in near.lines:
        drawn.set_clip_on(True)  # marks outside this panel would show beside it
    if not noise.any():  # it acts on other coordinates of the chart
        return
    # The width is drawn at the middle one of M*'s points.
    middle = points[np.argsort(points.sum(axis=1))[len(points) // 2]]
    # Of the noisy coordinates, that across M*.
    axis = int(np.where(noise > 0, np.ptp(points, axis=0), np.inf).argmin())
    step = noise * np.eye(2)[axis]
    ends = np.stack([middle - step, middle + step]).T
    looks: dict[str, Any] = {"color": BAD, "linewidth": 2, "markersize": 9, "zorder": 4}
    name, unit = section.chart.names[axis], section.chart.units[axis]
    label = f"twice the noise on {name}: {2 * noise[axis]:g} {unit}"
    near.plot(*ends, marker="_|"[axis == 0], label=label, **looks)
