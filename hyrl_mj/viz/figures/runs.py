"""Runs of the hybrid controller beside those of the stage-1 policy."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hyrl_mj.tasks import Task
from hyrl_mj.viz.figures.charts import Artists, angles_on, plane, set_point_lines
from hyrl_mj.viz.figures.paths import View, ends, hybrid_way, plane_view, policy_way, time_view
from hyrl_mj.viz.figures.shown import ShownRun
from hyrl_mj.viz.figures.style import WIDTH, axis_label, drawing, head, legend, noise_label


def draw_runs(shown: ShownRun, path: Path | None = None) -> Figure:
    """Draws the hybrid controller and the policy under the same noise, a column for each start mode.

    Of a chart with two coordinates the paths are shown in its plane, else each coordinate over time.
    Only the paper's starts ("start0", ...) are drawn.

    Args:
        shown: has the replays.
        path: where the PNG and the PDF are written, if anywhere.

    Returns:
        The figure.
    """
    task, replays = shown.whole, shown.replays
    loops = list(dict.fromkeys(who for _, who in replays if who != "policy"))
    starts = list(dict.fromkeys(start for start, _ in replays if start.startswith("start")))
    flat = task.chart.dimension == 2
    coordinates = [0] if flat else list(range(task.chart.dimension))
    first = replays[starts[0], "policy"]
    with drawing(path, (WIDTH, 1.6 + 3.4 * len(coordinates))) as figure:
        noise = noise_label(task, first.noise, first.bound)
        head(figure, task, f"HyRL and {shown.policy_title}\nunder the same {noise}")
        panels = figure.subplots(
            len(coordinates), len(loops), sharex=True, sharey="row", squeeze=False
        )
        fixed: Artists = {}
        ways: Artists = {}
        marks: Artists = {}
        for row, coordinate in zip(panels, coordinates, strict=True):
            for panel, loop in zip(row, loops, strict=True):
                view, handles = _run_panel(panel, task, coordinate)
                fixed |= handles
                for start in starts:
                    ours, policy = replays[start, loop], replays[start, "policy"]
                    ways |= hybrid_way(panel, task, view, ours, linewidth=2.0)
                    marks |= ends(panel, task, view, ours)
                    ways[shown.policy_title] = policy_way(panel, view, policy, linewidth=1.0)
                    marks |= ends(panel, task, view, policy)
                if not flat:
                    fixed |= set_point_lines(panel, task, coordinate)
        for panel, loop in zip(panels[0], loops, strict=True):
            mode = int(loop.removeprefix("hyrl_q"))
            panel.set_title(f"started in q0 = {task.scene.mode_name(mode)}", fontweight="bold")
        for panel in panels.ravel():
            panel.label_outer()
        legend(figure, dict(sorted(ways.items())) | marks | fixed)
    return figure


def _run_panel(panel: Axes, task: Task, coordinate: int) -> tuple[View, Artists]:
    """Prepares a panel for runs; returns how they lie in it, and the legend's entries."""
    if task.chart.dimension == 2:
        return plane_view(task), plane(panel, task)
    panel.set(xlabel="time [s]", ylabel=axis_label(task, coordinate))
    panel.grid(color="#e6e8eb", linewidth=0.8)
    angles_on(panel.yaxis, task, coordinate)
    return time_view(coordinate), {}
