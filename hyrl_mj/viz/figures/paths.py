"""Runs as paths in a panel: in the plane of a chart, over time, or as spirals on a ring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import Outcome, Task
from hyrl_mj.viz.figures.charts import Artists, on_ring
from hyrl_mj.viz.figures.style import (
    INK,
    PALE,
    PAPER,
    POLICY_COLOUR,
    RED,
    mode_colour,
)

# Radius at which spirals begin; they end at 1.
CORE = 0.4
# How the end of a run is called that is not there, by its outcome.
ENDS = {"running": "end, not there yet", "out_of_bounds": "end: out of bounds"}


@dataclass(frozen=True)
class View:
    """How runs lie in a panel.

    Attributes:
        points: where times (N,) [s] and chart points (N, d) lie: (N, 2).
        longest: (2,) a step longer than this is one round a period, and is not drawn.
    """

    points: Callable[[np.ndarray, np.ndarray], np.ndarray]
    longest: np.ndarray = field(default_factory=lambda: np.full(2, np.inf))


def plane_view(task: Task) -> View:
    """Paths in the plane of a chart."""
    half = np.subtract(task.chart.high, task.chart.low) / 2
    return View(lambda t, z: task.chart.wrap(z), np.where(task.chart.periodic, half, np.inf))


def time_view(coordinate: int) -> View:
    """A coordinate over time."""
    return View(lambda t, z: np.stack([t, z[:, coordinate]], axis=1))


def spiral_view(task: Task, horizon: float) -> View:
    """A periodic coordinate as angle; time goes outward, and reaches the rim at the horizon [s]."""

    def points(t: np.ndarray, z: np.ndarray) -> np.ndarray:
        radius = CORE + (1 - CORE) * t / horizon
        return np.stack(on_ring(task, z[:, 0]), axis=1) * radius[:, None]

    return View(points)


def line(panel: Axes, view: View, t: np.ndarray, z: np.ndarray, **looks: Any) -> Line2D:
    """Draw a path: times (N,) [s], chart points (N, d)."""
    points = view.points(t, z)
    gaps = (np.abs(np.diff(points, axis=0)) > view.longest).any(axis=1)
    x, y = np.insert(points, np.flatnonzero(gaps) + 1, np.nan, axis=0).T
    (drawn,) = panel.plot(x, y, **looks)
    return drawn


def mark(panel: Axes, view: View, arc: HybridArc, row: int, shape: Any, **looks: Any) -> Line2D:
    """Mark a row of an arc with one of matplotlib's markers."""
    ((x, y),) = view.points(arc.t[[row]], arc.z[[row]])
    looks = {"markersize": 6, "clip_on": False, "zorder": 6} | looks
    (drawn,) = panel.plot([x], [y], marker=shape, linestyle="none", **looks)
    return drawn


def ends(panel: Axes, task: Task, view: View, arc: HybridArc) -> Artists:
    """Mark where a run starts and ends; an end in failure is red.

    Returns:
        What the legend needs.
    """
    start = mark(panel, view, arc, 0, "o", markerfacecolor=PAPER, markeredgecolor=INK)
    return {"start": start} | end(panel, task, view, arc)


def end(panel: Axes, task: Task, view: View, arc: HybridArc) -> Artists:
    """Mark where a run ends, in red if it has failed; returns as `ends`."""
    words, colour = ("end", INK) if arc.arrives(task) else ("end: off the set-point", PALE)
    if failed(arc):
        words, colour = ENDS.get(arc.outcome, f"end: {arc.outcome}"), RED
    return {words: mark(panel, view, arc, -1, "x", color=colour, markeredgewidth=2)}


def failed(arc: HybridArc) -> bool:
    """Whether a run is no success."""
    return arc.outcome != Outcome.REACHED.label


def policy_way(panel: Axes, view: View, arc: HybridArc, **looks: Any) -> Line2D:
    """Draws a run of the stage-1 policy in ink."""
    return line(panel, view, arc.t, arc.z, color=POLICY_COLOUR, zorder=4, **looks)


def chosen_way(
    panel: Axes, task: Task, view: View, arc: HybridArc, **looks: Any
) -> tuple[str, Line2D]:
    """Draw a run of the stage-1 policy in the colour of the mode whose way it goes.

    Returns:
        What the legend says of it, and the path.
    """
    mode = int(task.direction(arc.z[:, None])[0])
    colour, words = mode_colour(mode), f"way of mode {task.mode_name(mode)}"
    if failed(arc):
        colour, words = POLICY_COLOUR, "neither way"
    elif mode < 0:
        colour, words = PALE, "nothing to decide"
    return words, line(panel, view, arc.t, arc.z, color=colour, **looks)


def hybrid_way(panel: Axes, task: Task, view: View, arc: HybridArc, **looks: Any) -> Artists:
    """Draw a run of the hybrid controller in the colours of its modes, and mark its jumps."""
    found: Artists = {}
    for j in range(arc.j[-1] + 1):
        rows = arc.j == j
        mode = int(arc.q[rows][0])
        colour = mode_colour(mode)
        drawn = line(panel, view, arc.t[rows], arc.z[rows], color=colour, **looks)
        found[f"HyRL in mode {task.mode_name(mode)}"] = drawn
    for row in np.flatnonzero(np.diff(arc.j)).tolist():
        # Small, and on top: a jump at the start is seen in its circle.
        found["jump"] = mark(panel, view, arc, row, "D", color=INK, markersize=3.5, zorder=7)
    return found
