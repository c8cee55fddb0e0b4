"""The summary table that ends a run."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from rich.console import Console
from rich.table import Table

from hyrl_mj.pipeline import Run
from hyrl_mj.simulation import HybridArc


def print_summary(run: Run) -> None:
    """Print how policy and hybrid controller did from the replay starts, under the same noise."""
    arcs = replayed(run)
    modes = run.controller.modes
    table = Table(
        title=f"{run.task.name}: alternating noise {run.settings.noise:g}, seed {run.settings.seed}"
    )
    units = dict.fromkeys(run.task.chart.units)
    table.add_column(f"start ({', '.join(run.task.chart.names)}) in {', '.join(units)}")
    table.add_column(f"policy ({run.policy.algorithm.upper()})")
    for q in modes:
        table.add_column(f"HyRL, q0 = {q}")
    for row, columns in sorted(arcs.items(), key=lambda item: item[0] == "critical"):
        start = _point(run, columns["policy"].z[0])
        cells = [_cell(run, columns[c]) for c in ("policy", *(f"hyrl_q{q}" for q in modes))]
        table.add_row(f"{start} on M*" if row == "critical" else start, *cells)
    # Off a terminal rich assumes 80 columns, which would cut the cells.
    console = Console()
    Console(width=None if console.is_terminal else 120).print(table)
    print(run.critical_set.sentence(run.task))
    for q in modes:
        print(f"mode {q}: {extent(run, q)}")
    hyrl = [
        a
        for name, row in arcs.items()
        if name != "critical"
        for k, a in row.items()
        if k != "policy"
    ]
    reached = sum(arc.outcome == "reached" for arc in hyrl)
    print(f"HyRL reaches the set-point from {reached} of {len(hyrl)} of the paper's starts")
    video = run.path / "replay.mp4"
    print(f"run directory {run.path}" + (f", video {video}" if video.is_file() else ", no video"))


def replayed(run: Run) -> dict[str, dict[str, HybridArc]]:
    """The replay arcs by start and controller: {"start0": {"policy": ..., "hyrl_q0": ...}, ...}."""
    rows: dict[str, dict[str, HybridArc]] = defaultdict(dict)
    for path in sorted((run.path / "arcs").glob("*.npz")):
        start, _, controller = path.stem.partition("_")
        if start != "latest":
            rows[start][controller] = HybridArc.load(path)
    return dict(rows)


def extent(run: Run, mode: int) -> str:
    """How far a mode's extended set reaches, for people."""
    task, extended = run.task, run.extended_sets
    members = extended.sets[extended.modes.index(mode)]
    name = task.mode_names[mode] if mode < len(task.mode_names) else "?"
    if task.chart.dimension == 1 and task.chart.periodic[0]:
        inside = members.mask
        nodes = members.grid.nodes[:, 0]
        ends = nodes[inside & ~np.roll(inside, -1)], nodes[inside & ~np.roll(inside, 1)]
        arcs = ", ".join(
            f"{a / np.pi:.3f} pi to {b / np.pi:.3f} pi" for b, a in zip(*ends, strict=True)
        )
        return f"{name}, extended set {arcs}"
    return f"{name}, extended set {100 * members.mask.mean():.1f}% of the chart"


def _cell(run: Run, arc: HybridArc) -> str:
    return f"{arc.outcome} {arc.t[-1]:.1f} s {_point(run, run.task.chart.wrap(arc.z[-1:])[0])}"


def _point(run: Run, z: np.ndarray) -> str:
    """A chart point (d,), to a thousandth."""
    return f"({', '.join(f'{v + 0.0:.3f}' for v in np.round(z, 3))})"
