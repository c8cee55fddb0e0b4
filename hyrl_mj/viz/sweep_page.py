"""The page of a sweep: its tables, what is won against the noise bound, and links to the runs."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hyrl_mj.judging.game import Curve
from hyrl_mj.runs.directory import load_run
from hyrl_mj.runs.improvement import LEAST_SEEDS, profile
from hyrl_mj.runs.sweeps import Setting, Sweep
from hyrl_mj.viz import colours, pages, sweep_tables as tables
from hyrl_mj.viz.figures import style
from hyrl_mj.viz.pages import Picture


def write_page(sweep: Sweep, folder: Path) -> None:
    """Writes `sweep.html` into the folder of a sweep."""
    summary, improved = tables.summary_table(sweep), tables.improvement_table(sweep)
    more = [] if improved is None else [improved]
    sections: list[pages.Section] = [
        ("Over the seeds", [summary, *more, *_pictures(sweep, folder)])
    ]
    if left := [f"{row.name}: {row.sentence or row.state}" for row in sweep.rows if not row.done]:
        sections.append(("Runs that are not done", [left]))
    sections.append(("The runs", [*_runs(sweep)]))
    common, name = sweep.common, pages.name_of(folder)
    of = [f"preset {common.preset}"]
    of += [] if common.horizon is None else [f"horizon {common.horizon} s"]
    of += [f"{setting} = {value}" for setting, value in common.set.items()]
    page = pages.fill(
        heading=f"Hysteresis-Based RL, sweep {name}",
        title=f"Sweep {name}",
        subtitle=f"{sum(row.done for row in sweep.rows)} of {len(sweep.rows)} runs are done, "
        f"{', '.join(of)}.",
        sections=[*sections, pages.to_paste(summary)],
    )
    pages.write(folder / "sweep.html", page)


def _runs(sweep: Sweep) -> Iterator[pages.Part]:
    """Yields a table of the runs of each setting, and links to their reports."""
    for rows in sweep.groups().values():
        yield tables.run_table(rows)
        links = {
            row.name: Markup('<a href="{}/report.html">{{}}</a>').format(quote(row.name))
            for row in rows
            if row.done
        }
        if (worst := tables.worst(rows)) is not None:
            link = links[worst.name].format(f"that of seed {worst.seed}")
            yield Markup("<p>The worst run is {}: {}, {}.</p>").format(
                link, worst.verdict, worst.sentence
            )
        if len(links) > 1:
            seeds = [link.format(name.rpartition("-")[2]) for name, link in links.items()]
            yield Markup("<p>Reports by seed: {}.</p>").format(Markup(", ").join(seeds))


def _pictures(sweep: Sweep, folder: Path) -> Iterator[Picture]:
    """Yields the curves of settings for which the worst-case game was played, and profiles of many runs."""
    curves: dict[Setting, list[Curve]] = {}
    for row in chain.from_iterable(sweep.groups().values()):
        game = load_run(folder / row.name).robustness.deciding if row.done else None
        if game is not None:
            curves.setdefault(row.setting, []).append(game.curve)
    if curves:
        yield pages.as_picture(
            "curves",
            draw_curves(curves),
            "What is won of the winnable starts against the worst noise of up to a bound: the line is the "
            "median over the seeds, the band reaches from the least to the greatest.",
        )
    if (profiles := draw_profiles(sweep)) is not None:
        yield pages.as_picture(
            "profiles",
            profiles,
            "Performance profiles: the share of the runs of the sweep, over all settings and seeds, in which "
            "a controller wins at least so much.",
        )


def draw_profiles(sweep: Sweep) -> Figure | None:
    """Draws the share of runs that win at least so much, a panel for each figure; None with few runs."""
    thresholds = np.linspace(0, 1, 201)
    names = ("proved", "not_broken", "withstood_attack")
    found = {name: profile(sweep.rows, name, thresholds) for name in names}
    shown = {name: shares for name, shares in found.items() if len(shares) == 2}
    if not shown or sum(row.done for row in sweep.rows) < LEAST_SEEDS:
        return None
    with style.plotting(3.2) as figure:
        panels = figure.subplots(1, len(shown), squeeze=False, sharey=True).ravel()
        for panel, (name, shares) in zip(panels, shown.items(), strict=True):
            for who, label, colour in (
                ("policy", "RL policy", colours.POLICY),
                ("hyrl", "HyRL", colours.MODES[0]),
            ):
                panel.plot(100 * thresholds, 100 * shares[who], color=colour, label=label)
            panel.set(
                xlim=(0, 100), ylim=(0, 102), xlabel=f"{''.join(tables.FIGURES[name][:2])} [%]"
            )
        panels[0].set_ylabel("runs with at least so much [%]")
    return figure


def draw_curves(curves: dict[Setting, list[Curve]]) -> Figure:
    """Draws a panel for each setting, with a band over its seeds for each controller."""
    columns = min(len(curves), style.COLUMNS)
    count = -(-len(curves) // columns)
    with style.plotting(0.8 + 2.7 * count) as figure:
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
    return figure


def _draw(panel: Axes, curves: list[Curve]) -> None:
    """Draws the median and the band of each controller."""
    eps = np.array(curves[0].eps)
    alike = [curve.wins for curve in curves if curve.eps == curves[0].eps]
    # Of controllers that could not be bounded nothing is proved: what they win on the nodes is drawn.
    kind = "proved" if all(wins["hyrl"].proved for wins in alike) else "won"
    for who, column, label, colour, dashes in (  # of `WinningShares`
        ("policy", "won", "RL policy", colours.POLICY, "-"),
        ("hyrl", kind, f"HyRL {kind}, own q0", colours.MODES[0], "-"),
        ("hyrl", f"{kind}_any", f"HyRL {kind}, any q0", colours.MODES[0], "--"),
    ):
        shares = 100 * np.array([getattr(wins[who], column) for wins in alike])
        panel.fill_between(
            eps, shares.min(axis=0), shares.max(axis=0), color=colour, alpha=0.18, lw=0
        )
        median = np.median(shares, axis=0)
        panel.plot(eps, median, color=colour, linestyle=dashes, linewidth=1.8, label=label)
    panel.set(ylim=(0, 102), xlim=(0, eps[-1]))
