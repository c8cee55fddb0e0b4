"""The figures of the stage-1 policy: where it goes without noise and with it, and a map of its inputs."""

from __future__ import annotations

from textwrap import fill

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages import Partition
from hyrl_mj.tasks import Outcome, Task
from hyrl_mj.viz.colours import BAD, INK, MODES, OBSERVED, OPEN, PALE, POLICY
from hyrl_mj.viz.figures import charts, runs, style
from hyrl_mj.viz.figures.charts import INNER, OUTER
from hyrl_mj.viz.figures.runs import CORE, View
from hyrl_mj.viz.figures.shown import Shown
from hyrl_mj.viz.section import Section

# Words are about three times as wide as high: how far off they keep from what is drawn, along x and y.
LABEL = np.array([3.0, 1.0])
ENDS = {
    Outcome.RUNNING: OPEN,
    Outcome.REACHED: PALE,
    Outcome.CRASHED: BAD,
    Outcome.OUT_OF_BOUNDS: MODES[1],
    Outcome.STALLED: MODES[0],
    Outcome.UNSTABLE: INK,
}


def draw_overview(shown: Shown) -> Figure:
    """Draws the ways that the policy goes without noise, and a run that noise leads astray."""
    task, arc = shown.task, shown.noisy
    charts.check_drawable(task)
    title = f"the {shown.algorithm} policy, and where noise leads it"
    with style.drawing(7.6, shown.section, title) as figure:
        panel = figure.subplots()
        panel.set_title(style.noise_label(task, arc.noise, arc.bound))
        if charts.is_ring(task.chart):
            _spirals(panel, shown)
        else:
            _field(panel, shown)
        style.legend(figure)
    return figure


def _field(panel: Axes, shown: Shown) -> None:
    """Draws the overview of a plane."""
    section, partition, arc = shown.section, shown.partition, shown.noisy
    owners = _owners(partition)
    for i in range(len(partition.modes)):
        part = GridSet.from_mask(partition.grid, owners == i)
        charts.region(panel, part, style.mode_tint(i))
    view = runs.plane_view(panel, section)
    _noiseless_runs(panel, shown, view)
    band = _band(view.points(arc.t, arc.z), section.noise(arc.bound), view.longest)
    panel.add_collection(PolyCollection(list(band), color=OBSERVED, linewidth=0.3, zorder=2))
    _noisy_run(panel, shown, view)
    ahead = arc.z[-1] - arc.z[0]
    triangle = (3, 0, float(np.degrees(np.arctan2(ahead[1], ahead[0]))) - 90)
    looks = {"markersize": 13, "markerfacecolor": PALE, "markeredgecolor": INK}
    runs.mark(panel, view, arc, 0, triangle, **looks)
    charts.dots(panel, shown.critical.points)
    _name_parts(panel, shown, owners)


def _name_parts(panel: Axes, shown: Shown, owners: np.ndarray) -> None:
    """Writes the name of each mode where its part, of `owners` (N,), has the most room in the plane."""
    section, partition, arc = shown.section, shown.partition, shown.noisy
    chart, nodes = section.chart, partition.grid.nodes
    paths = [*(one.z for one in shown.noiseless), arc.z, shown.task.z(arc.measured[:-1])]
    drawn = np.vstack([*(chart.wrap(z[:, :2]) for z in paths), nodes[section.failed(nodes)]])
    room = (np.minimum(nodes - chart.low, chart.high - nodes) / LABEL).min(axis=1)
    for i, mode in enumerate(partition.modes):
        own = owners == i
        others = cKDTree(np.vstack([drawn, nodes[~own]]) / LABEL)
        at = nodes[np.argmax(np.minimum(room, others.query(nodes / LABEL)[0]) * own)]
        if own.any():
            charts.words(panel, _part_label(shown.task, mode), *at)
            # In parts that are smaller than words these keep off each other.
            room = np.minimum(room, np.linalg.norm((nodes - at) / LABEL, axis=1) / 4)


def _part_label(task: Task, mode: int) -> str:
    """Returns what stands in the part of a mode, in short lines: "M₀, mode 0 (left)"."""
    text = f"{style.set_label(mode)}, mode {task.mode_name(mode)}"
    return fill(text, 24, break_on_hyphens=False)


def _owners(partition: Partition) -> np.ndarray:
    """Returns the part (N,) int that alone holds each node, or the number of parts where several do."""
    held = np.stack([part.mask for part in partition.parts])
    return np.where(held.sum(axis=0) == 1, held.argmax(axis=0), len(held))


def _band(z: np.ndarray, eps: np.ndarray, longest: np.ndarray | float) -> np.ndarray:
    """Returns quadrilaterals (k, 4, 2) that cover a path (K, 2) and all points within +-eps (2,) of it.

    A box that moves along a straight line covers itself and the area that its two diagonals sweep. Steps
    longer than `longest` cross the seam of a periodic chart.
    """
    steps = (np.abs(np.diff(z, axis=0)) <= longest).all(axis=1)
    a, b = z[:-1][steps], z[1:][steps]
    corners = [np.array(signs) * eps for signs in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    boxes = np.stack([z + corner for corner in corners], axis=1)
    swept = [np.stack([a - c, a + c, b + c, b - c], axis=1) for c in corners[:2]]
    return np.concatenate([boxes, *swept])


def _spirals(panel: Axes, shown: Shown) -> None:
    """Draws the overview of a ring, time outward."""
    task, partition, arc = shown.task, shown.partition, shown.noisy
    seconds = task.scene.time
    tints = [style.mode_tint(i) for i in range(len(partition.modes))]
    owners = _owners(partition)
    charts.arcs(panel, task.chart, owners, [*tints, None], OUTER, CORE)
    charts.ring(panel, task.chart, (OUTER, CORE), f",\ntime outward:\n0 to {seconds:g} s")
    view = runs.spiral_view(task.chart, seconds)
    _noiseless_runs(panel, shown, view)
    eps = task.noise_in_chart(arc.bound)
    rim = np.vstack([view.points(arc.t, arc.z - eps), view.points(arc.t, arc.z + eps)[::-1]])
    panel.fill(*rim.T, color=OBSERVED, linewidth=0, zorder=2)
    _noisy_run(panel, shown, view)
    if task.set_point is not None:
        charts.cross(panel, *np.ravel(charts.on_ring(task.chart, task.set_point)))
    charts.spokes(panel, task.chart, shown.critical.points, CORE - 0.06)
    for i, mode in enumerate(partition.modes):
        # Where it is farthest to the other parts.
        if (own := owners == i).any():
            at = partition.grid.nodes[GridSet.from_mask(partition.grid, own).values.argmin()]
            x, y = 0.88 * np.ravel(charts.on_ring(task.chart, at))  # outside most runs
            charts.words(panel, _part_label(task, mode), x, y)


def _noiseless_runs(panel: Axes, shown: Shown, view: View) -> None:
    """Draws the runs without noise, with an arrowhead after a seventh of their samples."""
    looks = {"linewidth": 1.3, "zorder": 3}
    label = "policy without noise, in the colour of the mode it follows"
    for arc in shown.noiseless:
        drawn = runs.chosen_way(panel, shown, view, arc, label, **looks)
        row = len(arc.t) // 7
        points = view.points(arc.t[row : row + 2], arc.z[row : row + 2])
        if len(points) < 2 or (np.abs(points[1] - points[0]) > view.longest).any():
            continue  # the run ends where it starts, or crosses the seam at this sample
        arrow = {"arrowstyle": "-|>", "mutation_scale": 11, "shrinkA": 0, "shrinkB": 0}
        arrow["color"] = drawn.get_color()
        panel.annotate("", points[1], points[0], arrowprops=arrow, zorder=3)


def _noisy_run(panel: Axes, shown: Shown, view: View) -> None:
    """Draws the run under noise and what it measures."""
    task, arc = shown.task, shown.noisy
    looks = {"color": POLICY, "linewidth": 1.4, "zorder": 4}
    label = f"{shown.policy_title} with noise, and what it can observe"
    charts.legend_field(panel, label, OBSERVED, OBSERVED)
    runs.line(panel, view, arc.t, arc.z, label=label, **looks)
    looks = {"linestyle": "none", "marker": ".", "color": BAD, "markersize": 4, "zorder": 4.5}
    measured = task.z(arc.measured[:-1])
    runs.line(panel, view, arc.t[:-1], measured, **looks)
    runs.end(panel, task, view, arc, beside=True)


# ---- where it does not arrive


def draw_arrivals(task: Task, starts: np.ndarray, outcomes: np.ndarray) -> Figure:
    """Draws starts (n, d) of episodes without noise, in the colour of how each ends: `outcomes` (n,)."""
    charts.check_drawable(task)
    section = Section(task)
    with style.drawing(6.4, task, "from where the policy arrives without noise") as figure:
        panel = figure.subplots()
        if charts.is_ring(task.chart):
            charts.ring(panel, task.chart, (OUTER, INNER))
            radii = np.linspace(INNER, OUTER, len(starts))  # side by side, so that each is seen
            points = radii[:, None] * np.stack(charts.on_ring(task.chart, starts[:, 0]), axis=1)
        else:
            charts.plane(panel, section)
            points = section.chart.wrap(starts[:, :2])
        for outcome in np.unique(outcomes):  # failures above
            of = outcomes == outcome
            end = Outcome(int(outcome))
            label = f"{end.label.replace('_', ' ')} ({of.sum():,})"
            panel.plot(*points[of].T, ".", color=ENDS[end], label=label, zorder=3)
        style.legend(figure)
    return figure


# ---- the map of the inputs


def draw_policy_map(shown: Shown) -> Figure:
    """Draws a map of each input of the policy, and the policy's runs from the scene's starts."""
    task, section = shown.task, shown.section
    charts.check_drawable(task)
    chart, cells = section.chart, 240  # along the longest side of a map
    with style.drawing(5.2, section, f"the {shown.algorithm} policy") as figure:
        *maps, panel = figure.subplots(1, len(task.inputs) + 1)
        ring = charts.is_ring(chart)
        grid = Grid(chart, (720,)) if ring else Grid.with_cells(chart, cells)
        inputs = shown.policy.act(task.at(section.lift(grid.nodes)))
        for i, input_panel in enumerate(maps):
            _input_map(input_panel, shown, grid, inputs, i)
        _paper_runs(panel, shown)
        style.legend(figure, by_label=True)
    return figure


def _paper_runs(panel: Axes, shown: Shown) -> None:
    """Draws the runs from the scene's starts."""
    task, first = shown.task, shown.paper[0]
    panel.set_title(style.noise_label(task, first.noise, first.bound).replace(", ", ",\n"))
    flat = shown.section.chart.dimension == 2
    view = runs.view_of(panel, shown.section, 0, flat)
    for arc in shown.paper:
        runs.chosen_way(panel, shown, view, arc, linewidth=2.0)
        runs.ends(panel, task, view, arc)
    if not flat:
        charts.set_point_lines(panel, task)


def _input_map(panel: Axes, shown: Shown, grid: Grid, inputs: np.ndarray, i: int) -> None:
    """Draws the map of an input, of those (N, m) at the nodes without noise, with its colour bar."""
    task, ring = shown.task, charts.is_ring(shown.task.chart)
    colours, scale, ticks = _input_colours(task, i)
    values = inputs[:, i]
    if ring:
        shades, classes = np.unique(colours(scale(values)), axis=0, return_inverse=True)
        charts.arcs(panel, task.chart, classes.ravel(), shades, OUTER, INNER)
        charts.ring(panel, task.chart, (OUTER, INNER))
        charts.spokes(panel, task.chart, shown.critical.points, 0.6, BAD)
    else:
        charts.image(panel, grid, values, cmap=colours, norm=scale)
        charts.plane(panel, shown.section)
        charts.dots(panel, shown.critical.points, BAD)
    # After the ring, whose place in the panel the colour bar sets.
    bar = panel.figure.colorbar(
        ScalarMappable(scale, colours),
        ax=panel, location="right", shrink=0.7, aspect=20, ticks=ticks,
    )  # fmt: skip
    unit = f" [{task.input_units[i]}]" if task.input_units else ""
    bar.set_label(task.inputs[i].replace("_", " ") + unit)


def _input_colours(task: Task, i: int) -> tuple[Colormap, Normalize, np.ndarray | None]:
    """Returns the colours of an input, their scale, and the ticks of a discrete input."""
    low, high = (float(limit[i]) for limit in task.input_limits)
    # Without the darkest shades, on which no other mark can be seen.
    shades = ListedColormap(colormaps["PRGn"](np.linspace(0.08, 0.92, 256)))
    if task.input_levels is None:
        return shades, Normalize(low, high), None
    levels = np.unique(task.input_levels[:, i])
    half = (levels[1] - levels[0]) / 2
    bounds = np.append(levels - half, high + half)
    colours = ListedColormap(shades(np.linspace(0, 1, len(levels))))
    return colours, BoundaryNorm(bounds, len(levels)), levels
