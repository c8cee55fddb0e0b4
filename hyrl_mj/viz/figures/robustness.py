"""The figures of the worst-case game: what becomes of runs from each state, and the share that is won."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, NoNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle, Wedge

from hyrl_mj.judging.game import LIMIT, MapClass, Score, WinningShares
from hyrl_mj.sets import Chart, Grid
from hyrl_mj.viz import colours
from hyrl_mj.viz.figures import charts, style
from hyrl_mj.viz.figures.charts import INNER, OUTER, TICK
from hyrl_mj.viz.figures.shown import Shown
from hyrl_mj.viz.tables import NAMES, percent

# Of `MapClass`, in their order; colour-blind readers can tell them apart, too.
CLASS_COLOURS = ("#7cc0e8", "#f2c530", "#009e73", colours.MODES[1], "#5c2a6b", colours.GREY)
Looks = dict[str, Any]
# The curves by controller: every sixth node has a marker. Where curves coincide that of the policy is thin
# and lies on the thicker one, and no marker hides another. The limit is broad and pale, so that curves on it
# can be seen.
CURVES: dict[str, Looks] = {
    "policy": {
        "color": colours.POLICY, "linewidth": 1.5, "zorder": 4, "clip_on": False,
        "marker": "o", "markersize": 6, "markevery": (0, 6),
    },
    "hyrl": {
        "color": colours.MODES[0], "linewidth": 2.8, "zorder": 3.5, "clip_on": False,
        "marker": "s", "markersize": 6, "markevery": (2, 6),
    },
    LIMIT: {"color": "#a9dcc9", "linewidth": 7, "solid_capstyle": "butt"},
}  # fmt: skip


def draw_robustness_map(shown: Shown) -> Figure:
    """Draws a map for each controller: what becomes of runs from each state."""
    task, result, maps = shown.task, shown.result, shown.maps
    section = shown.section
    names, grid = result.controllers, maps.grid(section.chart)
    draw = _ring if charts.is_ring(section.chart) else _box
    estimated = ", an estimate" if result.estimate else ""
    title = f"the worst noise of up to {task.noise_text(maps.eps, result.everywhere)}{estimated}"
    with style.drawing(1.6 + _panel_height(section.chart), section, title) as figure:
        panels = figure.subplots(1, len(names), squeeze=False).ravel()
        for k in np.unique(np.concatenate([maps.map[name] for name in names])):
            label = (
                "over: obstacle, or the run has ended" if k == MapClass.OVER else MapClass(k).label
            )
            charts.legend_field(panels[0], label, CLASS_COLOURS[k])
        for panel, name in zip(panels, names, strict=True):
            draw(panel, shown, grid, maps.map[name])
            panel.set_title(NAMES[name], fontsize=11, fontweight="bold", pad=50)
            score = max(result.scores[name], key=lambda score: score.eps)
            style.note_above(panel, _note(score), 0.5, 6)
        style.legend(figure)
    return figure


def _note(score: Score) -> str:
    """Returns what is proved and what is lost of the winnable starts, in three lines."""
    lost = f"{percent(1 - score.not_broken)} known to be lost"
    if score.proved is None or score.proved_any is None:
        return f"of the winnable starts\nnothing is proved,\n{lost}"
    own, some = percent(score.proved), percent(score.proved_any)
    modes = "from every start mode" if own == some else f"{some} from every start mode"
    return f"{own} of the winnable starts proved,\n{modes},\n{lost}"


def _panel_height(chart: Chart) -> float:
    """Returns the height [inches] of a panel with its title and labels."""
    if charts.is_ring(chart):
        return 4.1
    sides = chart.sides
    return 1.1 + (float(3.2 * sides[1] / sides[0]) if len(sides) == 2 else 0.5)


def _box(panel: Axes, shown: Shown, grid: Grid, classes: np.ndarray) -> None:
    """Draws classes (N,) of nodes as an image over the chart; one coordinate is a strip of height 1."""
    section, chart = shown.section, shown.section.chart
    strip = chart.dimension == 1
    charts.image(panel, grid, classes, cmap=ListedColormap(CLASS_COLOURS), norm=NoNorm())
    low, high = [*chart.low, 0][:2], [*chart.high, 1][:2]
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    charts.label_axis(panel.xaxis, chart, 0)
    if strip:
        panel.set(yticks=[], aspect=0.12 * chart.sides[0])
    else:
        charts.label_axis(panel.yaxis, chart, 1)
    x, y = [*section.start_low, 0][:2]
    width, height = np.subtract([*section.start_high, 1][:2], (x, y))
    looks: Looks = {"fill": False, "zorder": 3, "clip_on": False, "label": "start region"}
    for colour, line in ((colours.WHITE, 2.8), (colours.INK, 1.4)):
        box = Rectangle((x, y), width, height, edgecolor=colour, linewidth=line, **looks)
        panel.add_patch(box)
    z = shown.critical.points
    charts.dots(panel, np.hstack([z, np.full_like(z, 0.5)]) if strip else z)


def _ring(panel: Axes, shown: Shown, grid: Grid, classes: np.ndarray) -> None:
    """Draws classes (N,) of nodes as arcs of a ring."""
    task = shown.task
    charts.arcs(panel, task.chart, classes, CLASS_COLOURS, OUTER, INNER)
    charts.ring(panel, task.chart, (OUTER, INNER))
    ends = task.start_low[0], task.start_high[0]
    first, last = (360 * end / task.chart.sides[0] for end in ends)  # [degrees]
    if last - first < 360 - 360 / len(classes):
        looks: Looks = {"width": 0.03, "color": colours.INK, "linewidth": 0}
        panel.add_patch(Wedge((0, 0), TICK, first, last, label="start region", **looks))
    charts.spokes(panel, task.chart, shown.critical.points, 0.6)  # inside: they hide no class


# ---- the curve


def draw_robustness_curve(shown: Shown) -> Figure:
    """Draws what each controller wins against the noise bound.

    Where runs last for ever, a second panel shows the worst time to arrival.
    """
    task, result = shown.task, shown.result
    names, curve = result.controllers, result.curve
    eps = np.array(curve.eps)
    run_eps = max(score.eps for score in result.scores[names[0]])
    where, unit = task.noise_on(result.everywhere)
    heights = (3.6, 2.0) if result.lasting else (3.6,)
    title = "what is won against the worst noise"
    with style.drawing(2.0 + sum(heights), shown.section, title) as figure:
        rows: Looks = {"nrows": len(heights), "height_ratios": heights}
        panels = figure.subplots(sharex=True, squeeze=False, **rows).ravel()
        shares = panels[0]
        _won(shares, "limit of this split", eps, curve.wins[LIMIT], LIMIT)
        for name in names:
            _won(shares, NAMES[name], eps, curve.wins[name], name)
        label = "share of the start region that this split can win"
        shares.plot(
            eps, 100 * np.array(curve.winnable), color=colours.PALE, linewidth=1, label=label
        )
        _margins(shares, shown, unit)
        shares.set(ylabel="winnable starts [%]", yticks=range(0, 101, 20))
        if result.lasting:
            for name in names:
                wins = curve.wins[name]
                looks = CURVES[name] if _same(wins) else _dashed(name)
                panels[1].plot(eps, np.array(wins.time_any, dtype=float), **looks)
            panels[1].set_ylabel("worst time to arrival,\nnodes that are won [s]")
        for panel in panels:
            panel.axvline(run_eps, color=colours.INK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
            style.open_panel(panel)
        limits = (0, 1.01 * max(eps[-1], run_eps))
        panels[-1].set(xlabel=f"noise bound eps on {where} [{unit}]", xlim=limits)
        note = f"this run: eps = {run_eps:g} {unit}"
        style.note_above(shares, note, run_eps, 3, ("data", "axes fraction"))
        style.legend(figure, handlelength=3.2)
    return figure


def _won(panel: Axes, title: str, eps: np.ndarray, wins: WinningShares, name: str) -> None:
    """Draws what is proved, and dashed what is proved from every start mode if that differs.

    Between it and what is won on the nodes lies the gap. Of a controller that could not be bounded, and of
    the limit, what is won on the nodes is drawn.
    """
    proved, looks = bool(wins.proved), CURVES[name]
    own, some = (wins.proved, wins.proved_any) if proved else (wins.won, wins.won_any)
    title = f"{title}, proved" if proved else title
    label = title if _same(wins) else f"{title}, picks the start mode"
    panel.plot(eps, 100 * np.array(own), label=label, **looks)
    if proved:
        label = "gap to what is won on the nodes"
        gap: Looks = {"color": looks["color"], "alpha": 0.18, "linewidth": 0, "label": label}
        panel.fill_between(eps, 100 * np.array(own), 100 * np.array(wins.won), **gap)
    if not _same(wins):
        label = f"{title}, from every start mode"
        panel.plot(eps, 100 * np.array(some), label=label, **_dashed(name))


def _same(wins: WinningShares) -> bool:
    """Returns whether the start mode makes no difference."""
    pairs = (wins.won, wins.won_any), (wins.proved, wins.proved_any)
    return all(np.allclose(own, some, atol=1e-9) for own, some in pairs)


def _dashed(name: str) -> Looks:
    """Returns the line style of what is won where a controller is started in every mode."""
    looks = CURVES[name] | {"linestyle": "--", "linewidth": 1.5}
    if name == LIMIT:
        return looks | {"linestyle": (0, (1.2, 0.5)), "linewidth": 4}
    first, every = looks["markevery"]
    return looks | {
        "markerfacecolor": colours.WHITE,
        "markeredgewidth": 1.5,
        "markevery": (first + 1, every),
    }


def _margins(panel: Axes, shown: Shown, unit: str) -> None:
    """Marks the margins above the curves, a row for each controller."""
    names = shown.result.controllers
    panel.set_ylim(-3, 105 + 5 * len(names))
    for row, name in enumerate(names):
        margin, label = shown.result.margin[name], f"margin of {NAMES[name]}"
        if margin is None:
            panel.plot([], [], linestyle="none", label=f"{label}: none")
            continue
        looks = CURVES[name] | {"marker": "v", "linestyle": "none", "markevery": None}
        label += f": {margin:.3g} {unit}"
        panel.plot([margin], [105 + 5 * row], label=label, **looks)
