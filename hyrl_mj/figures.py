"""Pictures of the worst-case game: where it is won, and how much of it at which noise bound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle, Wedge

from hyrl_mj import artifacts
from hyrl_mj.critical_set import CriticalSet
from hyrl_mj.robustness import LIMIT, MAP_CLASSES, OVER, UNWINNABLE
from hyrl_mj.sets import Grid
from hyrl_mj.tasks.base import Task

DPI = 200  # [pixels/inch]
WIDTH, PAD = 7.8, 0.1  # [inches] of a picture, and of the margin around it
COLUMNS = 2  # panels beside each other
INK, PAPER, PALE = "#232830", "#ffffff", "#8b919b"
# As MAP_CLASSES: told apart by colour-blind people, too.
CLASS_COLOURS = ("#7cc0e8", "#f2c530", "#d55e00", "#5c2a6b", "#dcdee2")
SENTENCES = dict(enumerate(MAP_CLASSES)) | {
    UNWINNABLE: "not winnable, whatever the controller",
    OVER: "over: obstacle, or the run has ended",
}
TITLES = {"policy": "RL policy", "hyrl": "HyRL"}
# Of the curves: ink as the policy's path in the replay, then blue, purple and vermilion.
CURVE_COLOURS = ("#2d323c", "#0072b2", "#aa4499", "#d55e00")
LIMIT_COLOUR = "#a9dcc9"
MARKERS = "osD^"
# Nodes of a curve from one marker to the next.
MARK_EVERY = 6
# Rows of the marks of margins, above the curves [%].
TOP, ROW = 105, 5
# Width of lines over a map, the paper around the ink first.
CASING = ((PAPER, 2.8), (INK, 1.4))
# Radii of a ring, its ticks and their labels; the dots of M* lie inside, where they hide no class.
OUTER, INNER, CRITICAL, TICK, LABEL, EDGE = 1.0, 0.7, 0.6, 1.05, 1.18, 1.25
STYLE = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.edgecolor": INK,
    "axes.linewidth": 0.8,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
}


def robustness_map(
    task: Task,
    content: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    critical: CriticalSet,
    path: Path,
) -> None:
    """Write a PNG with a panel for each controller: what becomes of runs from each state.

    Args:
        task: what was played; its chart has two coordinates, or one.
        content: of `examine`.
        arrays: of `examine`: `map_<controller>` (N,) int, an index into `MAP_CLASSES` for each node of
            the grid of `grid_counts` (d,) nodes, and the noise bound `eps` that they hold for.
        critical: M*, drawn over it.
        path: of the picture.
    """
    names, grid = _controllers(content), Grid.from_counts(task.chart, arrays["grid_counts"])
    rows = -(-len(names) // COLUMNS)
    columns = min(len(names), COLUMNS)
    ring = task.chart.dimension == 1 and task.chart.periodic[0]
    with _figure(path, (WIDTH, 1.6 + rows * _panel_height(task, ring))) as figure:
        where, unit = _noisy(task, content["everywhere"])
        figure.suptitle(
            f"{_title(task)}: the worst noise on {where} up to eps = {arrays['eps']:g} {unit}",
            fontsize=12,
            fontweight="bold",
        )
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        found: dict[str, Artist] = {}
        for panel, name in zip(panels, names, strict=False):
            draw = _ring if ring else _box
            found |= draw(panel, task, grid, arrays[f"map_{name}"], critical)
            _head(panel, name, max(content["scores"][name], key=lambda score: score["eps"]))
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        classes = np.unique(np.concatenate([arrays[f"map_{name}"] for name in names]))
        handles = {
            SENTENCES[k]: Patch(facecolor=CLASS_COLOURS[k], edgecolor=INK, linewidth=0.5)
            for k in classes
        } | found
        figure.legend(
            list(handles.values()), list(handles), loc="outside lower center", ncols=COLUMNS
        )


def robustness_curve(task: Task, content: Mapping[str, Any], path: Path) -> None:
    """Write a PNG of what each controller wins against the noise bound.

    Where runs last for ever, a panel below has the worst time to arrival.

    Args:
        task: what was played.
        content: of `examine`.
        path: of the picture.
    """
    names, curve = _controllers(content), content["curve"]
    eps, scores = np.array(curve["eps"]), content["scores"]
    run_eps = max(score["eps"] for score in scores[names[0]])
    lasting = any(score["excursion"] is not None for name in names for score in scores[name])
    # A controller has its colour whoever else is in the picture.
    known = list(dict.fromkeys([*TITLES, *names]))
    numbers = {name: known.index(name) for name in names}
    where, unit = _noisy(task, content["everywhere"])
    heights = (3.6, 2.0) if lasting else (3.6,)
    with _figure(path, (WIDTH, 2.0 + sum(heights))) as figure:
        figure.suptitle(
            f"{_title(task)}: what is won against the worst noise", fontsize=12, fontweight="bold"
        )
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
        figure.legend(
            list(handles.values()),
            list(handles),
            loc="outside lower center",
            ncols=COLUMNS,
            handlelength=3.2,
        )


@contextmanager
def _figure(path: Path, size: tuple[float, float]) -> Iterator[Figure]:
    """A figure of a size [inches], written to `path` when the block ends well."""
    # The user's own matplotlibrc must not change what is drawn here.
    with style.context(["default", STYLE]):
        layout = ConstrainedLayoutEngine(compress=True, h_pad=PAD, w_pad=PAD)
        figure = Figure(figsize=size, layout=layout)
        yield figure
        with artifacts.replacing(path) as temporary:
            # Panels of a fixed aspect leave room, which is cut off.
            figure.savefig(temporary, format="png", dpi=DPI, bbox_inches="tight", pad_inches=PAD)


# ---- words


def _controllers(content: Mapping[str, Any]) -> list[str]:
    return [name for name in content["scores"] if name != LIMIT]


def _title(task: Task) -> str:
    return task.name.replace("_", " ").capitalize()


def _noisy(task: Task, everywhere: bool) -> tuple[str, str]:
    """The chart coordinates that noise acts on, and their unit: "x and y", "m"."""
    hit = task.noise_in_chart(1.0, everywhere) > 0
    names = [name for name, h in zip(task.chart.names, hit, strict=True) if h]
    units = [unit for unit, h in zip(task.chart.units, hit, strict=True) if h]
    return " and ".join(names), ", ".join(dict.fromkeys(units))


def _axis_label(task: Task, axis: int) -> str:
    return f"{task.chart.names[axis]} [{task.chart.units[axis]}]"


def _percent(share: float) -> str:
    """A share in percent; only what is everything is called 100%, and only nothing 0%."""
    if 0 < share < 1:
        return "<0.1%" if share < 5e-4 else ">99.9%" if share >= 0.9995 else f"{100 * share:.1f}%"
    return f"{100 * share:.0f}%"


def _angle(value: float) -> str:
    """An angle in multiples of pi: "3π/2"."""
    turns = Fraction(value / np.pi).limit_denominator(12)
    number = {0: "0", 1: "π", -1: "-π"}.get(turns.numerator, f"{turns.numerator}π")
    return number if turns.denominator == 1 else f"{number}/{turns.denominator}"


# ---- maps


def _panel_height(task: Task, ring: bool) -> float:
    """Height [inches] that a panel takes with its title and labels."""
    if ring:
        return 4.1
    sides = np.subtract(task.chart.high, task.chart.low)
    return 1.1 + (float(3.2 * sides[1] / sides[0]) if len(sides) == 2 else 0.5)


def _head(panel: Axes, name: str, score: Mapping[str, Any]) -> None:
    """Write the controller and what it wins over its panel."""
    won, won_any = _percent(score["won"]), _percent(score["won_any"])
    panel.set_title(TITLES.get(name, name), fontsize=11, fontweight="bold", pad=36)
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
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel=_axis_label(task, 0))
    panel.set(yticks=[]) if flat else panel.set(ylabel=_axis_label(task, 1))
    sides = end[0] - start[0], end[1] - start[1]
    for colour, width in CASING:
        box = Rectangle(
            start, *sides, fill=False, edgecolor=colour, linewidth=width, clip_on=False, zorder=3
        )
        panel.add_patch(box)
    z = critical.points
    points = _points(panel, z[:, 0], np.full(len(z), 0.5) if flat else z[:, 1])
    return {"start region": box} | points


def _corner(ends: Sequence[float], side: float) -> tuple[float, float]:
    """A corner of a chart (d,) in the plane of the picture."""
    return float(ends[0]), float(ends[1]) if len(ends) > 1 else side


def _ring(
    panel: Axes, task: Task, grid: Grid, classes: np.ndarray, critical: CriticalSet
) -> dict[str, Artist]:
    """Draw a map over a periodic coordinate as arcs of a ring; returns as `_box`."""
    low, period = task.chart.low[0], task.chart.high[0] - task.chart.low[0]
    step = 360 / len(classes)  # [degrees] from node to node
    origin = 360 * low / period
    # Arcs begin half-way between nodes of different classes; one class all round has no beginning.
    begins = np.flatnonzero(classes != np.roll(classes, 1))
    ends = np.append(begins[1:], begins[:1] + len(classes))
    if not len(begins):
        begins, ends = np.array([0]), np.array([len(classes)])
    # The shortest arcs last, with an edge: those of a single node are seen, too.
    for arc in np.argsort(begins - ends):
        theta = origin + step * (begins[arc] - 0.5), origin + step * (ends[arc] - 0.5)
        colour = CLASS_COLOURS[classes[begins[arc]]]
        panel.add_patch(
            Wedge((0, 0), OUTER, *theta, width=OUTER - INNER, color=colour, linewidth=0.8)
        )
    for radius in (OUTER, INNER):
        panel.add_patch(Circle((0, 0), radius, fill=False, edgecolor=INK, linewidth=0.8))
    # Quarters of the period, as hours on a clock face.
    for quarter in low + period * np.arange(4) / 4:
        at = np.array(_on_ring(task, quarter))
        panel.plot(*np.outer(at, (OUTER, TICK)), color=INK, linewidth=0.8)
        text = _angle(quarter) if task.chart.units[0] == "rad" else f"{quarter:g}"
        panel.text(LABEL * at[0], LABEL * at[1], text, ha="center", va="center")
    panel.text(0, 0, _axis_label(task, 0), ha="center", va="center")
    panel.set(xlim=(-EDGE, EDGE), ylim=(-EDGE, EDGE), aspect="equal", anchor="S")
    panel.set_axis_off()
    found: dict[str, Artist] = {}
    first, last = (360 * corner[0] / period for corner in (task.start_low, task.start_high))
    if last - first < 360 - step:
        found["start region"] = panel.add_patch(
            Wedge((0, 0), TICK, first, last, width=0.03, color=INK, linewidth=0)
        )
    x, y = _on_ring(task, critical.points[:, 0])
    for colour, width in CASING:
        panel.plot(
            [CRITICAL * x, OUTER * x],
            [CRITICAL * y, OUTER * y],
            color=colour,
            linewidth=width,
            zorder=3,
        )
    return found | _points(panel, CRITICAL * x, CRITICAL * y)


def _on_ring(task: Task, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where values (n,) of a periodic coordinate lie on the unit circle: (n,), (n,)."""
    angle = 2 * np.pi * np.asarray(z) / (task.chart.high[0] - task.chart.low[0])
    return np.cos(angle), np.sin(angle)


def _points(panel: Axes, x: np.ndarray, y: np.ndarray) -> dict[str, Artist]:
    """Mark the points of M* (n,), (n,); returns as `_box`."""
    if not len(x):
        return {}
    # All the paper first: where points lie close together they make one line.
    for colour, size in ((PAPER, 5.0), (INK, 3.6)):
        (dots,) = panel.plot(
            x, y, "o", markersize=size, color=colour, markeredgewidth=0, clip_on=False, zorder=4
        )
    return {"critical set M*": dots}


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
    title, looks = TITLES.get(name, name), _looks(number)
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
        margin, title = margins[name], TITLES.get(name, name)
        if margin is None:
            found[f"margin of {title}: none"] = Line2D([], [], linestyle="none")
            continue
        looks = _looks(number) | {"marker": "v", "linestyle": "none", "markevery": None}
        (mark,) = panel.plot([margin], [TOP + ROW * row], **looks)
        found[f"margin of {title}: all is won up to {margin:.3g} {unit}"] = mark
    return found
