"""The summary table that ends a run."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from hyrl_mj.pipeline import replay_sentence
from hyrl_mj.run_directory import Run
from hyrl_mj.simulation import HybridArc


def print_summary(run: Run) -> None:
    """Print how policy and hybrid controller did from the replay starts, under the same noise."""
    arcs = run.arcs()
    modes = run.extended_sets.modes
    columns = {"policy": f"policy ({run.policy.algorithm.upper()})"}
    columns |= {f"hyrl_q{q}": f"HyRL, q0 = {q}" for q in modes}
    units = dict.fromkeys(run.task.chart.units)
    noise = f"alternating noise {run.settings.noise:g}"
    table = Table(title=f"{run.task.name}: {noise}, seed {run.settings.seed}")
    table.add_column(f"start ({', '.join(run.task.chart.names)}) in {', '.join(units)}")
    for heading in columns.values():
        table.add_column(heading)
    for start in dict.fromkeys(start for start, _ in arcs):
        point = _point(run, arcs[start, "policy"].z[0])
        cells = [_cell(run, arcs[start, who]) for who in columns]
        table.add_row(f"{point} on M*" if start == "critical" else point, *cells)
    # Off a terminal rich assumes 80 columns, which would cut the cells.
    console = Console()
    Console(width=None if console.is_terminal else 120).print(table)
    print(run.critical_set.sentence(run.task))
    for q in modes:
        print(f"mode {run.task.mode_name(q)}: {extent(run, q)}")
    print(replay_sentence(run, arcs))
    video = run.path / "replay.mp4"
    print(f"run directory {run.path}" + (f", video {video}" if video.is_file() else ", no video"))


def extent(run: Run, mode: int) -> str:
    """How far a mode's extended set reaches, for people."""
    members = run.extended_sets.sets[run.extended_sets.modes.index(mode)]
    inside, chart = members.mask, run.task.chart
    if inside.all():
        return "extended set everything"
    if chart.dimension > 1 or not chart.periodic[0]:
        return f"extended set {100 * inside.mean():.1f}% of the chart"
    angles = members.grid.nodes[:, 0] / np.pi
    starts = np.flatnonzero(inside & ~np.roll(inside, 1))
    ends = np.flatnonzero(inside & ~np.roll(inside, -1))
    # An arc that crosses the seam ends before the first start.
    ends = np.roll(ends, -1) if len(ends) and ends[0] < starts[0] else ends
    arcs = [f"{angles[a]:.3f} pi to {angles[b]:.3f} pi" for a, b in zip(starts, ends, strict=True)]
    return f"extended set {', '.join(arcs)}"


def _cell(run: Run, arc: HybridArc) -> str:
    return f"{arc.outcome} {arc.t[-1]:.1f} s {_point(run, run.task.chart.wrap(arc.z[-1:])[0])}"


def _point(run: Run, z: np.ndarray) -> str:
    """A chart point (d,), to a thousandth."""
    return f"({', '.join(f'{v + 0.0:.3f}' for v in np.round(z, 3))})"
