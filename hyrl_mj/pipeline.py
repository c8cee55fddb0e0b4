"""The stages in order: each fills its part of a run directory, from which any can start again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from hyrl_mj import artifacts
from hyrl_mj.algorithms import ALGORITHMS
from hyrl_mj.controllers import Controller, PolicyController
from hyrl_mj.critical_set import find_critical_set
from hyrl_mj.episodes import episodes
from hyrl_mj.errors import BadArtifact, BadInput, NoRenderer, unknown
from hyrl_mj.extended_sets import boundary, extend, with_room
from hyrl_mj.given import FUNCTION, AnyPolicy, take
from hyrl_mj.lattice import Lattice
from hyrl_mj.limit import Limit
from hyrl_mj.noise import KINDS, Noise
from hyrl_mj.partition import Partition, make_partition
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.robustness import (
    BEATEN,
    WON,
    WON_FROM_SOME,
    examine,
    save,
)
from hyrl_mj.run_directory import Run, load_run, open_or_create, write_config
from hyrl_mj.sets import Grid
from hyrl_mj.settings import Agent, Training, preset
from hyrl_mj.tables import replay_sentence, robustness_sentence
from hyrl_mj.tasks.checks import check_task
from hyrl_mj.tasks.registry import get_task

Say = Callable[[str], None]
# Noisy episodes of a run whose worst case cannot be played exactly, and of one that only shows that all runs.
EPISODES, EPISODES_SMOKE = 1_000, 200


# ---- the stages: each reads the artifacts of those before it and writes its own


def train_stage(run: Run, say: Say) -> None:
    """Stage 1: train the policy."""
    from hyrl_mj.training import train

    s = run.settings
    if isinstance(s.stage1, Agent):
        raise BadInput(
            f"{run.path} is about an agent that was given, {s.stage1.source}: there is nothing to train; "
            "hyrl-mj robustify with another --policy and another --out takes another one"
        )
    logs = run.path / "logs" / "stage1"
    policy = train(run.task, s.stage1, s.seed, log_dir=logs, label="stage 1")
    policy.save(run.path / "policy.safetensors")
    say(f"policy of {sum(w.size for w in policy.weights.values())} weights")


def critical_set_stage(run: Run, say: Say) -> None:
    """Stage 2: find the critical set."""
    s = run.settings
    critical = find_critical_set(run.task, run.steady, s.rods, s.resolution, s.search)
    critical.save(run.path / "critical_set.npz")
    say(critical.sentence(run.task))


def partition_stage(run: Run, say: Say) -> None:
    """Stage 3: partition the chart."""
    partition = make_partition(run.task, run.steady, run.critical_set, run.settings.cells)
    partition.save(run.path / "partition.npz")
    say(partition.sentence(run.task))


def extended_sets_stage(run: Run, say: Say) -> None:
    """Stages 4 and 5: extend the parts over the critical set."""
    s, task = run.settings, run.task
    critical, split, ways = run.critical_set, run.partition, None
    if run.agent:
        if Lattice.possible(task):
            lattice = Lattice.of(task, Grid.with_cells(task.chart, s.lattice))
            ways = Limit.of(lattice, split)
            split = with_room(task, run.steady, split, ways, s.noise)
            ways = Limit.of(lattice, split)
            critical = replace(critical, points=boundary(split))
        split.save(run.split_path)
    sets = extend(task, run.steady, critical, split, s.noise, s.horizon, ways)
    sets.save(run.path / "extended_sets.npz")
    say(sets.sentence(task))


def retrain_stage(run: Run, say: Say) -> None:
    """Stages 6 and 7: train the policy of each mode."""
    from hyrl_mj.retraining import retrain

    s, sets = run.settings, run.extended_sets
    logs = run.path / "logs"
    policies: dict[int, MlpPolicy] = {}
    for q in sets.modes:
        policies[q] = retrain(
            run.task,
            run.steady,
            sets,
            q,
            s.stage6,
            s.seed,
            [*policies.values()],
            logs / f"mode_{q}",
            run.partition,
        )
    for q, policy in policies.items():
        policy.save(run.path / f"mode_{q}.safetensors")
    remove_others(run.path.glob("mode_*"), mode_paths(run))
    say(f"policies of {len(policies)} modes")


def robustness_stage(run: Run, say: Say) -> None:
    """Find out what noise can do to the policy and to the hybrid controller."""
    examine_run(run, say=say)


def mode_paths(run: Run) -> list[Path]:
    """The files of the mode policies."""
    suffixes = (".safetensors", ".json")
    return [run.path / f"mode_{q}{suffix}" for q in run.extended_sets.modes for suffix in suffixes]


def remove_others(found: Iterable[Path], wanted: Iterable[Path]) -> None:
    """Remove what an earlier run of a stage, with other modes or starts, has left."""
    for path in set(found) - set(wanted):
        path.unlink()


def simulate_stage(run: Run, say: Say) -> None:
    """Simulate the paper's replay starts, and one on M*, under the paper's noise."""
    from hyrl_mj.arcs import replay_arcs

    arcs, paths = replay_arcs(run), run.arc_paths()
    for key, arc in arcs.items():
        arc.save(paths[key])
    folder = run.path / "arcs"
    remove_others(folder.glob("*.npz"), [*paths.values(), *folder.glob("latest_*.npz")])
    say(f"{len(arcs)} arcs; {replay_sentence(run, arcs)}")


def figures_stage(run: Run, say: Say) -> None:
    """Draw the paper's figures of this run; those that make no sense for its chart are left out."""
    from hyrl_mj import figures

    section, folder = run.section, run.path / "figures"
    task, policy, eps, seed = section.task, run.steady, run.settings.noise, run.settings.seed
    # All is read before anything is written.
    arcs, critical = run.arcs(), run.critical_section
    partition, sets = section.partition(run.partition), section.extended_sets(run.extended_sets)
    noisy = section.arc(arcs.get(("critical", "policy"), arcs["start0", "policy"]))
    figures.overview(task, policy, critical, partition, noisy, folder / "overview.png")
    figures.policy_map(task, policy, critical, eps, seed, folder / "policy.png")
    figures.extended_sets_map(task, critical, sets, folder / "extended_sets.png")
    figures.runs(run.task, arcs, folder / "runs.png")
    say(f"{', '.join(figures.names(task))} in {folder}, as PNG and PDF")


def figure_paths(run: Run) -> list[Path]:
    """The files that `figures_stage` writes."""
    from hyrl_mj import figures

    folder = run.path / "figures"
    return [folder / f"{n}{suffix}" for n in figures.names(run.task) for suffix in (".png", ".pdf")]


def replay_stage(run: Run, say: Say) -> None:
    """Render the replay of the start on M*; without GL or ffmpeg say why, and go on."""
    from hyrl_mj.arcs import replay_floor, replay_shows
    from hyrl_mj.replay import render_replay

    try:
        render_replay(run.task, replay_shows(run), run.path / "replay.mp4", floor=replay_floor(run))
        say(f"video at {run.path / 'replay.mp4'}")
    except NoRenderer as error:
        say(f"no video: {error}")


def report_stage(run: Run, say: Say) -> None:
    """Write the report of all that there is."""
    from hyrl_mj.report import write_report

    path = run.path / "report.html"
    write_report(run, path)
    say(f"page at {path}")


def diagnose_stage(run: Run, say: Say) -> None:
    """Find out what noise can do to the policy alone, draw it, and write it on a page."""
    from hyrl_mj import diagnosis, figures

    section, folder = run.section, run.path / diagnosis.FOLDER
    eps, seed = run.settings.noise, run.settings.seed
    content, maps = _examine(run, {"policy": PolicyController(run.policy)}, run.partition)
    arc = diagnosis.worst_arc(run)
    critical, partition = run.critical_section, section.partition(run.partition)
    shown = section.arc(arc or diagnosis.usual_arc(run))
    figures.overview(section.task, run.steady, critical, partition, shown, folder / "overview.png")
    figures.policy_map(section.task, run.steady, critical, eps, seed, folder / "policy.png")
    if maps is not None:
        _draw_robustness(run, content, maps, folder)
    diagnosis.write_worst(run, arc, say)
    save(folder / "robustness.json", content)
    diagnosis.write_page(run, content, arc)
    for sentence in diagnosis.sentences(run, content, arc):
        say(sentence)
    say(f"page at {run.path / diagnosis.PAGE}")


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline: its function, and the files that tell that it has been done."""

    name: str
    work: Callable[[Run, Say], None]
    outputs: Callable[[Run], list[Path]]


def _files(*names: str) -> Callable[[Run], list[Path]]:
    return lambda run: [run.path / name for name in names]


STAGES = (
    Stage("train", train_stage, lambda run: run.policy_files),
    Stage("critical-set", critical_set_stage, _files("critical_set.npz")),
    Stage("partition", partition_stage, _files("partition.npz")),
    Stage("extended-sets", extended_sets_stage, lambda run: run.set_files),
    Stage("retrain", retrain_stage, mode_paths),
    Stage("robustness", robustness_stage, _files("robustness.json")),
    Stage("simulate", simulate_stage, lambda run: list(run.arc_paths().values())),
    Stage("figures", figures_stage, figure_paths),
    Stage("replay", replay_stage, _files("replay.mp4")),
    Stage("report", report_stage, _files("report.html")),
)


# What `diagnose` does: the first stages, which `robustify` then need not do again, and a page.
DIAGNOSIS = (*STAGES[:3], Stage("diagnose", diagnose_stage, _files("diagnosis.html")))


def run_stage(run: Run, name: str, say: Say = print) -> Run:
    """Run one stage from what is on disk; the run is returned anew, with its result.

    Raises:
        BadInput: there is no stage of that name.
    """
    stages = {stage.name: stage for stage in (*DIAGNOSIS, *STAGES)}
    if name not in stages:
        raise unknown("stage", name, stages)
    # The physics has the cores; BLAS threads that wait for one of them only stall.
    with threadpool_limits(1, user_api="blas"):
        stages[name].work(run, lambda text: say(f"{name}: {text}"))
    return load_run(run.path, run.function)


def done(run: Run, index: int, stages: Sequence[Stage] = STAGES) -> bool:
    """Whether a stage's files are there and no older than those of the stages before it."""
    try:
        outputs = [stage.outputs(run) for stage in stages[: index + 1]]
    except BadArtifact:  # a stage before it has not been done, so its outputs are not known
        return False
    if not all(path.is_file() for paths in outputs for path in paths):
        return False
    source = run.task.source
    if source is not None:  # a robot of the user's that was changed is trained again
        outputs = [[source, run.task.model_path], *outputs]
    times = [[path.stat().st_mtime_ns for path in paths] for paths in outputs]
    return min(times[-1]) >= max((t for earlier in times[:-1] for t in earlier), default=0)


def run(
    task: str | Path,
    *,
    noise: float = 0.1,
    seed: int = 0,
    preset_name: str = "fast",
    algorithm: str | None = None,
    out: str | Path | None = None,
    horizon: float | None = None,
    say: Say = print,
) -> Run:
    """Run all stages, or those that are missing from the run directory.

    Args:
        task: its name, or the Python file that defines it.
        noise: bound eps of the measurement noise to survive, in chart units.
        seed: of everything random.
        preset_name: "fast", "paper" or "smoke".
        algorithm: of stage 1, "ppo", "a2c", "dqn", "sac", "td3" or "ddpg", or as `module:Class` another one
            of SB3's kind; by default the task's.
        out: the run directory, by default `runs/<task>`.
        horizon: time T of the backward propagation [s]; by default the sets are sized to the noise.
        say: told a line about each stage.

    Raises:
        BadInput: a value that cannot be used.
    """
    found = check_task(get_task(task))
    found.algorithm = algorithm or found.algorithm
    settings = preset(found, preset_name, noise=noise, seed=seed, horizon=horizon)
    if found.algorithm not in ALGORITHMS:
        from hyrl_mj.training import check_foreign

        assert isinstance(settings.stage1, Training)
        check_foreign(found, settings.stage1)
    return _run_all(open_or_create(out or Path("runs") / found.name, settings), say)


def _run_all(run: Run, say: Say, stages: Sequence[Stage] = STAGES) -> Run:
    """All stages, or those that are missing."""
    for index, stage in enumerate(stages):
        if stage.name == "train" and run.agent:
            say(f"train: none, {run.agent} is given")
        elif done(run, index, stages):
            say(f"{stage.name}: done before")
        else:
            run = run_stage(run, stage.name, say)
    return run


def robustify(
    task: str | Path,
    policy: AnyPolicy,
    *,
    activation: str | None = None,
    stochastic: bool = False,
    noise: float = 0.1,
    seed: int = 0,
    preset_name: str = "fast",
    out: str | Path | None = None,
    horizon: float | None = None,
    say: Say = print,
) -> Run:
    """Make an agent robust that was trained elsewhere: as `run`, with it in the place of stage 1.

    Args:
        task: its name, or the Python file that defines it.
        policy: the agent: a file (.zip of SB3, .onnx, .safetensors), a function from observations (n, k)
            to inputs (n, m) or levels (n,), or a `Policy`.
        activation: between the layers, for a zip that does not say.
        stochastic: whether a network draws its inputs, as it did while it learned. The stages look at its
            mean or mode; noisy episodes then stand in for the worst-case game.
        noise, seed, preset_name, horizon, say: as for `run`.
        out: the run directory, by default `runs/<task>_robust`.

    Raises:
        BadInput: a value or an agent that cannot be used.
    """
    values = {"noise": noise, "seed": seed, "horizon": horizon}
    run = _with_agent(task, policy, activation, stochastic, preset_name, values, out)
    return _run_all(run, say)


def diagnose(
    task: str | Path,
    policy: AnyPolicy,
    *,
    activation: str | None = None,
    stochastic: bool = False,
    noise: float = 0.1,
    seed: int = 0,
    preset_name: str = "fast",
    out: str | Path | None = None,
    horizon: float | None = None,
    say: Say = print,
) -> Run:
    """Find out what measurement noise can do to an agent, and train nothing.

    The page is `diagnosis.html` in the run directory, the rest in its folder `diagnosis`. `robustify` with
    the same arguments goes on from there.

    Args:
        task, policy, activation, stochastic, noise, seed, preset_name, out, horizon, say: as for
            `robustify`.

    Raises:
        BadInput: a value or an agent that cannot be used.
    """
    values = {"noise": noise, "seed": seed, "horizon": horizon}
    run = _with_agent(task, policy, activation, stochastic, preset_name, values, out)
    return _run_all(run, say, DIAGNOSIS)


def _with_agent(
    task: str | Path,
    policy: AnyPolicy,
    activation: str | None,
    stochastic: bool,
    preset_name: str,
    values: dict[str, Any],
    out: str | Path | None,
) -> Run:
    """The run directory of an agent, with the agent in it; `values` are those of `preset`."""
    found = check_task(get_task(task))
    preset(found, preset_name, **values)  # a wrong value is found before the agent is looked at
    given = take(found, policy, activation, stochastic, values["seed"])
    settings = preset(found, preset_name, **values, agent=given.agent)
    function = given.policy if given.agent.algorithm == FUNCTION else None
    run = open_or_create(out or Path("runs") / f"{found.name}_robust", settings, function)
    if not done(run, 0):
        given.store(run.path)
    return run


def extend_again(run: Run, horizon: float, say: Say = print) -> Run:
    """Run stages 4 and 5 with another horizon T [s], and keep it in `config.json` if that went well."""
    from hyrl_mj.report import beginning

    changed = Run(run.path, replace(run.settings, horizon=horizon), run.function)
    extended_sets_stage(changed, lambda text: say(f"extended-sets: {text}"))
    write_config(changed)
    say(f"go on with {beginning(changed.settings, run.path)}")
    return load_run(run.path, run.function)


def examine_run(
    run: Run,
    eps: float | None = None,
    kinds: Sequence[str] = (),
    count: int | None = None,
    everywhere: bool = False,
    seed: int = 0,
    near: bool = False,
    say: Say = print,
) -> dict[str, Any]:
    """Examine policy and hybrid controller under noise, and write `robustness.json` with its pictures.

    Where the exact game can be played it is; noisy episodes are added on demand, and where they are all
    that there is. Files are written when all is known.

    Args:
        run: with its mode policies.
        eps: noise bound, by default the run's. The scores are for none, half of it, and it.
        kinds: of the noise in episodes, by default all.
        count: number of episodes for each kind and controller.
        everywhere: whether noise acts on all columns of the measurement.
        seed: of starts and noise of the episodes.
        near: whether the episodes all start near M*.
        say: told the result in a line.

    Returns:
        What is in `robustness.json`.

    Raises:
        BadInput: a value that cannot be used.
    """
    content, maps = _examine(run, run.loops, run.split, eps, kinds, count, everywhere, seed, near)
    folder = run.path / "figures"
    if maps is not None:
        _draw_robustness(run, content, maps, folder)
        artifacts.write_arrays(run.path / "robustness.npz", maps, kind="robustness maps")
    save(run.path / "robustness.json", content)
    if run.agent and run.agent.stochastic:
        say("the policy draws its inputs: noisy episodes stand in for the worst case")
    say(robustness_sentence(content))
    return content


def _examine(
    run: Run,
    loops: dict[str, Controller],
    partition: Partition,
    eps: float | None = None,
    kinds: Sequence[str] = (),
    count: int | None = None,
    everywhere: bool = False,
    seed: int = 0,
    near: bool = False,
) -> tuple[dict[str, Any], dict[str, np.ndarray] | None]:
    """What `examine_run` finds out of some controllers, and the maps if the game was played.

    By `partition` what the first measurement calls for is judged.
    """
    task, critical = run.task, run.critical_set
    eps = run.settings.noise if eps is None else eps
    task.check_noise(eps, everywhere)
    if count is None and not run.exact:
        count = EPISODES_SMOKE if run.settings.preset == "smoke" else EPISODES
    if count is not None and count < 1:
        raise BadInput(f"{count} episodes cannot be simulated: give at least 1")
    noises = tuple(Noise(kind, eps, everywhere) for kind in kinds or KINDS[1:])
    content: dict[str, Any] = {"eps": eps, "everywhere": everywhere, "game": None}
    content |= {"episodes": [], "seed": seed}
    winnable, maps = None, None
    if run.exact:
        bounds = tuple(dict.fromkeys((0.0, eps / 2, eps)))
        content["game"], maps = examine(
            task, critical, partition, loops, bounds, everywhere, run.settings.lattice
        )
        grid = Grid.from_counts(task.chart, maps["grid_counts"])
        last = maps[f"map_{[*loops][-1]}"]
        winnable = grid, np.isin(last, (WON, WON_FROM_SOME, BEATEN))
    if count is not None:
        content["episodes"] = episodes(task, critical, loops, noises, count, seed, winnable, near)
    return content, maps


def _draw_robustness(
    run: Run, content: dict[str, Any], maps: dict[str, np.ndarray], folder: Path
) -> None:
    """Draw the map and the curve of the game."""
    from hyrl_mj import figures

    task, game = run.task, content["game"]
    figures.robustness_map(task, game, maps, run.critical_set, folder / "robustness_map.png")
    figures.robustness_curve(task, game, folder / "robustness_curve.png")
