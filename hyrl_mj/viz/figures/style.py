"""The style of all figures: colours, sizes, labels, and how the files are written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from hyrl_mj import artifacts
from hyrl_mj.tasks import Task
from hyrl_mj.viz import colours

DPI = 200  # [pixels/inch]
WIDTH, PAD = 7.8, 0.1  # [inches] of a figure, and of the margin around it
COLUMNS = 2  # panels beside each other, and columns of a legend
INK, PAPER, PALE = colours.INK, colours.WHITE, "#8b919b"
GREY = "#dcdee2"  # states at which a run is over
POLICY_COLOUR, RED, PALE_RED = colours.POLICY, colours.BAD, "#f4c9c7"
GREEN = colours.GOOD  # of the set-point
# The colours of the modes, mixed with white.
_TINTS = ("#d6e8f3", "#fbe4d3", "#f1dcee", "#e1f2fb")
# Colour and width of lines over a map: a white edge, then the line.
CASING = ((PAPER, 2.8), (INK, 1.4))
_IN_INK = ("axes.edgecolor", "text.color", "axes.labelcolor", "xtick.color", "ytick.color")
STYLE = dict.fromkeys(_IN_INK, INK) | {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.linewidth": 0.8,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    # Text in a PDF stays text, which can be searched and edited.
    "pdf.fonttype": 42,
}


def mode_colour(mode: int) -> str:
    """Returns the colour of a mode, as in the replay."""
    return colours.MODES[mode % len(colours.MODES)]


def mode_tint(mode: int) -> str:
    """Returns a pale shade of the colour of a mode, for areas."""
    return _TINTS[mode % len(_TINTS)]


@contextmanager
def drawing(path: Path | None, height: float, task: Task, title: str) -> Iterator[Figure]:
    """Gives a figure to draw on, and writes it as PNG and PDF when the block ends without an error.

    Args:
        path: where the PNG is written, and the PDF beside it; None writes nothing.
        height: of the figure [inches], before empty margins are cut off.
        task: the title of the figure begins with its name and, if the chart is cut, where.
        title: how the title of the figure goes on.
    """
    where = f" at {task.chart.section}" if task.chart.section else ""
    # The user's own matplotlibrc must not change the figure.
    with style.context(["default", STYLE]):
        layout = ConstrainedLayoutEngine(compress=True, h_pad=PAD, w_pad=PAD)
        figure = Figure(figsize=(WIDTH, height), layout=layout)
        figure.suptitle(f"{task_title(task)}{where}: {title}", fontsize=12, fontweight="bold")
        yield figure
        if path is None:
            return
        with (
            artifacts.replacing(path.with_suffix(".png")) as png,
            artifacts.replacing(path.with_suffix(".pdf")) as pdf,
        ):
            # Panels of a fixed aspect leave empty margins, which are cut off.
            cut: dict[str, Any] = {"dpi": DPI, "bbox_inches": "tight", "pad_inches": PAD}
            figure.savefig(png, format="png", **cut)
            # Without the date the same figure is the same file.
            figure.savefig(pdf, format="pdf", metadata={"CreationDate": None}, **cut)


def grid_lines(panel: Axes) -> None:
    """Draws pale grid lines below everything else in a panel."""
    panel.grid(color="#e6e8eb", linewidth=0.8)
    panel.set_axisbelow(True)


def note_above(panel: Axes, text: str, x: float, gap: float, coords: Any = "axes fraction") -> None:
    """Writes a text above a panel, centred at x, with a gap [points]."""
    panel.annotate(
        text, (x, 1), xycoords=coords, xytext=(0, gap), textcoords="offset points", ha="center"
    )


def legend(figure: Figure, by_label: bool = False, **looks: Any) -> None:
    """Writes the labels of all panels below a figure, each once, in the order of drawing or sorted."""
    entries: dict[str, Artist] = {}
    for panel in figure.axes:
        artists, labels = panel.get_legend_handles_labels()
        entries |= dict(zip(labels, artists, strict=True))
    order = sorted(entries) if by_label else list(entries)
    artists = [entries[label] for label in order]
    figure.legend(artists, order, loc="outside lower center", ncols=COLUMNS, **looks)


# ---- labels


def task_title(task: Task) -> str:
    """Returns the title of a task: "Unit circle"."""
    return task.scene.title or task.name.replace("_", " ").capitalize()


def noise_label(task: Task, kind: str, eps: float) -> str:
    """Returns the label of a noise: "alternating noise on y, eps = 0.1 m"."""
    where, unit = task.noise_on()
    return f"{kind} noise on {where}, eps = {eps:g} {unit}"


def axis_label(task: Task, axis: int) -> str:
    """Returns a coordinate of the chart with its unit: "x [m]"."""
    return f"{task.chart.names[axis]} [{task.chart.units[axis]}]"


def angle(value: float) -> str:
    """Returns an angle in multiples of pi: "3π/2"."""
    turns = Fraction(value / np.pi).limit_denominator(12)
    number = {0: "0", 1: "π", -1: "-π"}.get(turns.numerator, f"{turns.numerator}π")
    return number if turns.denominator == 1 else f"{number}/{turns.denominator}"
