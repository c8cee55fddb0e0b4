"""Pictures of the stage-1 policy: what noise makes of it, and its map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, Normalize

from hyrl_mj.policies import Policy, algorithm_title
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import HybridArc, Noise, simulate
from hyrl_mj.stages import CriticalSet, Partition
from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures.charts import (
    INNER,
    OUTER,
    Artists,
    angles_on,
    arcs,
    classes_of,
    cross,
    dots,
    drawable,
    is_ring,
    measured_at,
    on_ring,
    patch,
    plane,
    region,
    ring,
    set_point_lines,
    spokes,
)
from hyrl_mj.viz.figures.paths import (
    CORE,
    View,
    chosen_way,
    end,
    ends,
    line,
    mark,
    plane_view,
    policy_way,
    spiral_view,
    time_view,
)
from hyrl_mj.viz.figures.style import (
    INK,
    PALE,
    PALE_RED,
    RED,
    WIDTH,
    axis_label,
    drawing,
    head,
    input_label,
    legend,
    mode_tint,
    noise_label,
)

# Runs without noise in the overview: an even number has none from the middle.
RUNS = 12
# The share of a run after which the head of an arrow shows where it goes, as 1/ARROW.
ARROW = 7
# Nodes at which the policy is asked: of a ring, and along the longest side of a plane.
RING_NODES, PLANE_CELLS = 720, 240
INPUT_COLOURS = "PRGn"


def overview(
    task: Task,
    policy: Policy,
    critical: CriticalSet,
    partition: Partition,
    arc: HybridArc,
    path: Path,
) -> None:
    """Write a picture (PNG and PDF) of the ways that the policy goes, and of where noise leads it.

    Args:
        task: has a chart that is a plane or a ring; else nothing is written.
        policy: of stage 1.
        critical: M*.
        partition: the parts M_i.
        arc: a run of the policy under noise, from M* if there is one.
        path: of the PNG.
    """
    if not drawable(task):
        return
    with drawing(path, (WIDTH, 7.6)) as figure:
        head(
            figure, task, f"the {algorithm_title(task.algorithm)} policy, and where noise leads it"
        )
        panel = figure.subplots()
        panel.set_title(noise_label(task, arc.noise, arc.bound))
        found = _spirals if is_ring(task) else _field
        legend(figure, found(panel, task, policy, critical, partition, arc))


def policy_map(
    task: Task, policy: Policy, critical: CriticalSet, eps: float, seed: int, path: Path
) -> None:
    """Write a picture (PNG and PDF) of the policy's inputs, and of its runs from the paper's starts.

    Args:
        task: has a chart that is a plane or a ring; else nothing is written.
        policy: of stage 1.
        critical: M*, drawn in red.
        eps: bound of the noise that the runs meet.
        seed: of the noise.
        path: of the PNG.
    """
    if not drawable(task):
        return
    starts = task.policy_starts or task.replay_starts
    noise = Noise("alternating", eps)
    runs = simulate(task, policy, np.array(starts), noise, horizon=task.replay_time, seed=seed)
    assert isinstance(runs, list)
    with drawing(path, (WIDTH, 5.2)) as figure:
        head(figure, task, f"the {algorithm_title(task.algorithm)} policy")
        *maps, beside = figure.subplots(1, len(task.inputs) + 1)
        found: Artists = {}
        for i, panel in enumerate(maps):
            draw = _input_ring if is_ring(task) else _input_plane
            found |= draw(panel, task, policy, critical, i)
        beside.set_title(noise_label(task, noise.kind, eps).replace(", ", ",\n"))
        view = _over_time(beside, task) if is_ring(task) else plane_view(task)
        if not is_ring(task):
            found |= plane(beside, task)
        ways: Artists = {}
        marks: Artists = {}
        for run in runs:
            words, drawn = chosen_way(beside, task, view, run, linewidth=2.0)
            ways[words] = drawn
            marks |= ends(beside, task, view, run)
        if is_ring(task):
            found |= set_point_lines(beside, task, 0)
        legend(figure, found | dict(sorted(ways.items())) | marks)


# ---- overview


def _starts(task: Task) -> np.ndarray:
    """Starts (k, d) along the longest side of the start region, at the lower end of the others."""
    low, high = np.array(task.start_low), np.array(task.start_high)
    starts, axis = np.tile(low, (RUNS, 1)), int(np.argmax(high - low))
    shares = (np.arange(RUNS) + 0.5) / RUNS
    starts[:, axis] = low[axis] + shares * (high - low)[axis]
    return starts


def _runs(panel: Axes, task: Task, policy: Policy, view: View) -> Artists:
    """Draw the runs without noise; returns as `plane`."""
    runs = simulate(task, policy, _starts(task), horizon=task.replay_time)
    assert isinstance(runs, list)
    found: Artists = {}
    for run in runs:
        words, drawn = chosen_way(panel, task, view, run, linewidth=1.3, zorder=3)
        found[f"without noise: {words}"] = drawn
        row = len(run.t) // ARROW
        points = view.points(run.t[row : row + 2], run.z[row : row + 2])
        if len(points) < 2 or (np.abs(points[1] - points[0]) > view.longest).any():
            continue  # it is over where it starts, or goes round the seam just there
        looks = {"arrowstyle": "-|>", "color": drawn.get_color(), "shrinkA": 0, "shrinkB": 0}
        arrow = looks | {"mutation_scale": 11}
        panel.annotate("", points[1], points[0], arrowprops=arrow, zorder=3)
    return dict(sorted(found.items()))


def _field(
    panel: Axes,
    task: Task,
    policy: Policy,
    critical: CriticalSet,
    partition: Partition,
    arc: HybridArc,
) -> Artists:
    """Draw the overview of a plane; returns as `plane`."""
    found: Artists = {}
    classes, grid = classes_of(partition), partition.grid
    for i, mode in enumerate(partition.modes):
        region(panel, GridSet.from_mask(grid, classes == i), mode_tint(mode))
        found[f"only in the part $M_{mode}$"] = patch(mode_tint(mode))
    found |= plane(panel, task)
    view = plane_view(task)
    found |= _runs(panel, task, policy, view)
    eps = task.noise_in_chart(arc.bound)
    panel.add_collection(
        PolyCollection(
            list(_band(task.chart.wrap(arc.z), eps, view.longest)),
            color=PALE_RED,
            linewidth=0.3,
            zorder=2,
        )
    )
    found |= _noisy_run(panel, task, view, arc)
    ahead = arc.z[-1] - arc.z[0]
    pointing = (3, 0, float(np.degrees(np.arctan2(ahead[1], ahead[0]))) - 90)
    looks = {"markersize": 13, "markerfacecolor": PALE, "markeredgecolor": INK}
    found["robot at its start"] = mark(panel, view, arc, 0, pointing, **looks)
    return found | dots(panel, critical.points)


def _band(z: np.ndarray, eps: np.ndarray, longest: np.ndarray) -> np.ndarray:
    """Quadrilaterals (k, 4, 2) that cover a path (K, 2) and all within +-eps (2,) of it.

    A box that moves straight on sweeps over itself and what its two diagonals sweep over. Steps that are
    longer than `longest` go round the seam of a periodic chart.
    """
    steps = (np.abs(np.diff(z, axis=0)) <= longest).all(axis=1)
    a, b = z[:-1][steps], z[1:][steps]
    corners = [np.array(signs) * eps for signs in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    boxes = np.stack([z + corner for corner in corners], axis=1)
    swept = [np.stack([a - c, a + c, b + c, b - c], axis=1) for c in corners[:2]]
    return np.concatenate([boxes, *swept])


def _spirals(
    panel: Axes,
    task: Task,
    policy: Policy,
    critical: CriticalSet,
    partition: Partition,
    arc: HybridArc,
) -> Artists:
    """Draw the overview of a ring, time going outward; returns as `plane`."""
    seconds = task.replay_time
    tints = [mode_tint(mode) for mode in partition.modes]
    arcs(panel, task, classes_of(partition), [*tints, None], OUTER, CORE)
    ring(panel, task, (OUTER, CORE), f",\ntime outward:\n0 to {seconds:g} s")
    found: Artists = {
        f"only in the part $M_{mode}$": patch(tint)
        for mode, tint in zip(partition.modes, tints, strict=True)
    }
    view = spiral_view(task, seconds)
    found |= _runs(panel, task, policy, view)
    eps = task.noise_in_chart(arc.bound)
    rim = np.vstack([view.points(arc.t, arc.z - eps), view.points(arc.t, arc.z + eps)[::-1]])
    panel.fill(*rim.T, color=PALE_RED, linewidth=0, zorder=2)
    found |= _noisy_run(panel, task, view, arc)
    if task.set_point is not None:
        found |= cross(panel, *np.ravel(on_ring(task, task.set_point)))
    return found | spokes(panel, task, critical.points[:, 0], CORE - 0.06, OUTER)


def _noisy_run(panel: Axes, task: Task, view: View, arc: HybridArc) -> Artists:
    """Draw the run under noise, what it measures, and the set-point; returns as `plane`."""
    ((words, drawn),) = policy_way(panel, task, view, arc, linewidth=1.4).items()
    found: Artists = {f"{words}, with noise": drawn}
    found["what it can observe"] = patch(PALE_RED, PALE_RED)
    measured = task.z(arc.measured[:-1])
    looks = {"linestyle": "none", "marker": ".", "color": RED, "markersize": 4, "zorder": 4.5}
    found["what it observes"] = line(panel, view, arc.t[:-1], measured, **looks)
    return found | end(panel, task, view, arc)


# ---- policy map


def _input_colours(task: Task, i: int) -> tuple[Colormap, Normalize, np.ndarray | None]:
    """Colours of an input, their scale, and the ticks of a discrete one."""
    low, high = (float(limit[i]) for limit in task.input_limits)
    # Without the darkest shades, on which nothing else is seen.
    shades = ListedColormap(colormaps[INPUT_COLOURS](np.linspace(0.08, 0.92, 256)))
    if task.input_levels is None:
        return shades, Normalize(low, high), None
    levels = np.unique(task.input_levels[:, i])
    half = (levels[1] - levels[0]) / 2
    bounds = np.append(levels - half, high + half)
    colours = ListedColormap(shades(np.linspace(0, 1, len(levels))))
    return colours, BoundaryNorm(bounds, len(levels)), levels


def _bar(panel: Axes, task: Task, i: int) -> None:
    """Put the colour bar of an input under its map."""
    colours, scale, ticks = _input_colours(task, i)
    scalars = ScalarMappable(scale, colours)
    bar = panel.figure.colorbar(
        scalars, ax=panel, location="right", shrink=0.7, aspect=20, ticks=ticks
    )
    bar.set_label(input_label(task, i))


def _asked(task: Task, policy: Policy, z: np.ndarray, i: int) -> np.ndarray:
    """Input i (n,) of the policy at chart points (n, d) that are measured without noise."""
    return policy.act(measured_at(task, z))[:, i]


def _input_plane(panel: Axes, task: Task, policy: Policy, critical: CriticalSet, i: int) -> Artists:
    """Draw the map of an input over a plane; returns as `plane`."""
    colours, scale, _ = _input_colours(task, i)
    grid = Grid.with_cells(task.chart, PLANE_CELLS)
    half = grid.spacing / 2
    (left, bottom), (right, top) = grid.nodes[0] - half, grid.nodes[-1] + half
    panel.imshow(
        _asked(task, policy, grid.nodes, i).reshape(grid.counts).T,
        cmap=colours, norm=scale, extent=(left, right, bottom, top),
        origin="lower", interpolation="nearest",
    )  # fmt: skip
    _bar(panel, task, i)
    return plane(panel, task) | dots(panel, critical.points, RED)


def _input_ring(panel: Axes, task: Task, policy: Policy, critical: CriticalSet, i: int) -> Artists:
    """Draw the map of an input as a ring; returns as `plane`."""
    colours, scale, _ = _input_colours(task, i)
    grid = Grid(task.chart, (RING_NODES,))
    u = _asked(task, policy, grid.nodes, i)
    shades, classes = np.unique(colours(scale(u)), axis=0, return_inverse=True)
    arcs(panel, task, classes.ravel(), shades)
    ring(panel, task, (OUTER, INNER))
    _bar(panel, task, i)
    return spokes(panel, task, critical.points[:, 0], 0.6, OUTER, colour=RED)


def _over_time(panel: Axes, task: Task) -> View:
    """Make a panel one of the chart's only coordinate over time."""
    panel.set(xlabel="time [s]", ylabel=axis_label(task, 0), xlim=(0, task.replay_time))
    angles_on(panel.yaxis, task, 0)
    return time_view(0)
