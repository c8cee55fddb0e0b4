"""Where the policy, and each mode of the hybrid controller, moves the robot from each state."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hyrl_mj.errors import BadInput
from hyrl_mj.policies import Policy
from hyrl_mj.runs.directory import Run
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.tasks import Task
from hyrl_mj.viz.colours import BAD, POLICY, mode_colour
from hyrl_mj.viz.figures import charts, style
from hyrl_mj.viz.figures.charts import INNER, OUTER
from hyrl_mj.viz.section import Section

CELLS, RING = 24, 48  # arrows along the longest side of a plane, and around a ring
# The longest arrow is as long as the arrows are apart.
LOOKS: dict[str, Any] = {"pivot": "mid", "angles": "xy", "scale_units": "xy", "scale": 1}
LOOKS |= {"width": 0.005, "headwidth": 4, "headlength": 5, "zorder": 3}


def vector_field(run: Run) -> Figure:
    """Draws the vector fields of the closed loops without noise: the policy's, and each mode's in its set.

    An arrow is the motion of the chart point in one sample. Of a chart with more than two coordinates a
    section is shown, and of a robot with inertia the motion from the state in which an episode begins there.

    Args:
        run: whose stages up to the policies of the modes are finished.

    Returns:
        The figure, with a panel for each loop.

    Raises:
        BadInput: this is no run, or the chart is neither a plane nor a ring, nor has a plane section.
    """
    if not hasattr(run, "extended_sets"):
        raise BadInput(f"{run!r:.80} is no run: give that of hyrl_mj.load_run(PATH)")
    task, section = run.task, Section(run.task)
    charts.check_drawable(task)
    sets = section.extended_sets(run.extended_sets)
    panels: list[tuple[str, str, Policy, GridSet | None]]
    panels = [(run.policy_title, POLICY, run.steady, None)]
    for i, mode in enumerate(sets.modes):
        title = f"HyRL, mode {task.mode_name(mode)}"
        panels.append((title, mode_colour(i), run.controller.policies[mode], sets.sets[i]))
    ring = charts.is_ring(task.chart)
    grid = Grid(section.chart, (RING,)) if ring else Grid.with_cells(section.chart, CELLS)
    rows = -(-len(panels) // style.COLUMNS)
    width, height = (1.0, 1.0) if ring else section.chart.sides
    each = 0.85 * style.WIDTH / style.COLUMNS * height / width + 0.6  # [inches]
    critical = section.critical_set(run).points
    with style.drawing(1.2 + rows * each, section, "motion in one sample, without noise") as figure:
        axes = figure.subplots(rows, style.COLUMNS, squeeze=False).ravel()
        for panel, (title, colour, policy, members) in zip(axes, panels, strict=False):
            panel.set_title(title, color=colour, fontweight="bold")
            nodes = grid.nodes[~section.failed(grid.nodes)] if not ring else grid.nodes
            inside = np.ones(len(nodes), bool) if members is None else members.contains(nodes)
            z = nodes[inside]
            arrows = one_sample(task, policy, section.lift(z))[:, : section.chart.dimension]
            if members is not None and not ring:
                charts.region(panel, members, f"{colour}20")
            longest = np.nanmax(np.linalg.norm(arrows, axis=1), initial=1e-9)
            arrows = 0.9 * arrows / longest
            if ring:
                at, arrows = _along(section, z, arrows)
            else:
                at, arrows = z, arrows * grid.spacing.max()
            _background(panel, section, critical)
            panel.quiver(*at.T, *arrows.T, color=colour, **LOOKS)
        for panel in axes[len(panels) :]:
            panel.set_axis_off()
        style.legend(figure)
    return figure


def one_sample(task: Task, policy: Policy, z: np.ndarray) -> np.ndarray:
    """Returns how far (n, d) a policy moves the robot from chart points (n, d) in one sample."""
    plant = task.placed(z)
    plant.step(policy.act(plant.measurement))
    return task.chart.difference(task.z(plant.measurement), z)


def _along(section: Section, z: np.ndarray, arrows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns points (n, 2) on a ring, and arrows (n, 2) along it, for values and arrows (n, 1)."""
    x, y = charts.on_ring(section.chart, z[:, 0])
    middle = (OUTER + INNER) / 2
    return middle * np.column_stack([x, y]), arrows * 2 * np.pi * middle / RING * np.column_stack(
        [-y, x]
    )


def _background(panel: Axes, section: Section, critical: np.ndarray) -> None:
    """Draws the plane or the ring, with set-point and M*."""
    if not charts.is_ring(section.chart):
        charts.plane(panel, section)
        charts.dots(panel, critical, BAD)
        return
    charts.ring(panel, section.chart, (OUTER, INNER))
    charts.spokes(panel, section.chart, critical, INNER - 0.06, BAD)
    if section.set_point is not None:
        charts.cross(panel, *np.ravel(charts.on_ring(section.chart, section.set_point)))
