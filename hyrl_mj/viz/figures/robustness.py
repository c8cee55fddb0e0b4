"""The figures of the worst-case game: what becomes of runs from each state, and the share that is won."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, NoNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle, Wedge

from hyrl_mj.game import LIMIT, MAP_CLASSES, OVER, Score, Wins
from hyrl_mj.sets import Chart, Grid
from hyrl_mj.viz import colours
from hyrl_mj.viz.figures import charts, style
from hyrl_mj.viz.figures.charts import INNER, OUTER, TICK
from hyrl_mj.viz.figures.shown import ShownGame
from hyrl_mj.viz.tables import NAMES, percent

# Of MAP_CLASSES, in their order; colour-blind readers can tell them apart, too.
CLASS_COLOURS = ("#7cc0e8", "#f2c530", "#009e73", colours.MODES[1], "#5c2a6b", style.GREY)
SENTENCES = dict(enumerate(MAP_CLASSES)) | {
    OVER: "over: obstacle, or the run has ended",
}
# Radius of the dots of M*: inside the ring, where they hide no class.
CRITICAL = 0.6
# Of the curves: ink as the policy's path in the replay, then blue, purple and vermilion.
CURVE_COLOURS = (style.POLICY_COLOUR, colours.MODES[0], "#aa4499", colours.MODES[1])
LIMIT_COLOUR = "#a9dcc9"
Looks = dict[str, Any]
# The limit of any controller is broad and pale, so that curves on it can be seen.
LIMIT_LOOKS: Looks = {"color": LIMIT_COLOUR, "linewidth": 7, "solid_capstyle": "butt"}
LIMIT_DASHED: Looks = {"linestyle": (0, (1.2, 0.5)), "linewidth": 4}
MARKERS = "osD^"
# Nodes of a curve from one marker to the next.
MARK_EVERY = 6
# Rows of the marks of margins, above the curves [%].
TOP, ROW = 105, 5


def draw_robustness_map(shown: ShownGame, path: Path | None = None) -> Figure:
    """Draws a map for each controller: what becomes of runs from each state."""
    task, result, maps = shown.task, shown.result, shown.maps
    section = shown.section
    names, grid = result.controllers, maps.grid(section.chart)
    columns = min(len(names), style.COLUMNS)
    rows = -(-len(names) // style.COLUMNS)
    draw = _ring if charts.is_ring(section.chart) else _box
    where, unit = task.noise_on(result.everywhere)
    estimated = ", an estimate" if result.estimate else ""
    title = f"the worst noise on {where} up to eps = {maps.eps:g} {unit}{estimated}"
    with style.drawing(path, 1.6 + rows * _panel_height(section.chart), section, title) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for k in np.unique(np.concatenate([maps.map[name] for name in names])):
            charts.legend_field(panels[0], SENTENCES[k], CLASS_COLOURS[k])
        for panel, name in zip(panels, names, strict=False):
            draw(panel, shown, grid, maps.map[name])
            panel.set_title(NAMES.get(name, name), fontsize=11, fontweight="bold", pad=50)
            score = max(result.scores[name], key=lambda score: score.eps)
            style.note_above(panel, _note(score), 0.5, 6)
        for panel in panels[len(names) :]:
            panel.set_axis_off()
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


def _box(panel: Axes, shown: ShownGame, grid: Grid, classes: np.ndarray) -> None:
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
    for colour, line in style.CASING:
        box = Rectangle((x, y), width, height, edgecolor=colour, linewidth=line, **looks)
        panel.add_patch(box)
    z = shown.critical.points
    charts.dots(panel, np.hstack([z, np.full_like(z, 0.5)]) if strip else z)


def _ring(panel: Axes, shown: ShownGame, grid: Grid, classes: np.ndarray) -> None:
    """Draws classes (N,) of nodes as arcs of a ring."""
    task = shown.task
    charts.arcs(panel, task.chart, classes, CLASS_COLOURS, OUTER, INNER)
    charts.ring(panel, task.chart, (OUTER, INNER))
    ends = task.start_low[0], task.start_high[0]
    first, last = (360 * end / task.chart.sides[0] for end in ends)  # [degrees]
    if last - first < 360 - 360 / len(classes):
        looks: Looks = {"width": 0.03, "color": style.INK, "linewidth": 0}
        panel.add_patch(Wedge((0, 0), TICK, first, last, label="start region", **looks))
    charts.spokes(panel, task.chart, shown.critical.points, CRITICAL)


# ---- the curve


def draw_robustness_curve(shown: ShownGame, path: Path | None = None) -> Figure:
    """Draws what each controller wins against the noise bound.

    Where runs last for ever, a second panel shows the worst time to arrival.
    """
    task, result = shown.task, shown.result
    names, curve = result.controllers, result.curve
    eps = np.array(curve.eps)
    run_eps = max(score.eps for score in result.scores[names[0]])
    # A controller keeps its colour whichever others are in the figure.
    known = list(dict.fromkeys(["policy", "hyrl", *names]))
    numbers = {name: known.index(name) for name in names}
    where, unit = task.noise_on(result.everywhere)
    heights = (3.6, 2.0) if result.lasting else (3.6,)
    title = "what is won against the worst noise"
    with style.drawing(path, 2.0 + sum(heights), shown.section, title) as figure:
        rows: Looks = {"nrows": len(heights), "height_ratios": heights}
        panels = figure.subplots(sharex=True, squeeze=False, **rows).ravel()
        shares, limit = panels[0], curve.wins[LIMIT]
        _won(shares, "limit of this split", eps, limit, LIMIT_LOOKS, LIMIT_DASHED)
        for name, number in numbers.items():
            looks, dashed = _looks(number), _dashed(number)
            _won(shares, NAMES.get(name, name), eps, curve.wins[name], looks, dashed)
        label = "share of the start region that this split can win"
        shares.plot(eps, 100 * np.array(curve.winnable), color=style.PALE, linewidth=1, label=label)
        _margins(shares, shown, numbers, unit)
        shares.set(ylabel="winnable starts [%]", yticks=range(0, 101, 20))
        if result.lasting:
            for name, number in numbers.items():
                wins = curve.wins[name]
                looks = _looks(number) | ({} if _same(wins) else _dashed(number))
                panels[1].plot(eps, np.array(wins.time_any, dtype=float), **looks)
            panels[1].set_ylabel("worst time to arrival,\nnodes that are won [s]")
        for panel in panels:
            panel.axvline(run_eps, color=style.INK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
            style.grid_lines(panel)
            panel.spines[["top", "right"]].set_visible(False)
        limits = (0, 1.01 * max(eps[-1], run_eps))
        panels[-1].set(xlabel=f"noise bound eps on {where} [{unit}]", xlim=limits)
        note = f"this run: eps = {run_eps:g} {unit}"
        style.note_above(shares, note, run_eps, 3, ("data", "axes fraction"))
        style.legend(figure, handlelength=3.2)
    return figure


def _won(panel: Axes, title: str, eps: np.ndarray, wins: Wins, looks: Looks, dashed: Looks) -> None:
    """Draws what is proved, and dashed what is proved from every start mode if that differs.

    Between it and what is won on the nodes lies the gap. Of a controller that could not be bounded, and of
    the limit, what is won on the nodes is drawn.
    """
    proved = bool(wins.proved)
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
        panel.plot(eps, 100 * np.array(some), label=label, **looks | dashed)


def _same(wins: Wins) -> bool:
    """Returns whether the start mode makes no difference."""
    pairs = (wins.won, wins.won_any), (wins.proved, wins.proved_any)
    return all(np.allclose(own, some, atol=1e-9) for own, some in pairs)


def _looks(number: int) -> Looks:
    """Returns the line style of a controller's curve.

    Where curves coincide the first is thin and lies on thicker ones, and no marker hides another.
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


def _dashed(number: int) -> Looks:
    """Returns how the line style differs where the controller is started in every mode."""
    return {
        "linestyle": "--",
        "linewidth": 1.5,
        "markerfacecolor": style.PAPER,
        "markeredgewidth": 1.5,
        "markevery": ((2 * number + 1) % MARK_EVERY, MARK_EVERY),
    }


def _margins(panel: Axes, shown: ShownGame, numbers: dict[str, int], unit: str) -> None:
    """Marks the margins above the curves, a row for each controller."""
    panel.set_ylim(-3, TOP + ROW * len(numbers))
    for row, (name, number) in enumerate(numbers.items()):
        margin, label = shown.result.margin[name], f"margin of {NAMES.get(name, name)}"
        if margin is None:
            panel.plot([], [], linestyle="none", label=f"{label}: none")
            continue
        looks = _looks(number) | {"marker": "v", "linestyle": "none", "markevery": None}
        label += f": no node is lost up to {margin:.3g} {unit}"
        panel.plot([margin], [TOP + ROW * row], label=label, **looks)
