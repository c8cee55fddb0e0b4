"""Runs as paths in a panel: in the plane of a chart, over time, or as spirals on a ring."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox, TransformedBbox

from hyrl_mj.sets import Chart
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import ANY, Task, pattern_of
from hyrl_mj.viz.colours import BAD, INK, PALE, POLICY, WHITE, mode_colour
from hyrl_mj.viz.figures import charts, style
from hyrl_mj.viz.figures.shown import Shown
from hyrl_mj.viz.section import Section
from hyrl_mj.viz.tables import NAMED

CORE = 0.4  # the radius at which spirals begin; they end at 1
# How far beside a panel marks are drawn, in parts of it: that of an end just out of bounds is, but not one of
# a robot that was thrown far off, whose path is cut at the edge.
SHOWN = Bbox.unit().padded(0.05)


@dataclass(frozen=True)
class View:
    """Where runs lie in a panel.

    Attributes:
        points: (times (N,) [s], chart points (N, d)) -> points of the panel (N, 2).
        longest: (2,) a longer step crosses the seam of a periodic coordinate and is not drawn.
    """

    points: Callable[[np.ndarray, np.ndarray], np.ndarray]
    longest: np.ndarray | float = np.inf


def plane_view(panel: Axes, section: Section) -> View:
    """Makes a panel the plane of a section."""
    chart = section.chart
    charts.plane(panel, section)
    longest = np.where(chart.periodic, chart.sides / 2, np.inf)
    return View(lambda t, z: chart.wrap(z[..., :2]), longest)


def view_of(panel: Axes, section: Section, coordinate: int, flat: bool) -> View:
    """Makes a panel the plane of a section, or not `flat` a coordinate of the whole chart over time."""
    if flat:
        return plane_view(panel, section)
    panel.set_xlabel("time [s]")
    charts.label_axis(panel.yaxis, section.task.chart, coordinate)
    style.grid_lines(panel)
    return View(lambda t, z: np.stack([t, z[:, coordinate]], axis=1))


def spiral_view(chart: Chart, horizon: float) -> View:
    """Returns the view of a periodic coordinate as an angle; time goes outward to the horizon [s]."""

    def points(t: np.ndarray, z: np.ndarray) -> np.ndarray:
        radius = CORE + (1 - CORE) * t / horizon
        return np.stack(charts.on_ring(chart, z[:, 0]), axis=1) * radius[:, None]

    return View(points)


def line(panel: Axes, view: View, t: np.ndarray, z: np.ndarray, **looks: Any) -> Line2D:
    """Draws a path: times (N,) [s], chart points (N, d)."""
    points = view.points(t, z)
    gaps = (np.abs(np.diff(points, axis=0)) > view.longest).any(axis=1)
    x, y = np.insert(points, np.flatnonzero(gaps) + 1, np.nan, axis=0).T
    (drawn,) = panel.plot(x, y, **looks)
    return drawn


def mark(panel: Axes, view: View, arc: HybridArc, row: int, shape: Any, **looks: Any) -> None:
    """Marks a row of an arc with one of matplotlib's markers."""
    ((x, y),) = view.points(arc.t[[row]], arc.z[[row]])
    looks = {"markersize": 6, "zorder": 6} | looks
    (drawn,) = panel.plot([x], [y], marker=shape, linestyle="none", **looks)
    drawn.set_clip_box(TransformedBbox(SHOWN, panel.transAxes))


def ends(panel: Axes, task: Task, view: View, arc: HybridArc) -> None:
    """Marks where a run starts and ends."""
    mark(panel, view, arc, 0, "o", markerfacecolor=WHITE, markeredgecolor=INK, label="start")
    end(panel, task, view, arc)


def end(panel: Axes, task: Task, view: View, arc: HybridArc, beside: bool = False) -> None:
    """Marks where a run ends, in red if it has failed; how it ends tells the legend, or words `beside` it."""
    label, colour = ("end", INK) if arc.arrives(task) else ("end: off the set-point", PALE)
    if arc.outcome != "reached":
        label, colour = f"end: {arc.outcome.replace('_', ' ')}", BAD
        if arc.outcome == "running":
            label = "end, not there yet"
    if beside:
        ((x, y),) = view.points(arc.t[[-1]], arc.z[[-1]])
        inner = x > np.mean(panel.get_xlim())
        if not SHOWN.contains(*(panel.transData - panel.transAxes).transform((x, y))):
            return
        left = inner == panel.axison  # where there is room: of a ring that is outside
        charts.words(panel, label.removeprefix("end: "), x, y, (-7 if left else 7, 10), colour)
    mark(panel, view, arc, -1, "x", color=colour, markeredgewidth=2, label="" if beside else label)


def chosen_way(
    panel: Axes,
    shown: Shown,
    view: View,
    arc: HybridArc,
    same: str = "",
    **looks: Any,
) -> Line2D:
    """Draws a policy's run in the colour of the mode whose way it goes, else grey; `same` labels all."""
    task, modes = shown.task, shown.partition.modes
    going = modes_of(task, modes, int(task.direction(arc.z[:, None])[0]))
    if arc.outcome != "reached":
        colour = PALE if same else POLICY
        label = "neither way" if len(modes) < 3 else "no way to the end"
    elif len(going) == 1:
        mode = going[0]
        colour = mode_colour(modes.index(mode))
        label = f"way of mode {task.mode_name(mode)}"
    else:
        colour, label = PALE, "nothing to decide" if going else "way of no mode"
    looks["label"] = same or label
    return line(panel, view, arc.t, arc.z, color=colour, **looks)


def modes_of(task: Task, modes: Sequence[int], way: int) -> list[int]:
    """Returns which of a run's modes a way belongs to: `way` as `Task.direction` numbers it.

    A way along which some obstacle is passed on either side belongs to several.
    """
    if way in modes or way < 0:
        return [mode for mode in modes if way in (mode, ANY)]
    if task.gives_direction:
        return []
    number = len(task.obstacles)
    pattern = pattern_of(way, number)
    patterns = np.array([pattern_of(mode, number) for mode in modes])
    agree = (patterns == pattern) | (patterns == ANY) | (pattern == ANY)
    return [mode for mode, fits in zip(modes, agree.all(axis=1), strict=True) if fits]


def hybrid_way(panel: Axes, task: Task, view: View, arc: HybridArc, modes: Sequence[int]) -> None:
    """Draws a run of the hybrid controller in the colours of its modes, with marks at its jumps."""
    for j in range(arc.j[-1] + 1):
        rows = arc.j == j
        mode = int(arc.q[rows][0])
        looks = {
            "color": mode_colour(modes.index(mode)),
            "label": f"HyRL in mode {task.mode_name(mode)}",
        }
        line(panel, view, arc.t[rows], arc.z[rows], linewidth=2.0, **looks)
    for row in np.flatnonzero(np.diff(arc.j)).tolist():
        # Small and on top, so that a jump at the start shows in its circle.
        mark(panel, view, arc, row, "D", color=INK, markersize=3.5, zorder=7, label="jump")


def draw_runs(shown: Shown) -> Figure:
    """Draws the hybrid controller and the policy under the same noise, a column for each start mode.

    Of a chart with two coordinates the paths are shown in its plane, at most four beside each other; else
    each coordinate over time.
    Only the scene's starts ("start0", ...) are drawn.
    """
    task, replays, policy_title = shown.task, shown.replays, shown.policy_title
    loops = list(dict.fromkeys(who for _, who in replays if who != "policy"))
    starts = list(dict.fromkeys(start for start, _ in replays if start.startswith("start")))
    plane, count = task.chart.dimension == 2, len(loops)
    rows = -(-count // 4) if plane else task.chart.dimension
    columns = -(-count // rows) if plane else count
    first = replays[starts[0], "policy"]
    noise = style.noise_label(task, first.noise, first.bound)
    title = f"HyRL and {policy_title}\nunder the same {noise}"
    thin = {"color": POLICY, "linewidth": 1.0, "zorder": 4}
    with style.drawing(1.6 + 3.4 * rows, task, title) as figure:
        panels = figure.subplots(rows, columns, sharex=True, sharey="row", squeeze=False)
        for (row, column), panel in np.ndenumerate(panels):
            coordinate, loop = (0, row * columns + column) if plane else (row, column)
            if loop >= count:
                panel.set_axis_off()
                continue
            view = view_of(panel, shown.section, coordinate, plane)
            for start in starts:
                hybrid, policy = replays[start, loops[loop]], replays[start, "policy"]
                hybrid_way(panel, task, view, hybrid, shown.sets.modes)
                ends(panel, task, view, hybrid)
                line(panel, view, policy.t, policy.z, label=policy_title, **thin)
                ends(panel, task, view, policy)
            if not plane:
                charts.set_point_lines(panel, task, coordinate)
            if coordinate == 0:
                mode = int(loops[loop].removeprefix("hyrl_q"))
                name = task.mode_name(mode) if count <= NAMED else mode
                panel.set_title(f"started in q0 = {name}", fontweight="bold")
            panel.label_outer()
        style.legend(figure, by_label=True)
    return figure
