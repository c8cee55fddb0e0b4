"""The command line `hyrl-mj`: parse, call the pipeline, turn errors into sentences."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from hyrl_mj import pipeline, progress
from hyrl_mj.controllers import Controller, PolicyController
from hyrl_mj.errors import BadInput, HyrlError, unknown
from hyrl_mj.lattice import Lattice
from hyrl_mj.noise import KINDS, Noise
from hyrl_mj.robustness import LARGEST, Game, worst_signal
from hyrl_mj.simulation import AnyNoise, HybridArc, simulate
from hyrl_mj.summary import print_robustness, print_summary
from hyrl_mj.tasks.base import get_task, task_names

Positional = tyro.conf.Positional
RunDir = Annotated[Path, Positional, tyro.conf.arg(metavar="RUN", help="a run directory")]


def list_tasks() -> None:
    """List the tasks."""
    for name in task_names():
        task = get_task(name)
        print(f"{name:14} {task.env_id:30} {task.description}")


def run(
    task: Annotated[str, Positional, tyro.conf.arg(metavar="TASK")],
    /,
    noise: float = 0.1,
    seed: int = 0,
    preset: str = "fast",
    horizon: float | None = None,
    out: Path | None = None,
) -> None:
    """Run all stages: train, find the critical set, extend, retrain, simulate, render, report.

    A run directory that is there already is resumed: only what is missing is done.

    Args:
        task: a task, see `hyrl-mj list`.
        noise: bound of the measurement noise to survive, in rad (unit_circle) or m (vehicle).
        seed: of everything random.
        preset: fast, paper (the paper's training, ten minutes), or smoke (seconds).
        horizon: horizon T of the backward propagation in s; by default the extended sets are sized to the
            noise. The paper has 0.5 (unit_circle) and 0.3 (vehicle).
        out: the run directory; by default runs/TASK.
    """
    result = pipeline.run(
        task, noise=noise, seed=seed, preset_name=preset, horizon=horizon, out=out
    )
    print_summary(result)


def stage_command(name: str, help_text: str) -> Callable[..., None]:
    """The subcommand that runs one stage again from what is on disk."""

    def command(run_dir: RunDir) -> None:
        pipeline.run_stage(pipeline.load_run(run_dir), name)

    command.__doc__ = help_text
    return command


def extended_sets(run_dir: RunDir, horizon: float | None = None) -> None:
    """Run stages 4 and 5 again: extend the parts over the critical set.

    Args:
        run_dir: a run directory.
        horizon: a new horizon T of the backward propagation in s.
    """
    run = pipeline.load_run(run_dir)
    if horizon is None:
        pipeline.run_stage(run, "extended-sets")
    else:
        pipeline.extend_again(run, horizon)


def simulate_run(
    run_dir: RunDir,
    start: tuple[float, ...] | None = None,
    q0: int | None = None,
    noise: str = "alternating",
    eps: float | None = None,
    horizon: float | None = None,
    seed: int = 0,
) -> None:
    """Simulate policy and hybrid controller; without --start, the paper's replays (stage 7).

    Args:
        run_dir: a run directory.
        start: start in chart coordinates: theta in rad (unit_circle), or x y in m (vehicle).
        q0: start mode; by default the controller picks it from the first measurement.
        noise: none, uniform, alternating, adversarial (the most dangerous one sample ahead), or worst (the
            signal with which the exact game is lost, or arrival is latest).
        eps: bound of the noise in chart units; by default the run's.
        horizon: time to simulate in s; by default the task's.
        seed: of the noise.
    """
    run = pipeline.load_run(run_dir)
    if start is None:
        if (q0, noise, eps, horizon, seed) != (None, "alternating", None, None, 0):
            raise BadInput("--q0, --noise, --eps, --horizon and --seed need a --start")
        print_summary(pipeline.run_stage(run, "simulate"))
        return
    if noise not in (*KINDS, "worst"):
        raise unknown("noise", noise, (*KINDS, "worst"))
    bound = run.task.check_noise(run.settings.noise if eps is None else eps)
    z0 = run.task.check_state([start])[0]
    loops: dict[str, Controller] = {
        "policy": PolicyController(run.policy),
        "hyrl": run.controller,
    }
    game = None
    if noise == "worst":
        game = Game(run.task, run.partition, loops, max(bound, LARGEST))
    arcs = {}
    for name, loop in loops.items():
        mode = q0 if name == "hyrl" else None
        signal: AnyNoise = (
            worst_signal(game, name, loop, z0[None], bound, mode) if game else Noise(noise, bound)
        )
        arcs[name] = simulate(run.task, loop, z0, signal, mode, horizon, seed, name=name)
    for name, arc in arcs.items():
        assert isinstance(arc, HybridArc)
        arc.save(run.path / "arcs" / f"latest_{name}.npz")
        end = run.task.chart.format(arc.z[-1])
        print(f"{name:7} {arc.outcome:14} t = {arc.t[-1]:.2f} s, {arc.j[-1]} jumps, {end}")
    print(f"saved as {run.path / 'arcs'}/latest_*.npz")


def robustness(
    run_dir: RunDir,
    eps: float | None = None,
    episodes: int | None = None,
    noise: str | None = None,
    all_coordinates: bool = False,
    seed: int = 0,
) -> None:
    """Find out what measurement noise can do: worst-case game, margins, and episodes in bulk.

    Writes robustness.json, figures/robustness_map.png and figures/robustness_curve.png.

    Args:
        run_dir: a run directory.
        eps: bound of the noise in chart units; by default the run's.
        episodes: noisy episodes to simulate for each kind of noise and controller; by default none where
            the worst case can be played exactly, on charts of one or two dimensions.
        noise: kinds of noise in the episodes, separated by commas; by default
            uniform,alternating,adversarial.
        all_coordinates: noise on every coordinate of the measurement, not only on those the task calls
            noisy.
        seed: of starts and noise of the episodes.
    """
    run = pipeline.load_run(run_dir)
    kinds = [] if noise is None else [kind.strip() for kind in noise.split(",")]
    for kind in kinds:
        if kind not in KINDS:
            raise unknown("noise", kind, KINDS)
    if episodes is None:
        Lattice.check(run.task)
        if kinds:
            raise BadInput("--noise is that of the episodes: say how many, as in --episodes 100000")
    pipeline.examine_run(run, eps, kinds, episodes, all_coordinates, seed)
    print_robustness(pipeline.load_run(run_dir))
    print(f"pictures in {run.path / 'figures'}")


def replay(
    run_dir: RunDir,
    out: Path | None = None,
    size: str = "640x480",
    fps: int = 40,
    camera: str = "overhead",
) -> None:
    """Render policy and hybrid controller side by side, from the start on the critical set.

    Args:
        run_dir: a run directory.
        out: the mp4 to write; by default replay.mp4 in the run directory.
        size: width x height of one panel in pixels.
        fps: frames per second.
        camera: a camera of the MJCF: overhead or chase.
    """
    from hyrl_mj.replay import render_replay

    run = pipeline.load_run(run_dir)
    out = out or run.path / "replay.mp4"
    pairs = pipeline.critical_pairs(run)
    render_replay(run.task, pairs, out, size=parse_size(size), fps=fps, camera=camera)
    print(f"video at {out}")


def parse_size(text: str) -> tuple[int, int]:
    """Width and height [pixels] from a text like 640x480."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdecimal() for p in parts) or not all(map(int, parts)):
        raise BadInput(f"size {text!r} cannot be used: give WIDTHxHEIGHT in pixels, as 640x480")
    return int(parts[0]), int(parts[1])


def report(run_dir: RunDir, out: Path | None = None) -> None:
    """Write one page with all that a run has found: video, figures, tables, settings, how to repeat it.

    The page opens in any browser, without a network, and can be printed.

    Args:
        run_dir: a run directory.
        out: the html to write; by default report.html in the run directory.
    """
    from hyrl_mj.report import write_report

    run = pipeline.load_run(run_dir)
    out = out or run.path / "report.html"
    write_report(run, out)
    print(f"page at {out}")


def doctor() -> None:
    """Tell whether this machine can train, render and encode video, and what to do where it cannot."""
    from hyrl_mj.doctor import report

    lines, healthy = report()
    print("\n".join(lines))
    if not healthy:
        raise SystemExit(1)


COMMANDS: dict[str, Callable[..., None]] = {
    "list": list_tasks,
    "run": run,
    "train": stage_command("train", "Run stage 1 again: train the policy."),
    "critical-set": stage_command("critical-set", "Run stage 2 again: find the critical set."),
    "partition": stage_command("partition", "Run stage 3 again: partition the chart."),
    "extended-sets": extended_sets,
    "retrain": stage_command("retrain", "Run stage 6 again: train the policy of each mode."),
    "robustness": robustness,
    "simulate": simulate_run,
    "replay": replay,
    "report": report,
    "doctor": doctor,
}


def main() -> None:
    """The console script `hyrl-mj`."""
    progress.enabled = sys.stderr.isatty()
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="hyrl-mj",
            description="Hysteresis-Based RL on MuJoCo.",
            sort_subcommands=False,
        )
    except HyrlError as error:
        print(f"hyrl-mj: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except OSError as error:
        where = "" if error.filename is None else f": {os.fsdecode(error.filename)}"
        print(f"hyrl-mj: {error.strerror}{where}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print(
            "hyrl-mj: interrupted; what was finished is kept, run again to resume", file=sys.stderr
        )
        sys.exit(130)


if __name__ == "__main__":
    main()
