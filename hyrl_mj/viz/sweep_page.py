"""The page of a sweep: its tables, what is won against the noise bound, and links to the runs."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from urllib.parse import quote

import numpy as np
from matplotlib import style as matplotlib_style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from hyrl_mj.sweeps import DONE, Row, Setting, Sweep
from hyrl_mj.viz import sweep_tables as tables
from hyrl_mj.viz.figures import style
from hyrl_mj.viz.report import Picture, data_uri, environment, write

# Curves: name in `Curve`, label, colour and line style.
LINES = (
    ("policy", "RL policy", style.POLICY_COLOUR, "-"),
    ("hyrl", "HyRL, own q0", style.mode_colour(0), "-"),
    ("hyrl_any", "HyRL, any q0", style.mode_colour(0), "--"),
)
HEIGHT = 2.7  # [inches] of a row of panels


def write_page(sweep: Sweep, folder: Path) -> None:
    """Writes `sweep.html` into the folder of a sweep."""
    groups = sweep.groups()
    page = (
        environment()
        .get_template("sweep.html")
        .render(
            name=folder.resolve().name,
            common=sweep.common,
            summary=(summary := tables.summary_table(sweep)),
            markdown=tables.markdown(summary),
            picture=_picture(groups),
            groups=[
                (setting, tables.run_table(rows), _links(rows), tables.worst(rows))
                for setting, rows in groups.items()
            ],
            open_rows=[row for row in sweep.rows if row.state != DONE],
            done=sum(row.state == DONE for row in sweep.rows),
            total=len(sweep.rows),
        )
    )
    write(folder / "sweep.html", page)


def _links(rows: list[Row]) -> list[tuple[Row, str]]:
    """Returns the finished runs with the addresses of their reports."""
    return [(row, f"{quote(row.name)}/report.html") for row in rows if row.state == DONE]


def _picture(groups: dict[Setting, list[Row]]) -> Picture | None:
    """Returns the curves of all settings, or None where the worst-case game was not played."""
    curves = {
        setting: played
        for setting, rows in groups.items()
        if (played := [row for row in rows if row.curve.eps])
    }
    if not curves:
        return None
    figure = draw_curves(curves)
    content = BytesIO()
    figure.savefig(content, format="png", dpi=style.DPI, bbox_inches="tight", pad_inches=style.PAD)
    with Image.open(content) as image:
        size = image.size
    caption = (
        "What is won of the winnable starts against the worst noise of up to a bound: the line is the median "
        "over the seeds, the band reaches from the least to the greatest."
    )
    return Picture("curves", data_uri(content.getvalue(), "image/png"), *size, caption)


def draw_curves(curves: dict[Setting, list[Row]]) -> Figure:
    """Draws a panel for each setting, with a band over its seeds for each controller."""
    columns = min(len(curves), style.COLUMNS)
    count = -(-len(curves) // columns)
    with matplotlib_style.context(["default", style.STYLE]):
        figure = Figure(figsize=(style.WIDTH, 0.8 + HEIGHT * count), layout="constrained")
        panels = figure.subplots(count, columns, squeeze=False, sharey=True).ravel()
        for panel, (setting, rows) in zip(panels, curves.items(), strict=False):
            _draw(panel, rows)
            panel.set_title(f"{setting.title} ({len(rows)} seeds)")
            panel.axvline(
                setting.eps, color=style.INK, linewidth=1, linestyle=(0, (1, 2)), zorder=1
            )
            panel.set_xlabel("noise bound eps")
        for panel in panels[len(curves) :]:
            panel.set_visible(False)
        for panel in panels[::columns]:
            panel.set_ylabel("winnable starts won [%]")
        style.legend(figure, handlelength=3.2)
    return figure


def _draw(panel: Axes, rows: list[Row]) -> None:
    """Draws the median and the band of each controller."""
    eps = np.array(rows[0].curve.eps)
    for name, label, colour, dashes in LINES:
        shares = 100 * np.array([getattr(row.curve, name) for row in rows])
        panel.fill_between(
            eps, shares.min(axis=0), shares.max(axis=0), color=colour, alpha=0.18, lw=0
        )
        median = np.median(shares, axis=0)
        panel.plot(eps, median, color=colour, linestyle=dashes, linewidth=1.8, label=label)
    panel.set(ylim=(0, 102), xlim=(0, eps[-1]))
    style.grid_lines(panel)
    panel.spines[["top", "right"]].set_visible(False)
