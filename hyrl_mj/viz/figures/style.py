"""The style of all figures: colours, sizes, labels, and how the files are written."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from hyrl_mj.files import artifacts
from hyrl_mj.sets import Chart
from hyrl_mj.system.picture import Picture
from hyrl_mj.tasks import Task
from hyrl_mj.viz.colours import INK, mode_colour
from hyrl_mj.viz.section import Section

DPI = 200  # [pixels/inch]
WIDTH, PAD = 7.8, 0.1  # [inches] of a figure, and of the margin around it
COLUMNS = 2  # panels beside each other, and columns of a legend
STYLE = dict.fromkeys(
    ("axes.edgecolor", "text.color", "axes.labelcolor", "xtick.color", "ytick.color"), INK
) | {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.linewidth": 0.8,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    # Text in a PDF stays text, which can be searched and edited.
    "pdf.fonttype": 42,
    # A name is no formula, whatever dollars are in it.
    "text.parse_math": False,
}
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def mode_tint(place: int) -> str:
    """Returns a pale shade of the colour of the first (0), second, ... mode of a run, for areas."""
    red, green, blue = (1 - 0.22 * (1 - share) for share in to_rgb(mode_colour(place)))
    return to_hex((red, green, blue))


@contextmanager
def drawing(height: float, of: Task | Section, title: str) -> Iterator[Figure]:
    """Gives a figure to draw on.

    Args:
        height: of the figure [inches], before empty margins are cut off.
        of: the title of the figure begins with the name of the task and, of a section, where that is.
        title: how the title of the figure goes on.
    """
    task, where = (of.task, of.where) if isinstance(of, Section) else (of, "")
    # The user's own matplotlibrc must not change the figure.
    with style.context(["default", STYLE]):
        layout = ConstrainedLayoutEngine(compress=True, h_pad=PAD, w_pad=PAD)
        figure = Picture(figsize=(WIDTH, height), layout=layout)
        figure.suptitle(f"{task_title(task)}{where}: {title}", fontsize=12, fontweight="bold")
        yield figure


def write(figure: Figure, path: Path) -> None:
    """Writes a figure as a PNG to a path, and as a PDF beside it; both or none."""
    with (
        artifacts.replacing(path.with_suffix(".png")) as png,
        artifacts.replacing(path.with_suffix(".pdf")) as pdf,
    ):
        for file in (png, pdf):
            # On a full disk the writer of PDFs fails with an error about itself.
            content = BytesIO()
            save(figure, content, file.suffix[1:])
            file.write_bytes(content.getvalue())


@contextmanager
def plotting(height: float) -> Iterator[Figure]:
    """Gives a figure of curves to draw on, without a title, whose legend is written at the end."""
    with style.context(["default", STYLE]):
        figure = Picture(figsize=(WIDTH, height), layout="constrained")
        yield figure
        for panel in figure.axes:
            open_panel(panel)
        legend(figure, handlelength=3.2)


def save(figure: Figure, file: BytesIO, kind: str = "png") -> None:
    """Writes a figure without the empty margins that panels of a fixed aspect leave, and without the date."""
    metadata = {"CreationDate": None} if kind == "pdf" else None
    cut: dict[str, Any] = {"dpi": DPI, "bbox_inches": "tight", "pad_inches": PAD}
    with style.context(["default", STYLE]):
        figure.savefig(file, format=kind, metadata=metadata, **cut)


def open_panel(panel: Axes) -> None:
    """Gives a panel of curves grid lines, and no frame above and at the right."""
    grid_lines(panel)
    panel.spines[["top", "right"]].set_visible(False)


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
    """Writes the labels of all panels below a figure, each once, in the order of drawing or sorted.

    A label of artists of several types, as of a field and a line, has them above each other.
    """
    entries: dict[str, dict[type[Artist], Artist]] = {}
    for panel in figure.axes:
        for artist, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, {})[type(artist)] = artist
    order = sorted(entries, key=_in_order) if by_label else list(entries)
    artists: list[Any] = [tuple(entries[label].values()) for label in order]
    rows = -(-len(order) // COLUMNS)
    widths = [
        max(map(len, order[i : i + rows]), default=0) for i in range(0, len(order), rows or 1)
    ]
    columns = COLUMNS if sum(widths) <= 105 else 1  # letters that stand beside each other
    figure.legend(artists, order, loc="outside lower center", ncols=columns, **looks)


def _in_order(label: str) -> list[tuple[bool, int, str]]:
    """Returns a key by which labels are sorted like words, and numbers in them by their size."""
    parts = re.split(r"(\d+)", label)
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]


# ---- labels


def task_title(task: Task) -> str:
    """Returns the title of a task: "Unit circle"."""
    return task.scene.title or task.name.replace("_", " ").capitalize()


def set_label(mode: int, extended: bool = False) -> str:
    """Returns the label of the set of a mode: "M₀", or the extended one, "Mᵉˣᵗ₀"."""
    return f"M{'ᵉˣᵗ' * extended}{str(mode).translate(_SUBSCRIPTS)}"


def noise_label(task: Task, kind: str, eps: float) -> str:
    """Returns the label of a noise: "alternating noise, 0.1 m on y"."""
    return f"{kind} noise, {task.noise_text(eps)}"


def axis_label(chart: Chart, axis: int) -> str:
    """Returns a coordinate of the chart with its unit: "x [m]"."""
    return f"{chart.names[axis]} [{chart.units[axis]}]"


def angle(value: float) -> str:
    """Returns an angle in multiples of pi: "3π/2"."""
    turns = Fraction(value / np.pi).limit_denominator(12)
    number = {0: "0", 1: "π", -1: "-π"}.get(turns.numerator, f"{turns.numerator}π")
    return number if turns.denominator == 1 else f"{number}/{turns.denominator}"
