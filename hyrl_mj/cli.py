"""The command line `hyrl-mj`: parse, call the pipeline, turn errors into sentences."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from hyrl_mj import pipeline, progress
from hyrl_mj.errors import BadInput, HyrlError, unknown
from hyrl_mj.run_directory import load_run
from hyrl_mj.tasks import get_task, task_names
from hyrl_mj.viz import print_robustness, print_summary

Positional = tyro.conf.Positional
# Starts, noise, its bound, layout and slow motion of the replay that a run makes.
REPLAY = ("critical", None, None, "side-by-side", 1.0)
RunDir = Annotated[Path, Positional, tyro.conf.arg(metavar="RUN", help="a run directory")]


def list_tasks() -> None:
    """List the tasks."""
    for name in task_names():
        try:
            task = get_task(name)
            print(f"{name:14} {task.env_id:30} {task.description}")
        except BadInput as error:  # of another package
            print(f"{name:14} {error}")


def new_task(
    name: Annotated[str, Positional, tyro.conf.arg(metavar="NAME")],
    /,
    folder: Path = Path(),
) -> None:
    """Write a task of your own to start from: NAME.py, NAME.xml and test_NAME.py.

    Args:
        name: of the task and its files: letters, digits and _.
        folder: where to.
    """
    from hyrl_mj.tasks import write_task

    paths = write_task(name, folder)
    print(f"wrote {', '.join(map(str, paths))}")
    print(f"try them with pytest {paths[-1]}, then hyrl-mj run {paths[0]}")


def run(
    task: Annotated[str, Positional, tyro.conf.arg(metavar="TASK")],
    /,
    noise: float = 0.1,
    seed: int = 0,
    preset: str = "fast",
    algorithm: str | None = None,
    horizon: float | None = None,
    out: Path | None = None,
) -> None:
    """Run all stages: train, find the critical set, extend, retrain, simulate, draw, render, report.

    A run directory that is there already is resumed: only what is missing is done.

    Args:
        task: a task, see `hyrl-mj list`, or a Python file that defines one, see `hyrl-mj new-task`.
        noise: bound of the measurement noise to survive, in the units of the chart.
        seed: of everything random.
        preset: fast, paper (the paper's training, ten minutes), or smoke (seconds).
        algorithm: trains stage 1: ppo, a2c, dqn, sac, td3, ddpg, or module:Class of another one of SB3's
            kind, as sb3_contrib:TQC; by default the task's.
        horizon: horizon T of the backward propagation in s; by default the extended sets are sized to the
            noise. The paper has 0.5 (unit_circle) and 0.3 (vehicle).
        out: the run directory; by default runs/TASK.
    """
    result = pipeline.run(
        task,
        noise=noise,
        seed=seed,
        preset_name=preset,
        algorithm=algorithm,
        horizon=horizon,
        out=out,
    )
    print_summary(result)


AgentFile = Annotated[
    Path,
    tyro.conf.arg(
        metavar="FILE",
        help="a .zip that SB3's model.save wrote, an .onnx file, or a .safetensors file",
    ),
]


def robustify(
    task: Annotated[str, Positional, tyro.conf.arg(metavar="TASK")],
    /,
    policy: AgentFile,
    activation: str | None = None,
    stochastic: bool = False,
    noise: float = 0.1,
    seed: int = 0,
    preset: str = "fast",
    horizon: float | None = None,
    out: Path | None = None,
) -> None:
    """Make an agent robust that was trained elsewhere: all stages but the first.

    A run directory that is there already is resumed: only what is missing is done.

    Args:
        task: a task, see `hyrl-mj list`, or a Python file that defines one.
        policy: the agent.
        activation: between its layers, for a zip that does not say; by default SB3's.
        stochastic: the agent draws its inputs, as it did while it learned (PPO, A2C, SAC); noisy episodes
            then stand in for the exact game.
        noise: bound of the measurement noise to survive, in the units of the chart.
        seed: of everything random.
        preset: fast, paper, or smoke, as for `hyrl-mj run`.
        horizon: horizon T of the backward propagation in s; by default the extended sets are sized to the
            noise.
        out: the run directory; by default runs/TASK_robust.
    """
    result = pipeline.robustify(
        task,
        policy,
        activation=activation,
        stochastic=stochastic,
        noise=noise,
        seed=seed,
        preset_name=preset,
        horizon=horizon,
        out=out,
    )
    print_summary(result)


def diagnose(
    task: Annotated[str, Positional, tyro.conf.arg(metavar="TASK")],
    /,
    policy: AgentFile,
    activation: str | None = None,
    stochastic: bool = False,
    noise: float = 0.1,
    seed: int = 0,
    preset: str = "fast",
    horizon: float | None = None,
    out: Path | None = None,
) -> None:
    """Find out what noise can do to an agent: critical set, losses, margin, a run that it loses, pictures.

    Nothing is trained. `hyrl-mj robustify` with the same options goes on in the same run directory.

    Args:
        task: a task, see `hyrl-mj list`, or a Python file that defines one.
        policy: the agent.
        activation: between its layers, for a zip that does not say; by default SB3's.
        stochastic: the agent draws its inputs, as it did while it learned (PPO, A2C, SAC); noisy episodes
            then stand in for the exact game.
        noise: bound of the measurement noise, in the units of the chart.
        seed: of everything random.
        preset: fast, paper or smoke: how finely it is looked at, and how `hyrl-mj robustify` goes on.
        horizon: of `hyrl-mj robustify`, which goes on with it.
        out: the run directory; by default runs/TASK_robust.
    """
    pipeline.diagnose(
        task,
        policy,
        activation=activation,
        stochastic=stochastic,
        noise=noise,
        seed=seed,
        preset_name=preset,
        horizon=horizon,
        out=out,
    )


def stage_command(name: str, help_text: str) -> Callable[..., None]:
    """The subcommand that runs one stage again from what is on disk."""

    def command(run_dir: RunDir) -> None:
        pipeline.run_stage(load_run(run_dir), name)

    command.__doc__ = help_text
    return command


def extended_sets(run_dir: RunDir, horizon: float | None = None) -> None:
    """Run stages 4 and 5 again: extend the parts over the critical set.

    Args:
        run_dir: a run directory.
        horizon: a new horizon T of the backward propagation in s.
    """
    run = load_run(run_dir)
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
        start: start in chart coordinates, as x y in m (vehicle) or theta in rad (unit_circle).
        q0: start mode; by default the controller picks it from the first measurement.
        noise: none, uniform, alternating, adversarial (the most dangerous one), or worst (the
            signal with which the exact game is lost, or arrival is latest).
        eps: bound of the noise in chart units; by default the run's.
        horizon: time to simulate in s; by default the task's.
        seed: of the noise.
    """
    from hyrl_mj.viz.arcs import noisy_arcs

    run = load_run(run_dir)
    if start is None:
        if (q0, noise, eps, horizon, seed) != (None, "alternating", None, None, 0):
            raise BadInput("--q0, --noise, --eps, --horizon and --seed need a --start")
        print_summary(pipeline.run_stage(run, "simulate"))
        return
    z0 = run.task.chart.check([start], run.task.name)
    found = noisy_arcs(run, z0, noise, eps, (q0,), horizon, seed)
    for name, (arc,) in zip(("policy", "hyrl"), found.values(), strict=True):
        arc.save(run.latest_path(name))
        end = run.task.chart.format(arc.z[-1])
        print(f"{name:7} {arc.outcome:14} t = {arc.t[-1]:.2f} s, {arc.j[-1]} jumps, {end}")
    print(f"saved as {run.path / 'arcs'}/latest_*.npz")


def robustness(
    run_dir: RunDir,
    eps: float | None = None,
    episodes: int | None = None,
    noise: str | None = None,
    all_coordinates: bool = False,
    near_critical: bool = False,
    seed: int = 0,
) -> None:
    """Find out what measurement noise can do: worst-case game, margins, and episodes in bulk.

    Writes robustness.json, and figures/robustness_map and robustness_curve as PNG and PDF.

    Args:
        run_dir: a run directory.
        eps: bound of the noise in chart units; by default the run's.
        episodes: noisy episodes to simulate for each kind of noise and controller; by default none where
            the worst case can be played exactly, on charts of one or two dimensions.
        noise: kinds of noise in the episodes, separated by commas; by default
            uniform,alternating,adversarial.
        all_coordinates: noise on every coordinate of the measurement, not only on those the task calls
            noisy.
        near_critical: all episodes start within twice the bound of the critical set.
        seed: of starts and noise of the episodes.
    """
    run = load_run(run_dir)
    kinds = [] if noise is None else [kind.strip() for kind in noise.split(",")]
    if episodes is None:
        run.check_exact()
        if kinds or near_critical:
            option = "--noise" if kinds else "--near-critical"
            raise BadInput(f"{option} is about the episodes: say how many, as in --episodes 100000")
    pipeline.examine_run(run, eps, kinds, episodes, all_coordinates, seed, near_critical)
    print_robustness(load_run(run_dir))
    print(f"pictures in {run.path / 'figures'}")


def replay(
    run_dir: RunDir,
    out: Path | None = None,
    starts: str = "critical",
    noise: str | None = None,
    eps: float | None = None,
    layout: str = "side-by-side",
    camera: str = "overhead",
    size: str = "1280x720",
    fps: int = 30,
    slow_motion: float = 1.0,
) -> None:
    """Render policy and hybrid controller under the same noise, as a video or a picture.

    Args:
        run_dir: a run directory.
        out: the mp4 or gif to write, with its last frame as a png of the same name, or a png alone; the
            run's own replay goes to replay.mp4 in the run directory by default.
        starts: critical (the start on the critical set, once for each start mode), paper (all of the
            paper's at once), or latest (what `hyrl-mj simulate --start` simulated last).
        noise: simulate anew under this noise: none, uniform, alternating, adversarial (the most dangerous
            one), or worst (of the exact game, for each controller); by default the arcs of the run, under
            alternating noise.
        eps: bound of the noise in chart units; by default the run's.
        layout: side-by-side, or overlay (both in one scene).
        camera: a camera of the MJCF: overhead, chase or three_quarter.
        size: width x height of the video in pixels, even numbers, at least 480x160 side by side.
        fps: frames per second.
        slow_motion: how many times slower the video is around jumps.
    """
    from hyrl_mj.viz.arcs import replay_floor, replay_shows
    from hyrl_mj.viz.replay import render_replay

    run = load_run(run_dir)
    if out is None and (starts, noise, eps, layout, slow_motion) != REPLAY:
        # The report says of replay.mp4 what a run puts there.
        raise BadInput("another replay than that of the run needs an --out, as in --out mine.mp4")
    out = out or run.path / "replay.mp4"
    render_replay(
        run.task,
        replay_shows(run, starts, noise, eps),
        out,
        floor=replay_floor(run),
        size=parse_size(size),
        fps=fps,
        camera=camera,
        layout=layout,
        slow_motion=slow_motion,
    )
    print(f"{'picture' if out.suffix == '.png' else 'video'} at {out}")


def view(run_dir: RunDir, arc: str = "critical_hyrl_q0", port: int = 0) -> None:
    """Replay an arc in MuJoCo's viewer, or in a browser where there is no display.

    The viewer for a browser takes pip install "hyrl-mj[view]". Ctrl+C ends it.

    Args:
        run_dir: a run directory.
        arc: the name of a file in its folder arcs.
        port: of the web viewer, which only this machine can reach; by default the first free one from
            8080 on.
    """
    from hyrl_mj.viz.viewing import view

    run = load_run(run_dir)
    paths = {path.stem: path for path in sorted((run.path / "arcs").glob("*.npz"))}
    if arc not in paths:
        raise unknown("arc", arc, paths)
    view(run.task, run.arc(paths[arc]), port)


def parse_size(text: str) -> tuple[int, int]:
    """Width and height [pixels] from a text like 640x480."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdecimal() for p in parts):
        raise BadInput(f"size {text!r} cannot be used: give WIDTHxHEIGHT in pixels, as 640x480")
    return int(parts[0]), int(parts[1])


def report(run_dir: RunDir, out: Path | None = None) -> None:
    """Write one page with all that a run has found: video, figures, tables, settings, how to repeat it.

    The page opens in any browser, without a network, and can be printed.

    Args:
        run_dir: a run directory.
        out: the html to write; by default report.html in the run directory.
    """
    from hyrl_mj.viz.report import write_report

    run = load_run(run_dir)
    out = out or run.path / "report.html"
    write_report(run, out)
    print(f"page at {out}")


def export(run_dir: RunDir, to: str, out: Path) -> None:
    """Write the hybrid controller of a run so that it works without hyrl_mj.

    Args:
        run_dir: a run directory.
        to: onnx (one file, q and measured in, u and q_next out; -1 as the first q), or numpy (a folder
            with controller.py and controller.npz, which need NumPy alone).
        out: the file or the folder to write.
    """
    from hyrl_mj.export import export

    export(load_run(run_dir).controller, to, out)
    print(f"controller at {out}")


def doctor() -> None:
    """Tell whether this machine can train, render and encode video, and what to do where it cannot."""
    from hyrl_mj.doctor import report

    lines, healthy = report()
    print("\n".join(lines))
    if not healthy:
        raise SystemExit(1)


COMMANDS: dict[str, Callable[..., None]] = {
    "list": list_tasks,
    "new-task": new_task,
    "run": run,
    "robustify": robustify,
    "diagnose": diagnose,
    "train": stage_command("train", "Run stage 1 again: train the policy."),
    "critical-set": stage_command("critical-set", "Run stage 2 again: find the critical set."),
    "partition": stage_command("partition", "Run stage 3 again: partition the chart."),
    "extended-sets": extended_sets,
    "retrain": stage_command("retrain", "Run stage 6 again: train the policy of each mode."),
    "robustness": robustness,
    "simulate": simulate_run,
    "figures": stage_command("figures", "Draw the paper's figures of a run again, as PNG and PDF."),
    "replay": replay,
    "view": view,
    "report": report,
    "export": export,
    "doctor": doctor,
}


def main() -> None:
    """The console script `hyrl-mj`."""
    progress.enabled = sys.stderr.isatty()
    # Python would look for garbage among torch's modules for most of a second before it ends.
    atexit.register(gc.freeze)
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
