"""The page of a comparison with what people would do instead, and its figure."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill as fill_text

import numpy as np
from matplotlib.figure import Figure

from hyrl_mj.files import artifacts
from hyrl_mj.runs.compared import Compared
from hyrl_mj.viz import colours, pages
from hyrl_mj.viz.compared_tables import ranked, result_table, sentences, tried_table
from hyrl_mj.viz.figures import style

# What is drawn of each alternative, by its name in the figures of a row: the label, how far below the line
# of the alternative it is, the marker, its size, and whether it is filled.
DRAWN = {
    "worst": ("under attack, of all starts", 0.0, "o", 7, True),
    "won": ("in the worst-case game, of the winnable starts", 0.22, "D", 5, False),
}


def draw(compared: Compared) -> Figure:
    """Draws for each alternative what it wins under the attack, and in the worst-case game."""
    names = ranked(compared)[::-1]
    with style.plotting(1.2 + 0.36 * len(names)) as figure:
        panel = figure.subplots()
        own = {"hyrl": colours.MODES[1], "policy": colours.POLICY}
        for which, (label, shift, marker, size, filled) in DRAWN.items():
            for place, name in enumerate(names):
                colour = own.get(name, colours.MODES[0])
                values, at = 100 * np.array(compared.values(name, which)), place - shift
                if not len(values):
                    continue
                ends = [values.min(), values.max()]
                panel.plot(ends, [at, at], color=colour, linewidth=2.5, alpha=0.5)
                face = colour if filled else colours.WHITE
                panel.plot(
                    values.mean(), at, marker, color=colour, markerfacecolor=face, markersize=size
                )
            face = colours.PALE if filled else colours.WHITE
            panel.plot([], [], marker, color=colours.PALE, markerfacecolor=face, label=label)
        titles = [fill_text(compared.of(name)[0].title, 40) for name in names]
        panel.set_yticks(range(len(names)), titles)
        for tick, name in zip(panel.get_yticklabels(), names, strict=True):
            tick.set_fontweight("bold" if name == "hyrl" else "normal")
        panel.set(xlim=(-2, 102), ylim=(-0.6, len(names) - 0.4), xlabel="starts won [%]")
    return figure


def write_page(compared: Compared, folder: Path) -> None:
    """Writes `compare.html`, and its figure as `compare.png`, into the folder of a comparison."""
    picture = pages.as_picture(
        "compare",
        draw(compared),
        "The share of the starts that each alternative wins under the attack, half of them near M*, and, "
        "where it can be played, in the worst-case game; the mean over the seeds, and a line from the least "
        "to the greatest.",
    )
    with artifacts.replacing(folder / "compare.png") as temporary:
        temporary.write_bytes(picture.content)
    results, tried = result_table(compared), tried_table(compared)
    said = map(pages.paragraph, sentences(compared))
    sections: list[pages.Section] = [("Results", [*said, picture, results])]
    if tried is not None:
        sections.append(("How each alternative was tuned", [tried]))
    seeds = ", ".join(map(str, sorted({row.seed for row in compared.rows})))
    page = pages.fill(
        heading=f"Hysteresis-Based RL, comparison {pages.name_of(folder)}",
        title=f"{compared.task}: what would do instead",
        subtitle=f"Noise of up to {compared.eps}, preset {compared.preset}, seeds {seeds}.",
        sections=[*sections, pages.to_paste(results)],
    )
    pages.write(folder / "compare.html", page)
