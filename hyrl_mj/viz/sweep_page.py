"""The page of a sweep: its tables, what is won against the noise bound, and links to the runs."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from itertools import chain
from pathlib import Path
from urllib.parse import quote

import numpy as np
from matplotlib import style as matplotlib_style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from hyrl_mj.judging.game import Curve
from hyrl_mj.runs.directory import load_run
from hyrl_mj.runs.improvement import LEAST_SEEDS, profile
from hyrl_mj.runs.sweeps import Row, Setting, Sweep
from hyrl_mj.viz import colours, sweep_tables as tables
from hyrl_mj.viz.figures import style
from hyrl_mj.viz.report import Picture, data_uri, fill, write


def write_page(sweep: Sweep, folder: Path) -> None:
    """Writes `sweep.html` into the folder of a sweep."""
    groups = sweep.groups()
    page = fill(
        "sweep.html",
        folder,
        common=sweep.common,
        summary=(summary := tables.summary_table(sweep)),
        markdown=tables.markdown(summary),
        improved=tables.improvement_table(sweep),
        pictures=[*_pictures(sweep, folder)],
        groups=[
            (setting, tables.run_table(rows), _links(rows), tables.worst(rows))
            for setting, rows in groups.items()
        ],
        open_rows=[row for row in sweep.rows if not row.done],
        done=sum(row.done for row in sweep.rows),
        total=len(sweep.rows),
    )
    write(folder / "sweep.html", page)


def _links(rows: list[Row]) -> dict[str, str]:
    """Returns the addresses of the reports of the finished runs, by name."""
    return {row.name: f"{quote(row.name)}/report.html" for row in rows if row.done}


def _pictures(sweep: Sweep, folder: Path) -> Iterator[Picture]:
    """Yields the curves of settings for which the worst-case game was played, and profiles of many runs."""
    curves: dict[Setting, list[Curve]] = {}
    for row in chain.from_iterable(sweep.groups().values()):
        game = load_run(folder / row.name).robustness.deciding if row.done else None
        if game is not None:
            curves.setdefault(row.setting, []).append(game.curve)
    if curves:
        yield as_picture(
            "curves",
            draw_curves(curves),
            "What is won of the winnable starts against the worst noise of up to a bound: the line is the "
            "median over the seeds, the band reaches from the least to the greatest.",
        )
    if (profiles := draw_profiles(sweep)) is not None:
        yield as_picture(
            "profiles",
            profiles,
            "Performance profiles: the share of the runs of the sweep, over all settings and seeds, in which "
            "a controller wins at least so much.",
        )


def as_picture(name: str, figure: Figure, caption: str) -> Picture:
    """Returns a figure as a picture of a page."""
    content = BytesIO()
    figure.savefig(content, format="png", dpi=style.DPI, bbox_inches="tight", pad_inches=style.PAD)
    with Image.open(content) as image:
        size = image.size
    return Picture(name, data_uri(content.getvalue(), "image/png"), *size, caption)


def draw_profiles(sweep: Sweep) -> Figure | None:
    """Draws the share of runs that win at least so much, a panel for each figure; None with few runs."""
    thresholds = np.linspace(0, 1, 201)
    names = ("proved", "not_broken", "withstood_attack")
    found = {name: profile(sweep.rows, name, thresholds) for name in names}
    shown = {name: shares for name, shares in found.items() if len(shares) == 2}
    if not shown or sum(row.done for row in sweep.rows) < LEAST_SEEDS:
        return None
    with matplotlib_style.context(["default", style.STYLE]):
        figure = Figure(figsize=(style.WIDTH, 3.2), layout="constrained")
        panels = figure.subplots(1, len(shown), squeeze=False, sharey=True).ravel()
        for panel, (name, shares) in zip(panels, shown.items(), strict=True):
            for who, label, colour in (
                ("policy", "RL policy", colours.POLICY),
                ("hyrl", "HyRL", colours.MODES[0]),
            ):
                panel.plot(100 * thresholds, 100 * shares[who], color=colour, label=label)
            panel.set(xlim=(0, 100), ylim=(0, 102), xlabel=f"{tables.FIGURES[name][0]} [%]")
            style.grid_lines(panel)
            panel.spines[["top", "right"]].set_visible(False)
        panels[0].set_ylabel("runs with at least so much [%]")
        style.legend(figure, handlelength=3.2)
    return figure


def draw_curves(curves: dict[Setting, list[Curve]]) -> Figure:
    """Draws a panel for each setting, with a band over its seeds for each controller."""
    columns = min(len(curves), style.COLUMNS)
    count = -(-len(curves) // columns)
    with matplotlib_style.context(["default", style.STYLE]):
        figure = Figure(figsize=(style.WIDTH, 0.8 + 2.7 * count), layout="constrained")
        panels = figure.subplots(count, columns, squeeze=False, sharey=True).ravel()
        for panel, (setting, group) in zip(panels, curves.items(), strict=False):
            _draw(panel, group)
            panel.set_title(f"{setting.title} ({len(group)} seeds)")
            panel.axvline(
                setting.eps, color=colours.INK, linewidth=1, linestyle=(0, (1, 2)), zorder=1
            )
            panel.set_xlabel("noise bound eps")
        for panel in panels[len(curves) :]:
            panel.set_visible(False)
        for panel in panels[::columns]:
            panel.set_ylabel("winnable starts won [%]")
        style.legend(figure, handlelength=3.2)
    return figure


def _draw(panel: Axes, curves: list[Curve]) -> None:
    """Draws the median and the band of each controller."""
    eps = np.array(curves[0].eps)
    alike = [curve.wins for curve in curves if curve.eps == curves[0].eps]
    for who, column, label, colour, dashes in (  # of `WinningShares`
        ("policy", "won", "RL policy", colours.POLICY, "-"),
        ("hyrl", "proved", "HyRL proved, own q0", colours.MODES[0], "-"),
        ("hyrl", "proved_any", "HyRL proved, any q0", colours.MODES[0], "--"),
    ):
        shares = 100 * np.array([getattr(wins[who], column) for wins in alike])
        panel.fill_between(
            eps, shares.min(axis=0), shares.max(axis=0), color=colour, alpha=0.18, lw=0
        )
        median = np.median(shares, axis=0)
        panel.plot(eps, median, color=colour, linestyle=dashes, linewidth=1.8, label=label)
    panel.set(ylim=(0, 102), xlim=(0, eps[-1]))
    style.grid_lines(panel)
    panel.spines[["top", "right"]].set_visible(False)
