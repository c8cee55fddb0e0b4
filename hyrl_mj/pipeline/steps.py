"""The stages in order: each reads the files of those before it from the run directory, and writes its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from hyrl_mj.errors import BadInput, NoRenderer, unknown
from hyrl_mj.judging import (
    USUAL,
    Arrivals,
    ExamineOptions,
    Failures,
    ModeResult,
    Retraining,
    Subject,
    examine,
    mode_sentence,
)
from hyrl_mj.judging.game import Lattice, Limit, Robustness
from hyrl_mj.learning import Settings, Training
from hyrl_mj.physics import mujoco_log
from hyrl_mj.policies import Agent, Controller, MlpPolicy, Policy, PolicyController, algorithms
from hyrl_mj.runs.arcs import replay_arcs
from hyrl_mj.runs.diagnosis import losses_of, sentences, usual_arc, worst_arc
from hyrl_mj.runs.directory import Run
from hyrl_mj.stages import (
    HeldInputs,
    Partition,
    boundary,
    extend,
    find_critical_set,
    held_inputs,
    make_partition,
    open_ways,
    part_policies,
    with_room,
)
from hyrl_mj.system import cores
from hyrl_mj.system.progress import Say
from hyrl_mj.tasks import SPARING
from hyrl_mj.viz import ReplayOptions, replay_sentence, robustness_sentence

if TYPE_CHECKING:
    from hyrl_mj.stages.retraining import Grounds, ModePolicy

# The video with preset smoke only shows that a video can be made.
SMOKE = ReplayOptions(size=(640, 360), fps=10)


def train_stage(run: Run, say: Say) -> None:
    """Stage 1: trains the policy."""
    s = run.settings
    if isinstance(s.stage1, Agent):
        raise BadInput(
            f"{run.path} holds a run on the agent {s.stage1.source}: there is nothing to train; for another "
            "agent, use hyrl-mj robustify with another --policy and another --out"
        )
    algorithms.check_named(s.stage1.algorithm)
    policy, arrivals = _first_policy(run, s.stage1, say)
    policy.save(run.path / "policy.safetensors")
    arrivals.save(run.path / "arrivals.json")
    say(f"a policy of {sum(w.size for w in policy.weights.values())} weights {arrivals}")
    if arrivals.arrived < arrivals.episodes:
        from hyrl_mj.viz.figures import charts, draw_arrivals, style

        if charts.drawable(run.task.chart):
            path = run.path / "figures" / "arrivals.png"
            found = Failures.of(run.task, policy)
            style.write(draw_arrivals(run.task, found.starts, found.ends), path)
            say(f"{path} shows from where it does not arrive")


def _first_policy(run: Run, settings: Training, say: Say) -> tuple[MlpPolicy, Arrivals]:
    """Trains the policy of stage 1 until it arrives from nearly all starts, as often as settings allow."""
    from hyrl_mj.learning.to_go import NoWay
    from hyrl_mj.learning.training import train

    began, logs = time.monotonic(), run.path / "logs"
    policy = train(run.task, settings, run.settings.seed, log_dir=logs / "stage1", label="stage 1")
    found = Arrivals.measure(run.task, policy)
    arrivals = replace(found, trainings=1, shaped=settings.shaped)
    for number in range(1, settings.attempts):
        if arrivals.nearly_all or (number > 1 and arrivals.most):
            break
        again = settings.attempt(number)
        spent = (time.monotonic() - began) / 60
        needed = spent * (1 + again.samples / settings.samples / number)
        if needed > settings.minutes:
            say(
                f"another training, paid for being near to the goal, would end after {needed:.1f} minutes of "
                f"stage 1, which may take {settings.minutes:g}: more is allowed with --stage1-minutes"
            )
            break
        say(f"a policy that {arrivals}: another training is paid for being near to the goal")
        seed = int(np.random.SeedSequence([run.settings.seed, 0, number]).generate_state(1)[0])
        folder, label = logs / f"stage1_{number + 1}", f"stage 1, attempt {number + 1}"
        try:
            other = train(run.task, again, seed, log_dir=folder, label=label)
        except NoWay as error:
            say(str(error))
            break
        found = Arrivals.measure(run.task, other)
        if found.arrived > arrivals.arrived:
            policy, arrivals = other, replace(found, shaped=True)
        arrivals = replace(arrivals, trainings=number + 1)
    return policy, arrivals


def critical_set_stage(run: Run, say: Say) -> None:
    """Stage 2: finds the critical set."""
    s = run.settings
    critical = find_critical_set(
        run.task, run.steady, s.rods, s.resolution, s.search, s.eps, s.ways
    )
    critical.save(run.path / "critical_set.npz")
    say(critical.sentence(run.task))


def partition_stage(run: Run, say: Say) -> None:
    """Stage 3: partitions the chart."""
    s = run.settings
    points = run.critical_set.points
    partition = make_partition(run.task, run.steady, points, s.cells, s.eps, s.ways)
    partition.save(run.path / "partition.npz")
    say(partition.sentence(run.task, s.ways))


def extended_sets_stage(run: Run, say: Say) -> None:
    """Stages 4 and 5: extends the parts over the critical set."""
    s, task, policy = run.settings, run.task, run.steady
    points, split, ways = run.critical_set.points, run.partition, None
    if run.agent and not Lattice.why_not(task) and Lattice.decides(task, run.lattice_grid):
        lattice = Lattice.tabulate(task, run.lattice_grid)
        limit = Limit.solve(lattice, split)
        split = with_room(task, policy, split, open_ways(limit, split.grid), s.eps)
        ways = open_ways(Limit.solve(lattice, split), split.grid)
        points = boundary(split)
    sets = extend(task, policy, points, split, s.eps, s.horizon, ways, s.overlap)
    if held_inputs(task, split.grid) is not None:  # which have shown from where each way is open
        split = with_room(task, policy, split, sets.winning, s.eps)
        if split is not run.partition:
            points = boundary(split)
            sets = extend(task, policy, points, split, s.eps, s.horizon, sets.winning, s.overlap)
    if run.agent or split is not run.partition:
        split.save(run.path / "split.npz")
    sets.save(run.path / "extended_sets.npz")
    say(sets.sentence(task))


def retrain_stage(run: Run, say: Say) -> None:
    """Stage 6: trains the policy of each mode."""
    from hyrl_mj.stages.grounds import mode_ground
    from hyrl_mj.stages.retraining import with_later_images

    sets, task = run.extended_sets, run.task
    algorithms.check_named(run.settings.stage6.algorithm)
    held = HeldInputs.from_sets(task, sets, run.settings.table) if task.effort.attacked else None
    s = run.settings
    grounds: Grounds = partial(
        mode_ground, task, sets, parts=run.split, policy=run.steady, table=held is not None,
        settings=s.modes, attacks=s.attack,
        # Where the task's reward has led to no goal in stage 1, it leads to none here.
        shaped=run.arrivals.shaped,
    )  # fmt: skip
    work = partial(_retrained, grounds, held, s, run.steady, run.partition, run.path / "logs")
    done: list[tuple[ModePolicy, ModeResult]] = []
    if task.mirror is None:
        done += cores.in_processes(work, sets.modes)
    else:  # the mirror image of the policy of one mode may do for the next
        for q in sets.modes:
            done.append(work(q, tuple(done)))
        done = with_later_images(done, grounds, s.stage6)
    for policy, result in done:
        policy.save(run.path / f"mode_{result.mode}.safetensors")
    Retraining(tuple(result for _, result in done)).save(run.path / "retraining.json")
    for _, result in done:
        say(mode_sentence(task, result))


def _retrained(
    grounds: Grounds,
    held: HeldInputs | None,
    s: Settings,
    policy: Policy,
    partition: Partition,
    logs: Path,
    mode: int,
    others: Iterable[tuple[ModePolicy, ModeResult]] = (),
) -> tuple[ModePolicy, ModeResult]:
    """Trains the policy of one mode, which may happen in a process of a pool."""
    from hyrl_mj.stages.retraining import retrain, start_policy

    ground = grounds(mode)
    untrained: list[ModePolicy] = []
    attacked = ground.task.effort.attacked
    if attacked or len(ground.extended.modes) == 1:  # or nothing is to be decided
        part = part_policies(ground.task, policy, partition, ground.extended.eps)[mode]
        if attacked:
            untrained.append(part)
        if held is None:  # only trainings could follow: the first policy is tried unchanged, too
            if isinstance(policy, MlpPolicy) and not attacked:
                untrained.append(policy)
            else:
                untrained.append(part.undivided)
    return retrain(
        ground,
        s.stage6,
        s.seed,
        warm_start=partial(start_policy, policy, partition),
        others=others,
        untrained=untrained,
        held=held,
        log_dir=logs / f"mode_{mode}",
    )


def examine_stage(run: Run, say: Say, options: ExamineOptions = USUAL) -> None:
    """Examines policy and hybrid controller under noise; all files are written at the end."""
    subject = replace(subject_of(run, run.controllers, run.split), alike=run.keeps_agent)
    options.budget(subject.effort, subject.exact)  # a wrong one is refused before the work
    found = examine(subject, options, attacked=True)
    for name, arc in found.arcs.items():
        arc.save(run.arc_path("attack", name))
    if found.maps is not None:
        from hyrl_mj.viz import figures

        shown = figures.Shown(run, game=found.robustness.game, maps=found.maps)
        figures.draw_all(shown, run.path / "figures", "game")
        found.maps.save(run.path / "robustness.npz")
    found.robustness.save(run.path / "robustness.json")
    if run.agent and run.agent.why_no_function:
        say(f"{run.agent.why_no_function}: noisy episodes stand in for the worst case")
    say(robustness_sentence(found.robustness))


def subject_of(run: Run, controllers: dict[str, Controller], partition: Partition) -> Subject:
    """Returns what is examined of a run; `partition` decides which mode the first measurement selects."""
    s = run.settings
    return Subject(
        run.task,
        controllers,
        run.critical_set.points,
        partition.parts,
        s.eps,
        s.everywhere,
        s.lattice,
        playable=run.why_no_game is None,
        exact=run.exact,
        effort=SPARING if s.preset == "smoke" else run.task.effort,
        attacks=s.attack,
    )


def simulate_stage(run: Run, say: Say) -> None:
    """Stage 7: simulates the paper's replay starts, and one on M*, under the paper's noise."""
    arcs, paths = replay_arcs(run), run.arc_paths()
    for key, arc in arcs.items():
        arc.save(paths[key])
    say(f"{len(arcs)} arcs; {replay_sentence(run, arcs)}")


def figures_stage(run: Run, say: Say) -> None:
    """Draws the figures of a run that its chart allows."""
    from hyrl_mj.viz import figures

    folder = run.path / "figures"
    drawn = figures.draw_all(figures.Shown(run), folder, "policy", "controller")
    say(f"{', '.join(drawn)} in {folder}, as PNG and PDF")


def replay_stage(run: Run, say: Say) -> None:
    """Renders the replay of the start on M*; without GL or ffmpeg reports why not."""
    from hyrl_mj.viz.replay import render_replay
    from hyrl_mj.viz.shows import replay_floor, replay_shows

    shows = replay_shows(run)
    options = SMOKE if run.settings.preset == "smoke" else ReplayOptions()
    options = options.lasting(sum(show.seconds for show in shows))
    try:
        render_replay(run.task, shows, run.path / "replay.mp4", options, floor=replay_floor(run))
        say(f"video at {run.path / 'replay.mp4'}")
    except NoRenderer as error:
        say(f"no video: {error}")


def report_stage(run: Run, say: Say) -> None:
    """Writes the report of all results."""
    from hyrl_mj.viz.report import write_report

    path = run.path / "report.html"
    write_report(run, path)
    say(f"page at {path}")


def diagnose_stage(run: Run, say: Say) -> None:
    """Examines what noise can do to the policy alone, and writes figures and a page."""
    from hyrl_mj.viz import diagnosis, figures

    folder = run.path / diagnosis.FOLDER
    alone: dict[str, Controller] = {"policy": PolicyController(run.policy)}
    found = examine(subject_of(run, alone, run.partition))
    losses = losses_of(run)
    arc = worst_arc(run, losses)
    shown = figures.Shown(run, arc or usual_arc(run), found.robustness.game, found.maps)
    figures.draw_all(shown, folder, "policy", *(["game"] if found.maps is not None else []))
    diagnosis.write_worst(run, arc, say)
    found.robustness.save(folder / "robustness.json")
    results = sentences(run, found.robustness, arc, losses)
    diagnosis.write_page(run, found.robustness, arc, results)
    for sentence in results:
        say(sentence)
    say(f"page at {run.path / diagnosis.PAGE}")


# The stages of a run in their order; stages 4 and 5 of the paper are one.
STAGES: dict[str, Callable[[Run, Say], None]] = {
    "train": train_stage,
    "critical-set": critical_set_stage,
    "partition": partition_stage,
    "extended-sets": extended_sets_stage,
    "retrain": retrain_stage,
    "robustness": examine_stage,
    "simulate": simulate_stage,
    "figures": figures_stage,
    "replay": replay_stage,
    "report": report_stage,
}
# The stages of `diagnose`: the first three, which `robustify` need not run again, and a page.
DIAGNOSIS = {**dict(list(STAGES.items())[:3]), "diagnose": diagnose_stage}


def run_stage(run: Run, name: str, say: Say = print) -> Run:
    """Runs one stage from the files on disk, and returns the run with its result.

    Raises:
        BadInput: an unknown stage, or another process works on the run directory.
    """
    if name not in (stages := DIAGNOSIS | STAGES):
        raise unknown("stage", name, stages)

    def say_here(text: str) -> None:
        say(f"{name}: {text}")

    before = mujoco_log.counts.copy()
    finished = as_stage(run, name, lambda fresh: stages[name](fresh, say_here))
    if warnings := mujoco_log.since(before):
        say_here(warnings)
    return finished


def examine_run(run: Run, options: ExamineOptions = USUAL, say: Say = print) -> Robustness:
    """Examines policy and hybrid controller under noise, and writes `robustness.json` with its figures.

    The worst-case game is played where possible; noisy episodes are added on request, or replace the game.

    Args:
        run: a run with its mode policies.
        options: what to examine. The scores are for no noise, half the bound, and the bound.
        say: receives the result in a line.

    Raises:
        BadInput: a value that cannot be used, or another process works on the run directory.
    """
    return as_stage(run, "robustness", partial(examine_stage, say=say, options=options)).robustness


def as_stage(run: Run, name: str, work: Callable[[Run], object]) -> Run:
    """Does the work of a stage on a run, records it, and returns the run with its result.

    Raises:
        BadInput: another process works on the run directory.
    """
    fresh = run.anew()  # so that the manifest records what was read
    # The physics uses all cores: BLAS threads would only wait for them.
    with threadpool_limits(1, user_api="blas"), fresh.manifest.stage(name):
        work(fresh)
    return fresh.anew()
