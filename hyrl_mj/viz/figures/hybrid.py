"""Pictures of the hybrid controller: the extended sets, and its runs beside those of the policy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from hyrl_mj.sets import GridSet
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets
from hyrl_mj.tasks import Task
from hyrl_mj.viz import colours
from hyrl_mj.viz.figures.charts import (
    OUTER,
    Artists,
    angles_on,
    arcs,
    dots,
    drawable,
    is_ring,
    on_ring,
    patch,
    plane,
    region,
    ring,
    set_point_lines,
    spokes,
)
from hyrl_mj.viz.figures.paths import View, ends, hybrid_way, plane_view, policy_way, time_view
from hyrl_mj.viz.figures.style import (
    INK,
    RED,
    WIDTH,
    axis_label,
    drawing,
    head,
    legend,
    mode_colour,
    mode_tint,
    noise_label,
    policy_title,
)

# Of states that several extended sets hold.
SHARED = colours.OVERLAP
# Inner radius of the innermost ring, the gap between rings, and where the ends of a set are written.
CORE, GAP, OUTSIDE, INSIDE = 0.6, 0.05, 1.14, 0.47
# How far round M* the enlarged panel reaches, in noise bounds.
AROUND = 4.0


def extended_sets_map(task: Task, critical: CriticalSet, sets: ExtendedSets, path: Path) -> None:
    """Write a picture (PNG and PDF) of the extended sets and where they overlap.

    Args:
        task: has a chart that is a plane or a ring; else nothing is written.
        critical: M*.
        sets: M_ext_i.
        path: of the PNG.
    """
    if not drawable(task):
        return
    unit = task.noise_on()[1]
    with drawing(path, (WIDTH, 5.6)) as figure:
        head(
            figure,
            task,
            f"extended sets for noise up to eps = {sets.noise:g} {unit}"
            + (f", T = {sets.horizon:.2g} s" if sets.horizon else ""),
        )
        if is_ring(task):
            found = _set_rings(figure.subplots(), task, critical, sets)
        elif len(critical.points) and sets.noise > 0:
            whole, near = figure.subplots(1, 2)
            found = _set_plane(whole, task, critical, sets)
            _set_plane(near, task, critical, sets)
            found |= _enlarge(whole, near, task, critical, sets)
        else:
            found = _set_plane(figure.subplots(), task, critical, sets)
        legend(figure, found)


def runs(task: Task, found: Mapping[tuple[str, str], HybridArc], path: Path) -> None:
    """Write a picture (PNG and PDF) of the hybrid controller and the policy under the same noise.

    A panel for each start mode has the paths in a plane, or the coordinates of the chart over time.

    Args:
        task: what was simulated.
        found: arcs by start ("start0", ...; others are not drawn) and controller ("policy", "hyrl_q0", ...).
        path: of the PNG.
    """
    loops = list(dict.fromkeys(who for _, who in found if who != "policy"))
    starts = list(dict.fromkeys(start for start, _ in found if start.startswith("start")))
    flat = task.chart.dimension == 2
    coordinates = [0] if flat else list(range(task.chart.dimension))
    first = found[starts[0], "policy"]
    with drawing(path, (WIDTH, 1.6 + 3.4 * len(coordinates))) as figure:
        noise = noise_label(task, first.noise, first.bound)
        head(figure, task, f"HyRL and {policy_title(task)}\nunder the same {noise}")
        panels = figure.subplots(
            len(coordinates), len(loops), sharex=True, sharey="row", squeeze=False
        )
        shown: Artists = {}
        ways: Artists = {}
        marks: Artists = {}
        for row, coordinate in zip(panels, coordinates, strict=True):
            for panel, loop in zip(row, loops, strict=True):
                view, fixed = _run_panel(panel, task, coordinate)
                shown |= fixed
                for start in starts:
                    for who in (loop, "policy"):
                        draw = policy_way if who == "policy" else hybrid_way
                        width = 1.0 if who == "policy" else 2.0
                        arc = found[start, who]
                        ways |= draw(panel, task, view, arc, linewidth=width)
                        marks |= ends(panel, task, view, arc)
                if not flat:
                    shown |= set_point_lines(panel, task, coordinate)
        for panel, loop in zip(panels[0], loops, strict=True):
            mode = int(loop.removeprefix("hyrl_q"))
            panel.set_title(f"started in q0 = {task.mode_name(mode)}", fontweight="bold")
        for panel in panels.ravel():
            panel.label_outer()
        legend(figure, dict(sorted(ways.items())) | marks | shown)


# ---- extended sets


def _set_name(task: Task, mode: int) -> str:
    return f"$M^{{ext}}_{mode}$, of mode {task.mode_name(mode)}"


def _shared(sets: ExtendedSets) -> np.ndarray:
    """(N,) bool, the nodes that several sets hold."""
    return np.asarray(np.sum([members.mask for members in sets.sets], axis=0) > 1)


def _set_rings(panel: Axes, task: Task, critical: CriticalSet, sets: ExtendedSets) -> Artists:
    """Draw a ring for each set, its ends written beside it; returns as `plane`."""
    shared = _shared(sets)
    arcs(panel, task, shared.astype(int), (None, SHARED), OUTER, CORE)
    found: Artists = {}
    width = (OUTER - CORE - GAP) / len(sets.sets)
    for i, (mode, members) in enumerate(zip(sets.modes, sets.sets, strict=True)):
        outer, colour = OUTER - GAP - i * width, mode_colour(mode)
        arcs(panel, task, members.mask.astype(int), (None, colour), outer, outer - width + GAP)
        found[_set_name(task, mode)] = patch(colour)
        # The first set's ends are written outside the rings, the others' inside, one below the other.
        _ends(panel, task, members, OUTSIDE if i == 0 else INSIDE - 0.1 * (i - 1), colour)
    if shared.any():
        found["in several of them"] = patch(SHARED)
    ring(panel, task, (OUTER, CORE))
    return found | spokes(panel, task, critical.points[:, 0], CORE - 0.06, OUTER)


def _ends(panel: Axes, task: Task, members: GridSet, radius: float, colour: str) -> None:
    """Write the ends of the pieces of a set at a radius of its ring."""
    if members.mask.all():
        return
    for value in np.ravel(members.pieces()):
        x, y = radius * np.array(on_ring(task, value))
        text = f"{value / np.pi:.2f}π" if task.chart.units[0] == "rad" else f"{value:.3g}"
        panel.text(x, y, text, color=colour, ha="center", va="center", fontsize=9)


def _set_plane(panel: Axes, task: Task, critical: CriticalSet, sets: ExtendedSets) -> Artists:
    """Fill the sets in a plane, with outlines; returns as `plane`."""
    found: Artists = {}
    looks = [(mode_tint(mode), mode_colour(mode)) for mode in sets.modes]
    for mode, members, (tint, colour) in zip(sets.modes, sets.sets, looks, strict=True):
        region(panel, members, tint)
        found[_set_name(task, mode)] = patch(tint, colour)
    grid, shared = sets.sets[0].grid, _shared(sets)
    region(panel, GridSet.from_mask(grid, shared), SHARED)
    if shared.any():
        found["in several of them"] = patch(SHARED, SHARED)
    for members, (_, colour) in zip(sets.sets, looks, strict=True):
        region(panel, members, "none", colour, zorder=2)
    found |= plane(panel, task)
    return found | dots(panel, critical.points)


def _enlarge(
    whole: Axes, near: Axes, task: Task, critical: CriticalSet, sets: ExtendedSets
) -> Artists:
    """Show the neighbourhood of M* in the second panel, with the room that noise asks for."""
    margin = AROUND * sets.noise
    low = np.maximum(critical.points.min(axis=0) - margin, task.chart.low)
    high = np.minimum(critical.points.max(axis=0) + margin, task.chart.high)
    near.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title="around M*")
    box = Rectangle(low, *(high - low), fill=False, edgecolor=INK, linestyle=":", zorder=3)
    whole.add_patch(box)
    for drawn in near.lines:
        drawn.set_clip_on(True)  # a mark off this panel is not shown beside it
    # Of M*'s points the one in the middle: where the room that noise takes is drawn.
    middle = critical.points[np.argsort(critical.points.sum(axis=1))[len(critical.points) // 2]]
    axis = int(np.argmax(task.noise_in_chart(1.0)))
    step = np.zeros(2)
    step[axis] = sets.noise
    room = np.stack([middle - step, middle + step]).T
    looks: dict[str, Any] = {
        "color": RED,
        "linewidth": 2,
        "markersize": 9,
        "marker": "_|"[axis == 0],
    }
    (room_taken,) = near.plot(*room, zorder=4, **looks)
    return {f"2 eps = {2 * sets.noise:g} {task.chart.units[axis]}": room_taken}


# ---- runs


def _run_panel(panel: Axes, task: Task, coordinate: int) -> tuple[View, Artists]:
    """Make a panel one for runs: how they lie in it, and what the legend needs."""
    if task.chart.dimension == 2:
        return plane_view(task), plane(panel, task)
    panel.set(xlabel="time [s]", ylabel=axis_label(task, coordinate))
    panel.grid(color="#e6e8eb", linewidth=0.8)
    angles_on(panel.yaxis, task, coordinate)
    return time_view(coordinate), {}
