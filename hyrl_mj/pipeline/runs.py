"""Whole runs: from a task, or from an agent, to a finished run directory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hyrl_mj.errors import BadArtifact
from hyrl_mj.learning import Training, preset
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
    settings = preset(
        found, preset_name, noise=noise, seed=seed, horizon=horizon, algorithm=algorithm
    )
    assert isinstance(settings.stage1, Training)
    if settings.stage1.algorithm not in ALGORITHMS:
        from hyrl_mj.learning.training import check_foreign

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
    external = read_agent(found, policy, activation, stochastic, values["seed"])
    settings = preset(found, preset_name, **values, agent=external.agent)
    function = external.policy if external.agent.algorithm == FUNCTION else None
    run = open_or_create(out or Path("runs") / f"{found.name}_robust", settings, function)
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
