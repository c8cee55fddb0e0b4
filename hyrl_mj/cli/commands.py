"""The commands of `hyrl-mj`, a function for each: its parameters are the options, its docstring the help."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hyrl_mj import pipeline
from hyrl_mj.errors import BadInput, printable, unknown
from hyrl_mj.fields import DriveOptions
from hyrl_mj.files import trust
from hyrl_mj.gym_import import EnvironmentOptions, chosen_task, explained
from hyrl_mj.judging import Word
from hyrl_mj.pipeline import AgentOptions, CompareOptions, ExamineOptions, RunOptions, SweepOptions
from hyrl_mj.policies import AnyPolicy, agent_at
from hyrl_mj.runs.arcs import noisy_arcs
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import noise_from_log
from hyrl_mj.system import cores
from hyrl_mj.tasks import Task, get_task, task_names, write_task
from hyrl_mj.viz import (
    ReplayOptions,
    print_compared,
    print_noise,
    print_robustness,
    print_summary,
    print_sweep,
)


def list_tasks() -> None:
    """List the tasks."""
    for name in task_names():
        try:
            task = get_task(name)
            print(f"{name:14} {task.env_id:30} {task.description}")
        except BadInput as error:  # a broken task of another package
            print(f"{name:14} {error}")


def new_task(name: str, *, folder: Path = Path()) -> None:
    """Write a task of your own to start from: NAME.py, NAME.xml and test_NAME.py.

    Args:
        name: the name of the task and of its files: letters, digits and _.
        folder: the folder to write to.
    """
    paths = [shlex.quote(printable(str(path))) for path in write_task(name, folder)]
    print(f"wrote {', '.join(paths)}")
    print(f"try them with python -m pytest {paths[-1]}, after pip install pytest")
    print(f"then run all stages with hyrl-mj run {paths[0]}")


def run(task: str | None = None, *, environment: EnvironmentOptions, options: RunOptions) -> None:
    """Run all stages on a task, from training to the report.

    An existing run directory is resumed: only what is missing is done.

    The verdict is PROVED, WON, HELD, UNDECIDED, WEAK, or FAILED (exit status 1).

    Args:
        task: a task, see `hyrl-mj list`, or a Python file that defines one, see `hyrl-mj new-task`; by
            default none, with --env.
    """
    chosen = chosen_task(task, environment)
    if environment.explain:
        print(explained(chosen))
    else:
        finish(pipeline.run(chosen, options))


def agent_command(
    name: str, help_text: str, work: Callable[[Task, AnyPolicy, AgentOptions], object]
) -> Callable[..., None]:
    """Returns the subcommand that does some work with an agent that was trained elsewhere."""

    def command(
        task: str | None = None,
        *,
        policy: Path | None = None,
        environment: EnvironmentOptions,
        options: AgentOptions,
    ) -> None:
        agent = None
        if policy is not None and not environment.explain:
            agent = agent_at(policy)  # said before an environment is tried out, which takes longer
        chosen = chosen_task(task, environment)
        if environment.explain:
            print(explained(chosen))
        elif agent is None:
            raise BadInput(
                f"{name} needs --policy: the agent, a .zip, .onnx or .safetensors file, or module:object"
            )
        else:
            work(chosen, agent, options)

    command.__doc__ = f"""{help_text}

    Args:
        task: a task, see `hyrl-mj list`, or a Python file that defines one; by default none, with --env.
        policy: the agent, a .zip that SB3's model.save wrote, an .onnx file, a .safetensors file, or Python
            code as module:object, which is imported; by default none, with --explain.
    """
    return command


robustify = agent_command(
    "robustify",
    """Make an agent robust that was trained elsewhere: all stages but the first.

    An existing run directory is resumed: only what is missing is done.

    The verdict is PROVED, WON, HELD, UNDECIDED, WEAK, or FAILED (exit status 1).""",
    lambda *given: finish(pipeline.robustify(*given)),
)
diagnose = agent_command(
    "diagnose",
    """Find out what noise can do to an agent: critical set, losses, margin.

    Nothing is trained; `hyrl-mj robustify` continues in the same run directory.""",
    lambda *given: pipeline.diagnose(*given),
)


def finish(run: Run) -> None:
    """Prints the results of a whole run; if it FAILED, ends with exit status 1."""
    print_summary(run)
    if run.verdict.word == Word.FAILED:
        raise SystemExit(1)


def sweep(
    tasks: tuple[str, ...] = (), *, report: Path | None = None, options: SweepOptions
) -> None:
    """Make many runs over seeds, noise bounds and algorithms, and their tables.

    What is done is not done again. It needs Ray: pip install "hyrl-mj[sweep]".

    Args:
        tasks: tasks, see `hyrl-mj list`, or Python files that define some; by default none, with --report.
        report: make the tables of this sweep folder again from the runs that are there; by default off.
    """
    if report is not None:
        if tasks or options != SweepOptions():
            raise BadInput(
                "--report DIR makes tables of the runs that are there: leave TASKS and other options out"
            )
        result, folder = pipeline.report(report), report
    else:
        result, folder = pipeline.sweep(tasks, options), Path(options.out)
    print_sweep(result)
    print(f"tables in {folder}/sweep.html, sweep.csv and sweep.json")
    if any(not row.done or row.verdict == Word.FAILED for row in result.rows):
        raise SystemExit(1)


def compare(
    task: str | None = None, *, environment: EnvironmentOptions, options: CompareOptions
) -> None:
    """Compare HyRL with what people would do instead, judged alike.

    Each alternative is tuned, and may train with as many samples as HyRL's run.

    What is done is not done again.

    Args:
        task: a task, see `hyrl-mj list`, or a Python file that defines one; by default none, with --env.
    """
    chosen = chosen_task(task, environment)
    if environment.explain:
        print(explained(chosen))
        return
    with cores.Processes() as pool, cores.using_pool(pool):
        result = pipeline.compare(chosen, options)
    print_compared(result)
    folder = options.out or Path("runs") / f"{chosen.name}_compare"
    print(f"page at {folder}/compare.html")


def stage_command(name: str, help_text: str) -> Callable[..., None]:
    """Returns the subcommand that runs one stage again from what is on disk."""

    def command(run: Run) -> None:
        pipeline.run_stage(run, name)

    command.__doc__ = help_text
    return command


def extended_sets(run: Run, *, horizon: float | None = None) -> None:
    """Run stages 4 and 5 again: extend the parts over the critical set.

    Args:
        horizon: a new time T of the backward propagation [s]; by default the run's.
    """
    if horizon is None:
        pipeline.run_stage(run, "extended-sets")
    else:
        pipeline.extend_again(run, horizon)


def simulate(
    run: Run,
    *,
    start: tuple[float, ...] | None = None,
    q0: int | None = None,
    noise: str = "alternating",
    eps: float | None = None,
    time: float | None = None,
    seed: int = 0,
) -> None:
    """Simulate policy and controller; without --start, the paper's replays.

    Args:
        start: start in chart coordinates, as x y [m] (vehicle) or theta [rad] (unit_circle); by default the
            starts of the paper's replays.
        q0: start mode; by default the controller selects it from the first measurement.
        noise: kind of noise: none, uniform, alternating, adversarial (looks a few samples ahead),
            attack (the strongest signal that a search finds for each controller), or worst (the signal with
            which each controller loses the worst-case game, or arrives latest).
        eps: bound of the noise, in the units of the chart; by default the run's.
        time: time to simulate [s]; by default the task's.
        seed: seed of the noise.
    """
    if start is None:
        if (q0, noise, eps, time, seed) != (None, "alternating", None, None, 0):
            raise BadInput("--q0, --noise, --eps, --time and --seed need a --start")
        print_summary(pipeline.run_stage(run, "simulate"))
        return
    z0 = run.task.chart.check([start], run.task.name)

    def work(run: Run) -> None:
        arcs = noisy_arcs(run, z0, noise, eps, (q0,), time, seed)
        for name, (arc,) in zip(("policy", "hyrl"), arcs.values(), strict=True):
            arc.save(run.arc_path("latest", name))
            end = run.task.chart.format(arc.z[-1])
            print(f"{name:7} {arc.outcome:14} t = {arc.t[-1]:.2f} s, {arc.j[-1]} jumps, {end}")

    pipeline.as_stage(run, "simulate --start", work)
    print(f"saved as {run.path / 'arcs'}/latest_*.npz")


def robustness(run: Run, options: ExamineOptions) -> None:
    """Find out what noise can do: worst-case game, margins, and episodes in bulk.

    Writes robustness.json and the figures of a map and a curve, as PNG and PDF.
    """
    if options.episodes is None and run.exact:
        attacked = options.budget(run.task.effort, run.exact) is not None
        if options.noise or (options.near_critical and not attacked):
            option = "--noise" if options.noise else "--near-critical"
            raise BadInput(f"{option} is about the episodes: say how many, as in --episodes 100000")
    pipeline.examine_run(run, options)
    print_robustness(run.anew())
    if run.why_no_game is None:
        print(f"pictures in {run.path / 'figures'}")


def noise(
    log: Path,
    *,
    columns: tuple[str, ...] | None = None,
    dt: float | None = None,
    at_rest: bool = False,
    scale: dict[str, Any] | None = None,
    turn: tuple[str, ...] | None = None,
    share: float = 0.999,
    out: Path | None = None,
    force: bool = False,
) -> None:
    """Find out from a log of measurements which noise to give to a run.

    LOG is a CSV file with t or time [s], measured columns, and their NAME_ref.

    Numbers are in the units of the log. Without --out nothing is written.

    Args:
        log: the CSV file.
        columns: the measured columns to look at; by default all that have a NAME_ref with what is true, and
            at rest all.
        dt: the time between two rows [s]; by default from the column t or time.
        at_rest: the robot stood still while the log was written, so no references are needed.
        scale: factors by which columns are multiplied, as x=0.001 x_ref=0.001 for mm; by default 1.
        turn: columns of angles in rad, whose difference by a whole turn is none; by default none.
        share: the share of the samples that is to be within the bound of the noise.
        out: the png to write: errors, their histogram and their autocorrelation; by default none.
        force: overwrite a file that hyrl-mj has not written.
    """
    try:
        factors = {name: float(factor) for name, factor in (scale or {}).items()}
    except ValueError as error:
        raise BadInput(f"--scale cannot be used ({error}): give NAME=NUMBER, as x=0.001") from None
    found = noise_from_log(
        log,
        columns=columns,
        dt=dt,
        at_rest=at_rest,
        scale=factors,
        turn=turn or (),
        share=share,
    )
    print_noise(found)
    if out is not None:
        from hyrl_mj.viz.figures.noise import draw_noise

        with trust.output(out, force=force):
            draw_noise(found, out)
        print(f"picture at {out}")


def replay(
    run: Run,
    *,
    out: Path | None = None,
    starts: str = "critical",
    noise: str | None = None,
    eps: float | None = None,
    force: bool = False,
    options: ReplayOptions,
) -> None:
    """Render policy and controller under the same noise, as a video or a picture.

    Args:
        out: the mp4 or gif to write, with its last frame as a png of the same name, or a png alone; by
            default replay.mp4 in the run directory.
        starts: critical (the start on the critical set, once for each start mode; where no game can be
            played, the strongest signals of the attack), paper (all of the
            paper's at once), or latest (what `hyrl-mj simulate --start` simulated last).
        noise: kind of noise under which to simulate anew, as in `hyrl-mj simulate`; by default the arcs of
            the run, which are under alternating noise, and from the critical set under the strongest noise
            that is known.
        eps: bound of the noise, in the units of the chart; by default the run's.
        force: overwrite a file that hyrl-mj has not written.
    """
    from hyrl_mj.viz.replay import render_replay
    from hyrl_mj.viz.shows import replay_floor, replay_shows

    usual_out = run.path / "replay.mp4"
    usual = ReplayOptions(camera=options.camera, size=options.size, fps=options.fps)
    if out is None and (starts, noise, eps, options) != ("critical", None, None, usual):
        # The report describes replay.mp4 as a run makes it.
        raise BadInput("another replay than that of the run needs an --out, as in --out mine.mp4")

    def work(run: Run) -> None:
        shows = replay_shows(run, starts, noise, eps)
        render_replay(run.task, shows, out or usual_out, options, floor=replay_floor(run))

    if out is None:
        pipeline.as_stage(run, "replay", work)
    else:
        with trust.output(*_pictures(out), force=force):
            work(run)
    out = out or usual_out
    print(f"{'picture' if out.suffix == '.png' else 'video'} at {out}")


def _pictures(out: Path | None) -> list[Path]:
    """Returns the files that a replay is written to: a video or a picture, and its last frame."""
    return [] if out is None else [out, out.with_suffix(".png")] if out.name else [out]


def drive(
    run: Run,
    *,
    field: Path,
    out: Path | None = None,
    shown: tuple[int, ...] | None = None,
    force: bool = False,
    options: DriveOptions,
    how: ReplayOptions,
) -> None:
    """Drive through a field of posts with the policy and with HyRL, and render it.

    RUN is a run of the task field. Without --out nothing is written.

    Args:
        field: the JSON file of the field: goal, posts and starts.
        out: the mp4 or gif to write, with its last frame as a png of the same name, or a png alone; by
            default none.
        shown: numbers of the starts to render, the first of them in the png; by default all, one after the
            other.
        force: overwrite a file that hyrl-mj has not written.
    """
    from hyrl_mj.viz import drives

    with trust.output(*_pictures(out), force=force):
        drives.drive_run(run, field, options, out, how, shown)


def view(run: Run, *, arc: str | None = None, port: int = 0) -> None:
    """Simulate a run live in a browser, or replay an arc.

    On the page, drag the start, and choose controller, mode and noise.

    It takes pip install "hyrl-mj[view]". Ctrl+C ends it.

    Args:
        arc: the name of a file in the folder arcs of the run, to replay in MuJoCo's viewer, or in a browser
            where there is no display; by default the run is simulated live.
        port: port of the web viewer, which only this machine can reach, or 0 for the first free one from
            8080 on.
    """
    if arc is None:
        from hyrl_mj.viz.live import live

        return live(run, port)
    from hyrl_mj.viz.viewing import view

    paths = {path.stem: path for path in sorted((run.path / "arcs").glob("*.npz"))}
    if arc not in paths:
        raise unknown("arc", arc, paths)
    view(run.task, run.arc(paths[arc]), port)


def report(run: Run, *, out: Path | None = None, force: bool = False) -> None:
    """Write one page with all results of a run, and how to repeat it.

    The page opens in any browser, without a network, and can be printed.

    Args:
        out: the html to write; by default report.html in the run directory.
        force: overwrite a file that hyrl-mj has not written.
    """
    from hyrl_mj.viz.report import write_report

    if out is None:
        pipeline.run_stage(run, "report")
    else:
        with trust.output(out, force=force):
            write_report(run, out)
        print(f"page at {out}")


def export(run: Run, *, to: str, out: Path, field: Path | None = None, force: bool = False) -> None:
    """Write the hybrid controller of a run so that it works without hyrl_mj.

    Args:
        to: onnx (one file, q and measured in, u and q_next out; -1 as the first q), or numpy (a folder
            with controller.py and controller.npz, which need NumPy alone).
        out: the file or the folder to write.
        field: for a run of field, the JSON file of a field with as many posts as the controller will see; by
            default one post.
        force: overwrite a file that hyrl-mj has not written.
    """
    from hyrl_mj.export import FORMS, files_of

    with trust.output(*files_of(to, out), force=force):
        FORMS[to](run.controller, out, field)
    print(f"controller at {out}")


def doctor() -> None:
    """Say whether this machine can train, render and encode, and what it lacks."""
    from hyrl_mj.cli.doctor import report

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
    "sweep": sweep,
    "compare": compare,
    "train": stage_command("train", "Run stage 1 again: train the policy."),
    "critical-set": stage_command("critical-set", "Run stage 2 again: find the critical set."),
    "partition": stage_command("partition", "Run stage 3 again: partition the chart."),
    "extended-sets": extended_sets,
    "retrain": stage_command("retrain", "Run stage 6 again: train the policy of each mode."),
    "robustness": robustness,
    "noise": noise,
    "simulate": simulate,
    "figures": stage_command("figures", "Draw the paper's figures of a run again, as PNG and PDF."),
    "replay": replay,
    "drive": drive,
    "view": view,
    "report": report,
    "export": export,
    "doctor": doctor,
}
