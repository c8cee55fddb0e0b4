"""Whole runs: from a task, or from an agent, to a finished run directory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from hyrl_mj.errors import BadArtifact
from hyrl_mj.learning import Training, preset
from hyrl_mj.pipeline.options import AgentOptions, RunOptions, complete
from hyrl_mj.pipeline.steps import DIAGNOSIS, STAGES, Stage, extended_sets_stage, run_stage
from hyrl_mj.policies import ALGORITHMS, FUNCTION, AnyPolicy, read_agent
from hyrl_mj.progress import Say
from hyrl_mj.run_directory import Run, load_run, open_or_create, write_config
from hyrl_mj.tasks import check_task, get_task
from hyrl_mj.viz import beginning


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
    task: str | Path, options: RunOptions | None = None, *, say: Say = print, **changes: Any
) -> Run:
    """Run all stages, or those that are missing from the run directory.

    Args:
        task: name of a task, or the Python file that defines one.
        options: how to run it, by default `RunOptions()`.
        say: told a line about each stage.
        changes: fields of the options that differ, as in `run("vehicle", eps=0.2, seed=3)`.

    Raises:
        BadInput: a value that cannot be used.
    """
    options = complete(RunOptions, options, changes)
    plan = check_task(get_task(task))
    settings = preset(
        plan,
        options.preset,
        noise=options.eps,
        seed=options.seed,
        horizon=options.horizon,
        algorithm=options.algorithm,
    )
    assert isinstance(settings.stage1, Training)
    if settings.stage1.algorithm not in ALGORITHMS:
        from hyrl_mj.learning.training import check_foreign

        check_foreign(plan, settings.stage1)
    return _run_all(open_or_create(options.out or Path("runs") / plan.name, settings), say)


def _run_all(run: Run, say: Say, stages: Sequence[Stage] = STAGES) -> Run:
    """Run all stages, or those that are missing."""
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
    options: AgentOptions | None = None,
    *,
    say: Say = print,
    **changes: Any,
) -> Run:
    """Make an agent robust that was trained elsewhere: as `run`, with the agent in place of stage 1.

    Args:
        task: name of a task, or the Python file that defines one.
        policy: the agent: a file (.zip of SB3, .onnx, .safetensors), a function from observations (n, k)
            to inputs (n, m) or levels (n,), or a `Policy`.
        options: how to run it, by default `AgentOptions()`.
        say: told a line about each stage.
        changes: fields of the options that differ, as for `run`.

    Raises:
        BadInput: a value or an agent that cannot be used.
    """
    return _run_all(_with_agent(task, policy, complete(AgentOptions, options, changes)), say)


def diagnose(
    task: str | Path,
    policy: AnyPolicy,
    options: AgentOptions | None = None,
    *,
    say: Say = print,
    **changes: Any,
) -> Run:
    """Find out what measurement noise can do to an agent, and train nothing.

    The page is `diagnosis.html` in the run directory, everything else is in its folder `diagnosis`.
    `robustify` with the same arguments continues from there.

    Args:
        task: name of a task, or the Python file that defines one.
        policy: the agent, as for `robustify`.
        options: how to run it, by default `AgentOptions()`.
        say: told a line about each stage.
        changes: fields of the options that differ, as for `run`.

    Raises:
        BadInput: a value or an agent that cannot be used.
    """
    run = _with_agent(task, policy, complete(AgentOptions, options, changes))
    return _run_all(run, say, DIAGNOSIS)


def _with_agent(task: str | Path, policy: AnyPolicy, options: AgentOptions) -> Run:
    """Returns the run directory of an agent, with the agent in it."""
    plan = check_task(get_task(task))
    settings = partial(
        preset,
        plan,
        options.preset,
        noise=options.eps,
        seed=options.seed,
        horizon=options.horizon,
    )
    settings()  # a wrong value is reported before the agent is read
    external = read_agent(plan, policy, options.activation, options.stochastic, options.seed)
    function = external.policy if external.agent.algorithm == FUNCTION else None
    path = options.out or Path("runs") / f"{plan.name}_robust"
    run = open_or_create(path, settings(agent=external.agent), function)
    if not done(run, 0):
        external.store(run.path)
    return run


def extend_again(run: Run, horizon: float, say: Say = print) -> Run:
    """Run stages 4 and 5 with another horizon T [s], and keep it in `config.json` if that went well."""
    changed = Run(run.path, replace(run.settings, horizon=horizon), run.function)
    extended_sets_stage(changed, lambda text: say(f"extended-sets: {text}"))
    write_config(changed)
    say(f"go on with {beginning(changed.settings, run.path)}")
    return load_run(run.path, run.function)
