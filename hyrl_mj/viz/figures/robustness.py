"""Pictures of the worst-case game: where it is won, and how much of it at which noise bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle, Wedge

from hyrl_mj.game import LIMIT, MAP_CLASSES, OVER, UNWINNABLE
from hyrl_mj.sets import Grid
from hyrl_mj.stages import CriticalSet
from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures.charts import INNER, OUTER, TICK, arcs, dots, is_ring, patch, ring, spokes
from hyrl_mj.viz.figures.style import (
    CASING,
    COLUMNS,
    GREY,
    INK,
    PALE,
    PAPER,
    POLICY_COLOUR,
    WIDTH,
    axis_label,
    drawing,
    head,
    legend,
    mode_colour,
)
from hyrl_mj.viz.tables import NAMES, lasts, percent

# As MAP_CLASSES: told apart by colour-blind people, too.
CLASS_COLOURS = ("#7cc0e8", "#f2c530", mode_colour(1), "#5c2a6b", GREY)
SENTENCES = dict(enumerate(MAP_CLASSES)) | {
    UNWINNABLE: "not winnable, whatever the controller",
    OVER: "over: obstacle, or the run has ended",
}
# Of the curves: ink as the policy's path in the replay, then blue, purple and vermilion.
CURVE_COLOURS = (POLICY_COLOUR, *(mode_colour(i) for i in (0, 2, 1)))
LIMIT_COLOUR = "#a9dcc9"
MARKERS = "osD^"
# Nodes of a curve from one marker to the next.
MARK_EVERY = 6
# Rows of the marks of margins, above the curves [%].
TOP, ROW = 105, 5
# Radius of the dots of M*: inside the ring, where they hide no class.
CRITICAL = 0.6


def robustness_map(
    task: Task,
    content: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    critical: CriticalSet,
    path: Path,
) -> None:
    """Write a picture (PNG and PDF) with a panel for each controller: what becomes of runs from each state.

    Args:
        task: what was played; its chart has two coordinates, or one.
        content: of `examine`.
        arrays: of `examine`: `map_<controller>` (N,) int, an index into `MAP_CLASSES` for each node of
            the grid of `grid_counts` (d,) nodes, and the noise bound `eps` that they hold for.
        critical: M*, drawn over it.
        path: of the PNG.
    """
    names, grid = _controllers(content), Grid.from_counts(task.chart, arrays["grid_counts"])
    rows = -(-len(names) // COLUMNS)
    columns = min(len(names), COLUMNS)
    with drawing(path, (WIDTH, 1.6 + rows * _panel_height(task))) as figure:
        where, unit = task.noise_on(content["everywhere"])
        head(figure, task, f"the worst noise on {where} up to eps = {arrays['eps']:g} {unit}")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        found: dict[str, Artist] = {}
        for panel, name in zip(panels, names, strict=False):
            draw = _ring if is_ring(task) else _box
            found |= draw(panel, task, grid, arrays[f"map_{name}"], critical)
            _head(panel, name, max(content["scores"][name], key=lambda score: score["eps"]))
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        classes = np.unique(np.concatenate([arrays[f"map_{name}"] for name in names]))
        legend(figure, {SENTENCES[k]: patch(CLASS_COLOURS[k]) for k in classes} | found)


def robustness_curve(task: Task, content: Mapping[str, Any], path: Path) -> None:
    """Write a picture (PNG and PDF) of what each controller wins against the noise bound.

    Where runs last for ever, a panel below has the worst time to arrival.

    Args:
        task: what was played.
        content: of `examine`.
        path: of the PNG.
    """
    names, curve = _controllers(content), content["curve"]
    eps, scores = np.array(curve["eps"]), content["scores"]
    run_eps = max(score["eps"] for score in scores[names[0]])
    lasting = lasts(content)
    # A controller has its colour whoever else is in the picture.
    known = list(dict.fromkeys(["policy", "hyrl", *names]))
    numbers = {name: known.index(name) for name in names}
    where, unit = task.noise_on(content["everywhere"])
    heights = (3.6, 2.0) if lasting else (3.6,)
    with drawing(path, (WIDTH, 2.0 + sum(heights))) as figure:
        head(figure, task, "what is won against the worst noise")
        panels = figure.subplots(
            len(heights), 1, sharex=True, squeeze=False, height_ratios=heights
        ).ravel()
        shares = panels[0]
        handles = _limit(shares, eps, curve[LIMIT])
        for name, number in numbers.items():
            handles |= _won(shares, number, name, eps, curve[name])
        (line,) = shares.plot(eps, 100 * np.array(curve["winnable"]), color=PALE, linewidth=1)
        handles["winnable share of the start region"] = line
        handles |= _margins(shares, content["margin"], numbers, unit)
        shares.set(ylabel="winnable starts that are won [%]", yticks=range(0, 101, 20))
        if lasting:
            for name, number in numbers.items():
                _times(panels[1], number, eps, curve[name])
            panels[1].set_ylabel("worst time to arrival,\nstarts that are won [s]")
        for panel in panels:
            panel.axvline(run_eps, color=INK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
            panel.grid(color="#e6e8eb", linewidth=0.8)
            panel.set_axisbelow(True)
            panel.spines[["top", "right"]].set_visible(False)
        right = max(eps[-1], run_eps)
        panels[-1].set(xlabel=f"noise bound eps on {where} [{unit}]", xlim=(0, 1.01 * right))
        shares.annotate(
            f"this run: eps = {run_eps:g} {unit}",
            (run_eps, 1),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
        )
        legend(figure, handles, handlelength=3.2)


# ---- words


def _controllers(content: Mapping[str, Any]) -> list[str]:
    return [name for name in content["scores"] if name != LIMIT]


# ---- maps


def _panel_height(task: Task) -> float:
    """Height [inches] that a panel takes with its title and labels."""
    if is_ring(task):
        return 4.1
    sides = np.subtract(task.chart.high, task.chart.low)
    return 1.1 + (float(3.2 * sides[1] / sides[0]) if len(sides) == 2 else 0.5)


def _head(panel: Axes, name: str, score: Mapping[str, Any]) -> None:
    """Write the controller and what it wins over its panel."""
    won, won_any = percent(score["won"]), percent(score["won_any"])
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


def _box(
    panel: Axes, task: Task, grid: Grid, classes: np.ndarray, critical: CriticalSet
) -> dict[str, Artist]:
    """Draw a map as an image over the chart; a chart of one coordinate is a strip of height 1.

    Returns:
        What the legend needs beside the classes.
    """
    chart, half, flat = task.chart, grid.spacing / 2, task.chart.dimension == 1
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
    z = critical.points
    points = dots(panel, np.hstack([z, np.full_like(z, 0.5)]) if flat else z)
    return {"start region": box} | points


def _corner(ends: Sequence[float], side: float) -> tuple[float, float]:
    """A corner of a chart (d,) in the plane of the picture."""
    return float(ends[0]), float(ends[1]) if len(ends) > 1 else side


def _ring(
    panel: Axes, task: Task, grid: Grid, classes: np.ndarray, critical: CriticalSet
) -> dict[str, Artist]:
    """Draw a map over a periodic coordinate as arcs of a ring; returns as `_box`."""
    arcs(panel, task, classes, CLASS_COLOURS)
    ring(panel, task, (OUTER, INNER))
    found: dict[str, Artist] = {}
    period = task.chart.high[0] - task.chart.low[0]
    first, last = (360 * corner[0] / period for corner in (task.start_low, task.start_high))
    if last - first < 360 - 360 / len(classes):
        found["start region"] = panel.add_patch(
            Wedge((0, 0), TICK, first, last, width=0.03, color=INK, linewidth=0)
        )
    return found | spokes(panel, task, critical.points[:, 0], CRITICAL, OUTER)


# ---- curves


def _limit(panel: Axes, eps: np.ndarray, curve: Mapping[str, Any]) -> dict[str, Artist]:
    """Draw what any controller could win, broad and pale: curves that reach it are seen on it.

    Returns:
        What the legend needs.
    """
    looks: dict[str, Any] = {"color": LIMIT_COLOUR, "linewidth": 7, "solid_capstyle": "butt"}
    (won,) = panel.plot(eps, 100 * np.array(curve["won"]), **looks)
    if _same(curve):
        return {"limit of any controller": won}
    looks |= {"linestyle": (0, (1.2, 0.5)), "linewidth": 4}
    (won_any,) = panel.plot(eps, 100 * np.array(curve["won_any"]), **looks)
    return {
        "limit of any controller, picks the start mode": won,
        "limit of any controller, from every start mode": won_any,
    }


def _won(
    panel: Axes, number: int, name: str, eps: np.ndarray, curve: Mapping[str, Any]
) -> dict[str, Artist]:
    """Draw what a controller wins; returns as `_limit`."""
    won, won_any = 100 * np.array(curve["won"]), 100 * np.array(curve["won_any"])
    title, looks = NAMES.get(name, name), _looks(number)
    (line,) = panel.plot(eps, won, **looks)
    if _same(curve):
        return {title: line}
    (dashed,) = panel.plot(eps, won_any, **looks | _dashed(number))
    return {f"{title}, picks the start mode": line, f"{title}, from every start mode": dashed}


def _times(panel: Axes, number: int, eps: np.ndarray, curve: Mapping[str, Any]) -> None:
    """Draw the worst time to arrival; where nothing is won there is none."""
    looks = _looks(number) | ({} if _same(curve) else _dashed(number))
    won = np.array(curve["won_any"]) > 0
    panel.plot(eps, np.where(won, curve["time_any"], np.nan), **looks)


def _same(curve: Mapping[str, Any]) -> bool:
    """Whether it makes no difference which mode a controller starts in."""
    return bool(np.allclose(curve["won"], curve["won_any"], atol=1e-9))


def _looks(number: int) -> dict[str, Any]:
    """How the curve of a controller looks.

    Where curves coincide the first is thin and lies on thicker ones, and no marker hides another's.
    """
    return {
        "color": CURVE_COLOURS[number % len(CURVE_COLOURS)],
        "linewidth": 1.5 + 1.3 * number,
        "zorder": 3 + 1 / (1 + number),
        "marker": MARKERS[number % len(MARKERS)],
        "markersize": 6,
        "clip_on": False,
        "markevery": (2 * number % MARK_EVERY, MARK_EVERY),
    }


def _dashed(number: int) -> dict[str, Any]:
    """What is other about the curve of a controller that is started in every mode."""
    return {
        "linestyle": "--",
        "linewidth": 1.5,
        "markerfacecolor": PAPER,
        "markeredgewidth": 1.5,
        "markevery": ((2 * number + 1) % MARK_EVERY, MARK_EVERY),
    }


def _margins(
    panel: Axes, margins: Mapping[str, float | None], numbers: Mapping[str, int], unit: str
) -> dict[str, Artist]:
    """Mark the margins above the curves, a row for each controller; returns as `_limit`."""
    found: dict[str, Artist] = {}
    panel.set_ylim(-3, TOP + ROW * len(numbers))
    for row, (name, number) in enumerate(numbers.items()):
        margin, title = margins[name], NAMES.get(name, name)
        if margin is None:
            found[f"margin of {title}: none"] = Line2D([], [], linestyle="none")
            continue
        looks = _looks(number) | {"marker": "v", "linestyle": "none", "markevery": None}
        (mark,) = panel.plot([margin], [TOP + ROW * row], **looks)
        found[f"margin of {title}: all is won up to {margin:.3g} {unit}"] = mark
    return found
