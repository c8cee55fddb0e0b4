"""Whole runs: from a task, or from an agent, to a finished run directory.

The options are frozen values that Python and the command line share. In their docstrings, "by default ..." at
the end of an entry is the default that `--help` shows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from hyrl_mj.errors import BadInput, HyrlError, check_bound, check_seed, counted, unknown
from hyrl_mj.files.manifest import locked
from hyrl_mj.judging import Arrivals, Failures
from hyrl_mj.judging.game import LATTICE
from hyrl_mj.learning import Settings, Training, changed, preset, setting_value
from hyrl_mj.pipeline.steps import DIAGNOSIS, STAGES, run_stage
from hyrl_mj.policies import ALGORITHMS, FUNCTION, AnyPolicy, algorithms, read_agent
from hyrl_mj.runs import directory
from hyrl_mj.runs.directory import opened, write_config
from hyrl_mj.runs.sweeps import MOST_RUNS
from hyrl_mj.sets import coarseness
from hyrl_mj.simulation import Sensor, judge_task
from hyrl_mj.system.progress import Say
from hyrl_mj.tasks import (
    Outcome,
    Task,
    check_as_made,
    check_task,
    get_task,
    hidden_goal,
    is_of_this_package,
    jumped_over,
    overlooked,
    torn,
    try_elsewhere,
)
from hyrl_mj.viz import Run, beginning, load_run

# The paper's bound of the noise.
BOUND = 0.1


@dataclass(frozen=True)
class RunOptions:
    """The options of a run that trains its own policy.

    Attributes:
        eps: bound of the measurement noise to survive, in the units of the chart; by default 0.1.
        noise: in place of a bound what the sensors do, as "uniform 0.05 + bias 0.05 + delay 1"; by default
            what the task declares, if anything.
        seed: seed of all random numbers.
        preset: fast, paper (the paper's training, ten minutes), or smoke (seconds).
        algorithm: the algorithm of stage 1: ppo, a2c, dqn, sac, td3, ddpg, or module:Class for another one
            with the interface of SB3's, as sb3_contrib:TQC; by default the task's.
        horizon: time T of the backward propagation [s], in the paper 0.5 (unit_circle) and 0.3 (vehicle);
            by default the paper's with preset paper, otherwise the sets are sized to the noise.
        all_coordinates: noise on every coordinate of the measurement, not only on the noisy ones of the task.
        go_on: go on also where the policy of stage 1 arrives from less than half of its starts, so that the
            other stages divide what it has not learned; preset smoke always goes on.
        stage1_minutes: where the policy of stage 1 does not arrive from nearly all of its starts, it is
            trained again, paid for being near to the goal, if stage 1 takes no more minutes; by default 10.
        set: settings to change, as they stand in config.json, such as stage1.samples=300000; by default none.
        out: the run directory; by default runs/TASK.
    """

    eps: float | None = None
    noise: str | None = None
    seed: int = 0
    preset: str = "fast"
    algorithm: str | None = None
    horizon: float | None = None
    all_coordinates: bool = False
    go_on: bool = False
    stage1_minutes: float | None = None
    set: dict[str, Any] = field(default_factory=dict)
    out: str | Path | None = None


@dataclass(frozen=True)
class AgentOptions:
    """The options of a run on an agent that was trained elsewhere.

    Attributes:
        activation: activation between the layers of the agent's network, for a zip that does not name it; by
            default that of SB3's policy.
        stochastic: sample the inputs of the agent, as during its training (PPO, A2C, SAC); noisy episodes
            then replace the worst-case game.
        vecnormalize: statistics of the VecNormalize that the agent was trained under, as its save() wrote
            them, or an npz file with mean, var, clip and epsilon; or none if it saw plain observations; by
            default what the agent tells.
        n_stack: the number of observations that the agent sees at once, for one trained under VecFrameStack;
            noisy episodes then replace the worst-case game.
        eps: bound of the measurement noise to survive, in the units of the chart; by default 0.1.
        noise: in place of a bound what the sensors do, as for `hyrl-mj run`; by default what the task
            declares, if anything.
        seed: seed of all random numbers.
        preset: fast, paper or smoke, as for `hyrl-mj run`.
        horizon: time T of the backward propagation [s]; by default the paper's with preset paper, otherwise
            the sets are sized to the noise.
        all_coordinates: noise on every coordinate of the measurement, not only on the noisy ones of the task.
        set: settings to change, as they stand in config.json, such as cells=120; by default none.
        out: the run directory; by default runs/TASK_robust.
    """

    activation: str | None = None
    stochastic: bool = False
    vecnormalize: str | Path | None = None
    n_stack: int = 1
    eps: float | None = None
    noise: str | None = None
    seed: int = 0
    preset: str = "fast"
    horizon: float | None = None
    all_coordinates: bool = False
    set: dict[str, Any] = field(default_factory=dict)
    out: str | Path | None = None


Options = TypeVar("Options")


def complete(kind: type[Options], options: Options | None, changes: dict[str, Any]) -> Options:
    """Returns options, by default those of `kind`, with some of them changed.

    Raises:
        BadInput: they are of another kind, or a change has a name that no option has.
    """
    if options is None:
        options = kind()
    if not isinstance(options, kind):
        raise BadInput(f"options {options!r} cannot be used: give {kind.__name__}(...)")
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for name in changes:
        if name not in names:
            raise unknown("option", name, names)
    return replace(options, **changes)  # type: ignore[type-var]


def several(value: Any) -> tuple[Any, ...]:
    """Returns some values, or the only one, as a tuple; raises `BadInput` for more than any sweep has."""
    one = isinstance(value, str | Path) or not isinstance(value, Iterable)
    values = (value,) if one else tuple(islice(value, MOST_RUNS + 1))
    if len(values) > MOST_RUNS:
        raise BadInput(f"at most {MOST_RUNS:,} runs are made: give fewer values")
    return values


def checked_seeds(seeds: Any) -> tuple[int, ...]:
    """Returns seeds, or a single one, as a tuple; raises `BadInput` for one that is none or comes twice."""
    checked = tuple(map(check_seed, several(seeds)))
    if twice := [seed for seed, count in Counter(checked).items() if count > 1]:
        raise BadInput(f"the seed {twice[0]} is given twice: give each seed once")
    return checked


def checked_bounds(bounds: Any) -> tuple[float, ...]:
    """Returns noise bounds, or a single one, as a tuple; raises `BadInput` for one that cannot be used."""
    return tuple(map(check_bound, several(bounds)))


def setting_values(changes: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings to change by name, with the values of those that are texts."""
    return {name: setting_value(value) for name, value in changes.items()}


def run(
    task: str | Path | Task, options: RunOptions | None = None, *, say: Say = print, **changes: Any
) -> Run:
    """Runs all stages, or those that the run directory lacks.

    Args:
        task: name of a task, the Python file that defines one, or a task, as of `from_gymnasium`.
        options: the options, by default `RunOptions()`.
        say: receives a line about each stage.
        changes: fields of the options to change, as in `run("vehicle", eps=0.2, seed=3)`.

    Raises:
        BadInput: a value that cannot be used.
        HyrlError: stage 1 has not learned the task.
    """
    options = complete(RunOptions, options, changes)
    checked = usable_task(task)
    settings = settings_of(checked, options)
    if options.algorithm is not None:
        algorithms.remember(options.algorithm)
    with opened(options.out or Path("runs") / checked.name, settings) as run:
        return _run_all(run, say, learned=not options.go_on and settings.preset != "smoke")


def robustify(
    task: str | Path | Task,
    policy: AnyPolicy,
    options: AgentOptions | None = None,
    *,
    say: Say = print,
    **changes: Any,
) -> Run:
    """Makes an agent robust that was trained elsewhere: as `run`, with the agent in place of stage 1.

    Args:
        task: as for `run`.
        policy: the agent: a file (.zip of SB3, .onnx, .safetensors), a `Policy`, or what `from_callable`
            takes, such as a function from observations (n, k) to inputs (n, m) or levels (n,).
        options: the options, by default `AgentOptions()`.
        say: as for `run`.
        changes: as for `run`.

    Raises:
        BadInput: a value or an agent that cannot be used.
    """
    with _with_agent(task, policy, complete(AgentOptions, options, changes)) as run:
        return _run_all(run, say)


def diagnose(
    task: str | Path | Task,
    policy: AnyPolicy,
    options: AgentOptions | None = None,
    *,
    say: Say = print,
    **changes: Any,
) -> Run:
    """Examines what measurement noise can do to an agent; trains nothing.

    The page is `diagnosis.html` in the run directory; all other files are in its folder `diagnosis`. The
    arguments are those of `robustify`, which continues in the same run directory.

    Raises:
        BadInput: a value or an agent that cannot be used.
    """
    with _with_agent(task, policy, complete(AgentOptions, options, changes)) as run:
        return _run_all(run, say, DIAGNOSIS)


def usable_task(task: str | Path | Task) -> Task:
    """Returns a task that can be trained, and that a run directory leads to."""
    found = get_task(task)
    if found is task:
        check_as_made(found)
    return check_task(found, played=not is_of_this_package(found))


def extend_again(run: directory.Run, horizon: float, say: Say = print) -> Run:
    """Runs stages 4 and 5 with another horizon T [s], and writes T to `config.json` if they succeed."""
    changed = directory.Run(run.path, replace(run.settings, horizon=horizon), run.function)
    with locked(run.path):
        run_stage(changed, "extended-sets", say)
        write_config(changed, run.versions)
    say(f"go on with {beginning(changed, run.path)}")
    return load_run(run.path, run.function)


def _run_all(
    run: directory.Run, say: Say, stages: Collection[str] = STAGES, learned: bool = False
) -> Run:
    """Runs the stages that are not done; those after the first only if it has `learned`, if that is asked."""
    if others := run.manifest.other_versions(stages):
        say(f"the stages that hyrl-mj {' and '.join(others)} made are run again")
    if not run.manifest.is_done("critical-set"):
        judge_task(run.task)
        try_elsewhere(run.task)
    if "robustness" in stages and not run.manifest.is_done("robustness"):
        say(f"the run will be examined {examination_plan(run)}")
    s = run.settings
    if not run.manifest.is_done("train"):
        task = run.task
        cautions = [torn(task), overlooked(task), hidden_goal(task, s.eps, s.everywhere)]
        if not is_of_this_package(task):
            cautions.append(jumped_over(task))
        for caution in filter(None, cautions):
            say(caution)
    if "partition" in stages and not run.manifest.is_done("partition"):
        bounds = run.task.noise_in_chart(s.eps, s.everywhere)
        if sentence := coarseness(run.task.chart, s.cells, bounds):
            say(sentence)
    for stage in stages:
        if stage == "train" and run.agent:
            say(f"train: none, {run.agent} is given; it {run.arrivals}")
        elif run.manifest.is_done(stage) and (stage != "robustness" or run.is_examined_as_usual):
            say(f"{stage}: done before")
        else:
            run = run_stage(run, stage, say)
        if stage == "train" and learned:
            _check_learned(run)
    return Run.of(run)


def _check_learned(run: directory.Run) -> None:
    """Raises `HyrlError` if the policy of stage 1 arrives from less than half of the starts."""
    task, settings, arrivals = run.task, run.settings.stage1, run.arrivals
    if arrivals.most:
        return
    assert isinstance(settings, Training)
    failures = Failures.of(task, run.policy)
    counts = Counter(Outcome(int(end)) for end in failures.ends if end != Outcome.REACHED)
    how = ", ".join(f"{count:,} {outcome.label}" for outcome, count in counts.most_common())
    if failures.nearest is not None:
        how += f"; the nearest comes within {failures.nearest:.3g} of the set-point"
    if failures.earned is not None and failures.earned > 0 and task.ends_well:
        how += (
            f"; the stalled ones earn {failures.earned:.3g} a sample where they are, and nothing once they "
            "have arrived: a reward below 0 on the way makes arriving pay"
        )
    raise HyrlError(
        f"stage 1 has not learned {task.name} in {counted(arrivals.trainings, 'training')}: its policy "
        f"{arrivals} (the others: {how}). See whether the goal can be reached and whether the reward "
        f"leads there; train longer with --set stage1.samples={2 * settings.samples} and another --out, or "
        "go on as it is with --go-on"
    )


def settings_of(task: Task, options: RunOptions) -> Settings:
    """Returns the settings of a run with these options.

    Raises:
        BadInput: a value that cannot be used.
    """
    settings = _settings(task, options, algorithm=options.algorithm)
    stage1 = settings.stage1
    assert isinstance(stage1, Training)
    if options.stage1_minutes is not None:
        stage1 = replace(stage1, minutes=options.stage1_minutes)
    if stage1.algorithm not in ALGORITHMS:
        from hyrl_mj.learning.training import check_foreign

        check_foreign(task, stage1)
    return replace(settings, stage1=stage1)


def _settings(task: Task, options: RunOptions | AgentOptions, **changes: Any) -> Settings:
    """Returns the settings of the preset that options name."""
    eps, seed, horizon = options.eps, options.seed, options.horizon
    given: object = options.noise
    if not (given is None or isinstance(given, str | Sensor)):
        raise BadInput(
            f"the noise {given!r:.60} cannot be used: give a text, as 'uniform 0.05 + delay 1', or a bound "
            "by eps"
        )
    sensor = None if given is None else str(given)
    if task.sensor and not isinstance(task.sensor, str):
        raise BadInput(f"sensor of {task.name} is {task.sensor!r:.60}: give a text, as 'bias 0.1'")
    if task.sensor:  # what is wrong with it is said now
        Sensor.parse(task.sensor)
    if sensor is None and eps is None:
        sensor = task.sensor or None
    if sensor is not None:
        if eps is not None or options.all_coordinates:
            raise BadInput(
                f"the noise {sensor!r} tells its bounds and where they act: leave eps and all_coordinates out"
            )
        eps, shares = (parsed := Sensor.parse(sensor)).on(task)
        sensor, task = str(parsed), task.with_sensor(str(parsed), shares)
    eps = BOUND if eps is None else eps
    settings = preset(task, options.preset, eps=eps, seed=seed, horizon=horizon, **changes)
    settings = replace(settings, everywhere=options.all_coordinates, sensor=sensor)
    if options.set:
        settings = changed(settings, options.set)
    settings.check(task)
    return settings


@contextmanager
def _with_agent(
    task: str | Path | Task, policy: AnyPolicy, options: AgentOptions
) -> Iterator[directory.Run]:
    """Opens the run directory of an agent, which then holds the agent, and holds its lock in the block."""
    checked = usable_task(task)
    _settings(checked, options)  # a wrong value is reported before the agent is read
    o = options
    external = read_agent(
        checked, policy, o.activation, o.stochastic, o.seed, o.vecnormalize, o.n_stack
    )
    settings = _settings(checked, options, agent=external.agent)
    function = external.policy if external.agent.algorithm == FUNCTION else None
    path = options.out or Path("runs") / f"{checked.name}_robust"
    with opened(path, settings, function) as run:
        if not run.manifest.is_done("train"):
            with run.manifest.stage("train"):
                arrivals = Arrivals.measure(checked, external.policy)
                external.store(run.path)
                arrivals.save(run.path / "arrivals.json")
        yield run


def examination_plan(run: directory.Run) -> str:
    """Returns how a run will be examined, and why not in another way, before anything is trained."""
    if run.why_no_game:
        return f"by noisy episodes and an attack, because {run.why_no_game}"
    grid = run.lattice_grid
    wanted = run.settings.lattice or LATTICE[run.task.chart.dimension]
    nodes = f"{' x '.join(map(str, grid.counts))} nodes"
    if max(grid.counts) < wanted:
        nodes += (
            f" (fewer than {wanted:,} on a side, so that they fit into the memory, and samples lead from "
            "node to node)"
        )
    if run.exact:
        return f"by the worst-case game on {nodes}"
    return f"by noisy episodes and an attack, and by the worst-case game on {nodes}: {run.why_estimate}"
