#!/usr/bin/env python
"""The paper's figures, and its numbers beside ours: from finished runs, training what is missing.

    python scripts/reproduce_paper.py                            # runs/unit_circle, runs/vehicle
    python scripts/reproduce_paper.py --circle RUN --vehicle RUN --out DIR

Figures are written as PNG and PDF. The values under "ours" are computed from the runs.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj.errors import BadInput
from hyrl_mj.runs.arcs import policy_start_arcs
from hyrl_mj.system import progress
from hyrl_mj.system.streams import Streams
from hyrl_mj.viz import figures

# A line of the table: the quantity, the paper's value, ours, and a note.
Line = tuple[str, str, str, str]
FATES = {
    "crashed": "crashes",
    "stalled": "stalls",
    "out_of_bounds": "leaves the arena",
    "running": "not there yet",
}
# The paper's figures: our name of the figure, and the file, by task.
PAPER = {
    "unit_circle": {
        "policy": "fig2_ppo_circle",
        "extended_sets": "fig4_extended_sets_circle",
        "runs": "fig5_hyrl_circle",
    },
    "vehicle": {
        "overview": "fig1_intro",
        "policy": "fig3_dqn_vehicle",
        "extended_sets": "fig4_extended_sets_vehicle",
        "runs": "fig6_hyrl_vehicle",
    },
}
# Where ours differs on purpose.
SIZED = "sized to the noise *"
FOOTNOTE = (
    "* The extended sets overlap as far as the noise asks for. With the paper's T instead: "
    "hyrl-mj run unit_circle --horizon 0.5, and vehicle --horizon 0.3, each into another --out."
)


def opened(path: Path, task: str) -> hyrl_mj.Run:
    """Returns the finished run of a task at a path: resumed with its own settings, or made with defaults.

    Raises:
        BadInput: it is a run of another task, or has no critical set.
    """
    options = hyrl_mj.RunOptions(out=path)
    if (path / "config.json").is_file():
        s = hyrl_mj.load_run(path).settings
        if s.task != task:
            raise BadInput(f"{path} is a run of {s.task}: give one of {task}")
        options = replace(options, eps=s.eps, seed=s.seed, preset=s.preset, horizon=s.horizon)
    run = hyrl_mj.run(task, options, say=lambda text: print(f"{path}: {text}"))
    if len(run.extended_sets.modes) < 2 or not len(run.critical_set.points):
        raise BadInput(f"{path} has no critical set to show: give a run with another seed")
    return run


def draw(circle: hyrl_mj.Run, vehicle: hyrl_mj.Run, folder: Path) -> None:
    """Write the paper's seven figures: one to six, of which the fourth has a part for each task."""
    for run in (circle, vehicle):
        shown = figures.shown_run(run)
        for name, file in PAPER[run.task.name].items():
            figures.style.write(figures.FIGURES[name].draw(shown), folder / f"{file}.png")


# ---- our values


def fate(run: hyrl_mj.Run, arc: hyrl_mj.HybridArc) -> str:
    """Returns how a run ends: "arrives, left", "stalls", ..."""
    if arc.outcome != "reached":
        return FATES[arc.outcome]
    if not arc.arrives(run.task):
        return f"ends {run.task.miss(arc.z[-1:])[0]:.2g} off the set-point"
    return f"arrives, {run.task.scene.mode_names[run.task.direction(arc.z[:, None])[0]]}"


def point(z: np.ndarray) -> str:
    """Returns a start (d,) as text, angles in multiples of pi."""
    return f"{z[0] / np.pi:.2f}π" if len(z) == 1 else f"({', '.join(f'{x:g}' for x in z)})"


def intervals(members: hyrl_mj.sets.GridSet) -> str:
    """Returns the pieces of a set of angles as text, in multiples of pi."""
    return ", ".join(f"[{a / np.pi:.3f}π, {b / np.pi:.3f}π]" for a, b in members.pieces())


def overlap(run: hyrl_mj.Run) -> np.ndarray:
    """Returns the width (N,) of the overlap at each point of M*, along the coordinates that noise acts on."""
    points, both = run.critical_set.points, run.extended_sets.sets[0] & run.extended_sets.sets[1]
    direction = (run.task.noise_in_chart(1.0) > 0).astype(float)
    step = both.grid.cell / 4
    steps = np.arange(np.ceil(run.task.chart.sides.max() / 2 / step))
    width = np.zeros(len(points))
    for sign in (1, -1):
        z = points[:, None] + (sign * step * steps)[:, None] * direction
        inside = both.contains(z.reshape(-1, z.shape[-1])).reshape(len(points), -1)
        width += step * np.where(inside.all(axis=1), len(steps), inside.argmin(axis=1))
    return width


# ---- the table


def common(run: hyrl_mj.Run, horizon: str, width: str, least: float) -> Iterator[Line]:
    """Lines for both problems; the paper's overlap is at least `least` wide."""
    unit = run.task.chart.units[0]
    sets, sized = run.extended_sets, run.settings.horizon is None
    yield "noise bound eps", f"0.1 {unit}", f"{run.settings.eps:g} {unit}", ""
    yield "horizon T (step 5)", horizon, f"{sets.horizon:.3g} s", SIZED if sized else ""
    at = np.linalg.norm(run.critical_set.points - run.arcs()["critical", "policy"].z[0], axis=1)
    here, narrowest = overlap(run)[at.argmin()], overlap(run).min()
    note = SIZED if sized and here < least else ""
    yield "overlap at the replay starts", width, f"{here:.3f} {unit}", note
    yield "overlap where it is narrowest", "> eps", f"{narrowest:.3f} {unit}", ""
    first, then = run.settings.stage1, run.settings.stage6
    ours = f"{then.samples:,} a mode ({then.title}), stage 1 {first.samples:,}"
    note = "" if then.warm_start else "ours starts afresh, and trains under noise"
    yield "cost of step 6 in samples", "at most that of step 1", ours, note


def policy_alone(run: hyrl_mj.Run, paper_fates: tuple[str, ...]) -> Iterator[Line]:
    """Lines for the stage-1 policy from the starts of Section III; `paper_fates` is what the paper says."""
    s = run.settings
    arcs = policy_start_arcs(run.task, run.policy, s.eps, s.seed)
    for paper, arc in zip(paper_fates, arcs, strict=True):
        yield f"{s.stage1.title} from {point(arc.z[0])}", paper, fate(run, arc), ""


def hybrid(run: hyrl_mj.Run) -> Iterator[Line]:
    """Lines for the ten replays of Section V; q0 decides the way from two of the five starts."""
    arcs = run.arcs()
    for q in run.controller.modes:
        for i in range(len(run.task.scene.starts)):
            arc = arcs[f"start{i}", f"hyrl_q{q}"]
            paper = f"arrives, {run.task.scene.mode_names[q]}" if i in (1, 3) else "arrives"
            ours, jumps = fate(run, arc), arc.t[np.flatnonzero(np.diff(arc.j))]
            note = ""
            if not ours.startswith(paper) and len(jumps):
                note = f"q jumps at t = {', '.join(f'{t:g}' for t in jumps)} s"
                note += f": {SIZED}" if run.settings.horizon is None else ""
            yield f"HyRL from {point(arc.z[0])}, q0 = {q}", paper, ours, note


def circle_lines(run: hyrl_mj.Run) -> Iterator[Line]:
    """Example 1."""
    task, sets, parts = run.task, run.extended_sets, run.partition.parts
    z = np.linspace(0, 2 * np.pi, 10_001)[:, None]
    reward = task.reward(z, np.zeros_like(z))
    low, high = (limit[0] for limit in task.input_limits)
    (angle,) = task.set_point
    yield "set-point", "(1, 0)", f"({np.cos(angle):g}, {np.sin(angle):g})", ""
    yield "input u", "[-1, 1] rad/s", f"[{low:g}, {high:g}] rad/s", ""
    yield "reward R", "[-1, 0]", f"[{reward.min():.3g}, {abs(reward.max()):.3g}]", ""
    yield "R(x, y) - R(x, -y)", "0", f"{abs(reward - reward[::-1]).max():.1g}", ""
    where = ", ".join(f"{theta / np.pi:.4f}π" for theta in run.critical_set.points[:, 0])
    yield "M*", "π", where, ""
    shared = all(part.contains(task.set_point[None])[0] for part in parts)
    both = "our parts share the set-point, too" if shared else ""
    yield "M_0", "[0, π]", intervals(parts[0]), both
    yield "M_1", "[π, 2π)", intervals(parts[1]), both
    note = SIZED if run.settings.horizon is None else ""
    yield "M_ext_0", "[0, 1.13π]", intervals(sets.sets[0]), note
    yield "M_ext_1", "[0.87π, 2π)", intervals(sets.sets[1]), note
    yield from common(run, "0.5 s", "> 0.2π = 0.628 rad", 0.2 * np.pi)
    yield "runs are watched for", "4 s", f"{run.arcs()['start0', 'policy'].t[-1]:g} s", ""
    yield from policy_alone(run, ("arrives, clockwise", "arrives, counter-clockwise", "stalls"))
    yield from hybrid(run)


def vehicle_lines(run: hyrl_mj.Run) -> Iterator[Line]:
    """Example 2."""
    task, points = run.task, run.critical_set.points
    (x0, y0), (x1, y1) = task.chart.low, task.chart.high
    z = run.partition.grid.nodes
    still = np.zeros((len(z), 1))
    uneven = abs(task.reward(z, still) - task.reward(z * [1, -1], still)).max()
    levels = ", ".join(f"{u:g}" for u in task.input_levels[:, 0])
    yield "set-point", "(3, 0)", "({:g}, {:g})".format(*task.set_point), ""
    yield "input u", "-1, -0.5, 0, 0.5, 1 m/s", f"{levels} m/s", ""
    yield "arena", "[0, 3] x [-1.5, 1.5]", f"[{x0:g}, {x1:g}] x [{y0:g}, {y1:g}]", ""
    yield "R(x, y) - R(x, -y)", "0", f"{uneven:.1g}", ""
    ours = f"x {points[:, 0].min():.2f} to {points[:, 0].max():.2f}, |y| <= {abs(points[:, 1]).max():.4f}"
    yield "M*", "around (0.4, 0)", ours, ""
    yield from common(run, "not told (0.3 s in its code)", ">= 0.11 m", 0.11)
    yield "runs are watched for", "to the set-point", f"{task.scene.time:g} s", ""
    yield from policy_alone(run, ("arrives, right", "crashes", "arrives, left"))
    yield from hybrid(run)


def main() -> None:
    """Draw the figures, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--circle", type=Path, default=Path("runs/unit_circle"), metavar="RUN")
    parser.add_argument("--vehicle", type=Path, default=Path("runs/vehicle"), metavar="RUN")
    parser.add_argument("--out", type=Path, default=Path("runs/paper"), metavar="DIR")
    options = parser.parse_args()
    progress.shown = "bars" if sys.stderr.isatty() else "lines"
    circle = opened(options.circle, "unit_circle")
    vehicle = opened(options.vehicle, "vehicle")
    draw(circle, vehicle, options.out)
    title = "The paper's values and ours"
    table = Table("quantity", "paper", "ours", "note", title=title, caption=FOOTNOTE)
    for title, lines in {
        "unit circle": circle_lines(circle),
        "vehicle": vehicle_lines(vehicle),
    }.items():
        table.add_section()
        table.add_row(f"[bold]{title}")
        for line in lines:
            # Square brackets are intervals, not rich's markup.
            table.add_row(*(cell.replace("[", r"\[") for cell in line))
    Console(width=None if sys.stdout.isatty() else 150).print(table)
    print(f"figures in {options.out}")


if __name__ == "__main__":
    sys.exit(Streams().run(main))
