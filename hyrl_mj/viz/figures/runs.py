"""Runs of the hybrid controller beside those of the stage-1 policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hyrl_mj.viz.figures import charts, paths, style
from hyrl_mj.viz.figures.shown import ShownRun


def draw_runs(shown: ShownRun, path: Path | None = None) -> Figure:
    """Draws the hybrid controller and the policy under the same noise, a column for each start mode.

    Of a chart with two coordinates the paths are shown in its plane, else each coordinate over time.
    Only the paper's starts ("start0", ...) are drawn.
    """
    task, replays, policy_title = shown.whole, shown.replays, shown.policy_title
    loops = list(dict.fromkeys(who for _, who in replays if who != "policy"))
    starts = list(dict.fromkeys(start for start, _ in replays if start.startswith("start")))
    plane = task.chart.dimension == 2
    rows = 1 if plane else task.chart.dimension
    first = replays[starts[0], "policy"]
    noise = style.noise_label(task, first.noise, first.bound)
    title = f"HyRL and {policy_title}\nunder the same {noise}"
    with style.drawing(path, 1.6 + 3.4 * rows, task, title) as figure:
        panels = figure.subplots(rows, len(loops), sharex=True, sharey="row", squeeze=False)
        for (coordinate, column), panel in np.ndenumerate(panels):
            if plane:
                view = paths.plane_view(task)
                charts.plane(panel, task)
            else:
                view = paths.time_view(panel, task, coordinate)
                style.grid_lines(panel)
            for start in starts:
                hybrid, policy = replays[start, loops[column]], replays[start, "policy"]
                paths.hybrid_way(panel, task, view, hybrid)
                paths.ends(panel, task, view, hybrid)
                paths.policy_way(panel, view, policy, linewidth=1.0, label=policy_title)
                paths.ends(panel, task, view, policy)
            if not plane:
                charts.set_point_lines(panel, task, coordinate)
            if coordinate == 0:
                mode = int(loops[column].removeprefix("hyrl_q"))
                panel.set_title(f"started in q0 = {task.scene.mode_name(mode)}", fontweight="bold")
            panel.label_outer()
        style.legend(figure, by_label=True)
    return figure
