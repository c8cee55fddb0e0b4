"""The options of the command line that describe an environment."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyrl_mj import artifacts
from hyrl_mj.environments.making import MARK, from_gymnasium
from hyrl_mj.environments.task import EnvironmentTask
from hyrl_mj.errors import BadInput, brief, unknown
from hyrl_mj.tasks import Task, get_task


@dataclass(frozen=True)
class EnvironmentOptions:
    """An environment of Gymnasium in place of a task.

    Attributes:
        env: id of an environment of Gymnasium that MuJoCo simulates, in place of TASK, as
            PointMaze_Medium-v3; by default none.
        env_args: a JSON file with arguments of hyrl_mj.from_gymnasium, such as reset, pinned, kwargs, bounds
            and steps; by default none.
        chart: names of the coordinates in which the decision falls, as achieved_goal, or
            shoulder=qpos[0],elbow=qpos[1]; by default what is found.
        noisy: share of --eps on each coordinate of the chart; by default 1 on positions.
        success: when an episode is a success, as info, terminated, "reward >= 1" or
            "distance(fingertip, target) <= 0.05"; by default what info tells.
        failure: when an episode is a failure, as 'info["collision"]'; by default when it is terminated
            without success.
        explain: say what was found out about the environment and how to change it, and do nothing else.
    """

    env: str | None = None
    env_args: Path | None = None
    chart: tuple[str, ...] | None = None
    noisy: tuple[float, ...] | None = None
    success: str | None = None
    failure: str | None = None
    explain: bool = False


def chosen_task(task: str | None, options: EnvironmentOptions) -> Task:
    """Returns the task of a name or file, or of an environment.

    Raises:
        BadInput: both or none of them is given, or the environment cannot be used.
    """
    if options.env is None:
        if options != EnvironmentOptions():
            raise BadInput(
                "--env-args, --chart, --noisy, --success, --failure and --explain need an --env"
            )
        if task is None:
            raise BadInput("give a TASK, see hyrl-mj list, or an environment with --env ID")
        return get_task(task)
    if task is not None:
        raise BadInput(f"give the task {task} or --env {options.env}, not both")
    given = {} if options.env_args is None else _arguments(options.env_args)
    if options.chart is not None:
        given["chart"] = _chart(options.chart)
    for name in ("noisy", "success", "failure"):
        if (value := getattr(options, name)) is not None:
            given[name] = value
    return from_gymnasium(options.env, **given)


def explained(task: Task) -> str:
    """Returns what was given and found out about an environment, and how to change it."""
    assert isinstance(task, EnvironmentTask)
    lines = [f"{task.name}: {task!r}"]
    for name, value in json.loads(task.spec.removeprefix(MARK)).items():
        lines.append(f"  {name}: {value if isinstance(value, str) else json.dumps(value)} (given)")
    for name, text in task.found.items():
        lines += [f"  {name}: {text}", f"    (to change it, give {_INSTEAD.get(name, name)})"]
    return "\n".join(lines)


# What to give to change what was found, where it has another name.
_INSTEAD = {
    "noise": "noisy",
    "goal": "reset, pinned or seed",
    "ways": "chart",
    "lag": "an environment that calls mj_forward at the end of step()",
    "sample time": "kwargs, such as frame_skip, if the environment takes it",
    "camera": "task.scene another one in Python",
}


def _arguments(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(artifacts.read_limited(path).decode())
    except OSError as error:
        raise BadInput(f"{path} cannot be read ({error.strerror}): give a JSON file") from None
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path} is no JSON ({brief(error)}): give a JSON file") from None
    if not isinstance(content, dict):
        raise BadInput(
            f"{path} holds no JSON object: give one with arguments of hyrl_mj.from_gymnasium"
        )
    allowed = [name for name in inspect.signature(from_gymnasium).parameters if name != "env"]
    for name in content:
        if name not in allowed:
            raise unknown(f"argument in {path}", name, allowed)
    return content


def _chart(words: tuple[str, ...]) -> list[str] | Mapping[str, str]:
    """Returns the chart of words such as "achieved_goal" or "shoulder=qpos[0]"."""
    pairs = [word.partition("=") for word in words]
    named = [equals for _, equals, _ in pairs]
    if not any(named):
        return list(words)
    if not all(named):
        raise BadInput(
            f"--chart {','.join(words)} names some coordinates anew: name all of them, or none"
        )
    return {name.strip(): value.strip() for name, _, value in pairs}
