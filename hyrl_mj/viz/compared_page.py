"""The page of a comparison with what people would do instead, and its figure."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill as fill_text

import numpy as np
from matplotlib import style as matplotlib_style
from matplotlib.figure import Figure

from hyrl_mj.files import artifacts
from hyrl_mj.runs.compared import Compared
from hyrl_mj.viz import colours
from hyrl_mj.viz.compared_tables import ranked, result_table, sentences, tried_table
from hyrl_mj.viz.figures import style
from hyrl_mj.viz.report import fill, write
from hyrl_mj.viz.sweep_page import as_picture
from hyrl_mj.viz.sweep_tables import markdown


def draw(compared: Compared) -> Figure:
    """Draws for each alternative what it wins under the attack, and in the worst-case game."""
    names = ranked(compared)[::-1]
    with matplotlib_style.context(["default", style.STYLE]):
        figure = Figure(figsize=(style.WIDTH, 1.2 + 0.36 * len(names)), layout="constrained")
        panel = figure.subplots()
        for place, name in enumerate(names):
            colour = {"hyrl": colours.MODES[1], "policy": colours.POLICY}.get(
                name, colours.MODES[0]
            )
            for which, shift, marker, filled in (
                ("worst", 0.0, "o", True),
                ("won", 0.22, "D", False),
            ):
                values = 100 * np.array(compared.values(name, which))
                if not len(values):
                    continue
                at = place - shift
                panel.plot(
                    [values.min(), values.max()], [at, at], color=colour, linewidth=2.5, alpha=0.5
                )
                face = colour if filled else colours.WHITE
                panel.plot(
                    values.mean(), at, marker, color=colour, markerfacecolor=face,
                    markersize=7 if filled else 5,
                )  # fmt: skip
        panel.set_yticks(
            range(len(names)), [fill_text(compared.of(name)[0].title, 40) for name in names]
        )
        for tick, name in zip(panel.get_yticklabels(), names, strict=True):
            tick.set_fontweight("bold" if name == "hyrl" else "normal")
        panel.set(xlim=(-2, 102), ylim=(-0.6, len(names) - 0.4), xlabel="starts won [%]")
        for label, marker, face in (
            ("under attack, of all starts", "o", colours.PALE),
            ("in the worst-case game, of the winnable starts", "D", colours.WHITE),
        ):
            panel.plot([], [], marker, color=colours.PALE, markerfacecolor=face, label=label)
        style.grid_lines(panel)
        panel.spines[["top", "right"]].set_visible(False)
        style.legend(figure)
    return figure


def write_page(compared: Compared, folder: Path) -> None:
    """Writes `compare.html`, and its figure as `compare.png`, into the folder of a comparison."""
    figure = draw(compared)
    with artifacts.replacing(folder / "compare.png") as temporary:
        figure.savefig(
            temporary, format="png", dpi=style.DPI, bbox_inches="tight", pad_inches=style.PAD
        )
    caption = (
        "The share of the starts that each alternative wins under the attack, half of them near M*, and, "
        "where it can be played, in the worst-case game; the mean over the seeds, and a line from the least "
        "to the greatest."
    )
    page = fill(
        "compare.html",
        folder,
        compared=compared,
        seeds=sorted({row.seed for row in compared.rows}),
        picture=as_picture("compare", figure, caption),
        results=(results := result_table(compared)),
        tried=tried_table(compared),
        sentences=[*sentences(compared)],
        markdown=markdown(results),
    )
    write(folder / "compare.html", page)
