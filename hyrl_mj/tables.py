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
    _console().print(table)
    print(run.critical_set.sentence(run.task))
    for q in modes:
        print(f"mode {run.task.mode_name(q)}: {extent(run, q)}")
    print(replay_sentence(run, arcs))
    print_robustness(run)
    video = run.path / "replay.mp4"
    print(f"run directory {run.path}" + (f", video {video}" if video.is_file() else ", no video"))


def print_robustness(run: Run) -> None:
    """Print the scores of the worst-case game and the counts of the noisy episodes."""
    content, task = run.robustness, run.task
    if content["game"] is not None:
        scores = content["game"]["scores"]
        lasting = scores["hyrl"][0]["excursion"] is not None
        table = Table(title=f"{task.name}: worst case over all noise signals, exact game")
        for heading in ("noise", "start region", "policy", "HyRL", "HyRL, any q0", "limit, any q0"):
            table.add_column(heading)
        if lasting:
            for heading in ("worst time", "any q0", "excursion"):
                table.add_column(heading)
        for policy, hyrl, limit in zip(
            *(scores[k] for k in ("policy", "hyrl", "limit")), strict=True
        ):
            shares = [policy["won"], hyrl["won"], hyrl["won_any"], limit["won_any"]]
            row = [f"{hyrl['eps']:g}", f"{_percent(hyrl['winnable'])} winnable"]
            row += [f"{_percent(share)} won" for share in shares]
            if lasting:
                row += [
                    f"{hyrl['time']:.2f} s",
                    f"{hyrl['time_any']:.2f} s",
                    f"{hyrl['excursion']:.3f}",
                ]
            table.add_row(*row)
        _console().print(table)
        margins = content["game"]["margin"]
        for who, label in (("policy", "policy"), ("hyrl", "HyRL")):
            known = margins[who] is not None
            print(
                f"{label}: "
                + (
                    f"the whole winnable start region is won up to noise {margins[who]:.4g}"
                    if known
                    else "not all winnable starts are won even without noise"
                )
            )
    if content["episodes"]:
        table = Table(title=f"{task.name}: noisy episodes")
        for heading in ("noise", "controller", "starts", "episodes", "reached", "95%", "outcomes"):
            table.add_column(heading)
        for r in content["episodes"]:
            low, high = r["interval"]
            table.add_row(
                f"{r['noise']} {r['eps']:g}", r["controller"], r["region"], f"{r['episodes']:,}",
                _percent(r["reached"]), f"{_percent(low)} - {_percent(high)}",
                ", ".join(f"{k} {v:,}" for k, v in r["outcomes"].items()),
            )  # fmt: skip
        _console().print(table)


def _percent(share: float) -> str:
    """A share in percent; only what is everything is called 100%."""
    text = f"{100 * share:.2f}"
    return f"{'>99.99' if text == '100.00' and share < 1 else text}%"


def _console() -> Console:
    # Off a terminal rich assumes 80 columns, which would cut the cells.
    console = Console()
    return Console(width=None if console.is_terminal else 150)


def extent(run: Run, mode: int) -> str:
    """How far a mode's extended set reaches, for people."""
    members = run.extended_sets.sets[run.extended_sets.modes.index(mode)]
    inside, chart = members.mask, run.task.chart
    if inside.all():
        return "extended set everything"
    if chart.dimension > 1 or not chart.periodic[0]:
        return f"extended set {100 * inside.mean():.1f}% of the chart"
    pieces = [f"{a / np.pi:.3f} pi to {b / np.pi:.3f} pi" for a, b in members.pieces()]
    return f"extended set {', '.join(pieces)}"


def _cell(run: Run, arc: HybridArc) -> str:
    return f"{arc.outcome} {arc.t[-1]:.1f} s {_point(run, run.task.chart.wrap(arc.z[-1:])[0])}"


def _point(run: Run, z: np.ndarray) -> str:
    """A chart point (d,), to a thousandth."""
    return f"({', '.join(f'{v + 0.0:.3f}' for v in np.round(z, 3))})"
