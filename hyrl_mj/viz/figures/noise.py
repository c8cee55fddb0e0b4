"""The figure of the noise of a log: errors over time, their histogram, and their autocorrelation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import style as styles

from hyrl_mj.errors import BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.simulation import LogNoise
from hyrl_mj.system.picture import Picture
from hyrl_mj.viz import colours
from hyrl_mj.viz.figures.style import DPI, STYLE, WIDTH, grid_lines


def draw_noise(noise: LogNoise, path: Path) -> None:
    """Draws the errors of each column of a log, in its unit, and writes a PNG.

    These are the first 8 columns: more cannot be read.

    Raises:
        BadInput: the path does not end in .png.
    """
    if path.suffix != ".png":
        raise BadInput(f"--out {path} cannot be written: give a name that ends in .png")
    columns = [column for column in noise.columns if len(column.errors)][:8]
    # Letters of 13 points on 7.8 inches can be read where the figure is 400 pixels wide.
    sizes = {"font.size": 13, "axes.titlesize": 13, "legend.fontsize": 12}
    with styles.context(["default", STYLE, sizes]):
        figure = Picture(figsize=(WIDTH, 0.6 + 4.6 * len(columns)), layout="constrained")
        parts = figure.subfigures(len(columns), 1, squeeze=False).ravel()
        for part, c in zip(parts, columns, strict=True):
            panels = part.subplot_mosaic([["time", "time"], ["histogram", "correlation"]])
            for panel in panels.values():
                grid_lines(panel)
                panel.locator_params(nbins=5)
            time, histogram, correlation = panels.values()
            time.set(title=f"{c.name}: error over time", xlabel="t [s]")
            time.plot(c.times, c.errors, ".", color=colours.PALE, markersize=2, rasterized=True)
            looks = {"color": colours.MODES[0], "linewidth": 2.5}
            time.plot(c.times, c.slow, **looks, label="bias and drift")
            for sign in (-1, 1) if c.bound else ():
                bound = c.slow + sign * (c.bound + c.quantum / 2)
                label = {"label": "bound"} if sign == 1 else {}
                time.plot(c.times, bound, color=colours.MODES[1], linewidth=1, **label)
            time.margins(x=0)
            part.legend(loc="outside upper right", ncols=2)
            histogram.set(title="what is left", xlabel="error", yticks=[])
            histogram.hist(c.errors - c.slow, bins="auto", color=colours.PALE)
            for bound in np.array([-1, 1]) * (c.bound + c.quantum / 2):
                histogram.axvline(bound, color=colours.MODES[1], linewidth=2)
            correlation.set(title="autocorrelation", xlabel="lag [samples]", ylim=(-1.05, 1.05))
            correlation.vlines(np.arange(len(c.correlations)), 0, c.correlations, **looks)
        with artifacts.replacing(path) as png:
            figure.savefig(png, format="png", dpi=DPI)
