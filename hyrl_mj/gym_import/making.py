"""Tasks are made of environments: by arguments, by options, and again from the texts that describe them."""

from __future__ import annotations

import copy
import gc
import json
import os
import re
import shlex
from collections import deque
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any
from weakref import WeakSet, WeakValueDictionary

import gymnasium as gym
import numpy as np

from hyrl_mj.errors import BadInput, brief, described, printable, unknown
from hyrl_mj.files import artifacts, trust
from hyrl_mj.gym_import.inspection import inspect
from hyrl_mj.gym_import.opening import (
    AnyChart,
    Description,
    register,
    with_arrays,
)
from hyrl_mj.gym_import.task import EnvironmentTask
from hyrl_mj.system.generators import kept_generators
from hyrl_mj.tasks import ENVIRONMENT, Task, get_task

# The newest task of each text, for as long as somebody has it, and the last ones for longer.
_MADE: MutableMapping[str, EnvironmentTask] = WeakValueDictionary()
_RECENT: deque[EnvironmentTask] = deque(maxlen=2)
# Older tasks of functions of the same name.
_OLDER: WeakSet[EnvironmentTask] = WeakSet()
# Of a file of arguments [bytes], each of which is copied, compared and written down.
LARGEST = 2**20


def from_gymnasium(
    env: str | Callable[..., gym.Env],
    *,
    chart: AnyChart | None = None,
    noisy: Sequence[float] | None = None,
    success: str | None = None,
    failure: str | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    steps: int | None = None,
    starts: str = "chart",
    kwargs: Mapping[str, Any] | None = None,
    reset: Mapping[str, Any] | None = None,
    pinned: Mapping[str, Any] | None = None,
    seed: int | None = None,
) -> EnvironmentTask:
    """Returns a task whose plant is an environment of MuJoCo, as it is.

    What is not given is found, and `task.found` says what was found.

    Args:
        env: the id of the environment in Gymnasium, or a function that makes one.
        chart: names of the coordinates in which the decision falls; see `coordinates`.
        noisy: (d,) share of the noise bound on each coordinate of the chart; by default 1 on positions.
        success: when an episode is a success, as "terminated and reward >= 1", 'info["solved"]' or
            "distance(a, b) <= 0.05" of two sites, bodies or geoms: see `Expression`. By default what info
            says.
        failure: when an episode is a failure, by default when it is terminated without success.
        bounds: (low, high) of coordinates of the chart, by name.
        steps: steps of an episode, by default those of the environment.
        starts: where episodes start, all over the "chart", or where "reset" leads to.
        kwargs: arguments of `gymnasium.make`, or of the function.
        reset: options of `reset`.
        pinned: values of positions, velocities or attributes after each reset, by name.
        seed: the seed of the reset that all copies begin from, 0 by default; if it is given, what that reset
            draws is pinned.

    Raises:
        BadInput: it cannot be used; the message says why.
    """
    # All arguments that are given; there are no other variables yet.
    given: dict[str, Any] = {
        name: dict(value) if isinstance(value, Mapping) else value
        for name, value in locals().items()
        if value is not None
    }
    with described(_shown(env)):
        description = Description(**given)
        told = dict(given)
        if not isinstance(env, str):
            name = getattr(env, "__qualname__", type(env).__qualname__)
            told["env"] = {"function": f"{getattr(env, '__module__', '')}.{name}"}
        if starts == "chart":
            del told["starts"]
        spec = ENVIRONMENT + json.dumps(told, default=_plain)
        if len(spec) > LARGEST:
            raise BadInput(
                f"the arguments of {_shown(env)} take more than {LARGEST:,} characters: give what they hold "
                "to a function that makes it"
            )
        # Their user may change them later.
        owned = {name: copy.deepcopy(value) for name, value in given.items() if name != "env"}
        description = replace(description, **owned)
    task = _MADE.get(spec)
    with described(_shown(env)), kept_generators():
        same = task is not None and _same(task.made_of, _made_of(description)) and task.is_as_made()
    if task is None or not same or not isinstance(env, str):
        if task is not None and not same and not isinstance(env, str):
            _OLDER.add(task)
            with suppress(ValueError):
                _RECENT.remove(task)
        with described(_shown(env)), kept_generators():
            # With names of files it is recorded otherwise, and tried each time.
            known = not isinstance(env, str) or trust.is_known_text(spec)
            untried = not known and (kwargs or reset or pinned or trust.is_received())
            found = inspect(description, bool(untried))
            task = EnvironmentTask(*found, spec, _made_of(description))
        _MADE[spec] = task
        _RECENT.append(task)
    if isinstance(env, str):
        trust.remember_text(_recorded(spec, told))
        if ":" in env and (module := trust.module_file(env)) is not None:
            trust.remember(module)
    return task


def _shown(env: Any) -> str:
    return f"the environment {env[:80]}" if isinstance(env, str) else "the environment"


def _made_of(description: Description) -> tuple[Any, ...]:
    """Returns what an environment is made of beside its description: what its id stands for, and files."""
    env = description.env
    if not isinstance(env, str):
        # A cell of a notebook that is run again makes another function of the same code.
        names = "__self__", "__defaults__", "__kwdefaults__"
        cells = []
        for cell in getattr(env, "__closure__", None) or ():
            with suppress(ValueError):  # it is empty
                cells.append(cell.cell_contents)
        parts = (getattr(env, name, None) for name in names)
        return (getattr(env, "__code__", env), *parts, *cells)
    digests = []
    for value in description.kwargs.values():
        with suppress(OSError, ValueError):
            if isinstance(value, str) and Path(value).is_file():
                digests.append(artifacts.digest(Path(value)))
    entry = gym.registry.get(env.rpartition(":")[2])
    maker: Any = None if entry is None else entry.entry_point
    if isinstance(maker, str):  # a module that is imported again has another class of that name
        with suppress(Exception):
            maker = gym.envs.registration.load_env_creator(maker)
    return (entry, maker, *digests)


def _same(made_of: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Returns whether two environments of one description are made of the same."""
    try:
        return len(made_of) == len(other) and all(
            a is b or bool(np.array_equal(a, b)) for a, b in zip(made_of, other, strict=True)
        )
    except Exception:  # whatever objects of the user's do when they are compared
        return False


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": value.tolist()}
    if isinstance(value, np.number):
        return value.item()
    raise BadInput(f"{value!r} cannot be written down: give numbers, texts, lists and dictionaries")


def from_spec(spec: str) -> Task:
    """Returns the task that a text describes, as `EnvironmentTask.spec` holds it.

    Raises:
        BadInput: it was made with a function, which no text holds, or the text is damaged.
    """
    if (task := _MADE.get(spec)) is not None:
        if any(older.spec == spec for older in _OLDER):
            gc.collect()  # who lets go of a task has not let go of its parts at once
        if any(older.spec == spec for older in _OLDER):
            raise BadInput(
                f"two functions are called {task.name}, and tasks of both are in use: give them different "
                "names"
            )
        description = task.specification.description
        if not isinstance(description.env, str) or _same(task.made_of, _made_of(description)):
            return task
    try:
        given = json.loads(spec.removeprefix(ENVIRONMENT), object_hook=with_arrays)
        if not isinstance(given, dict):
            raise ValueError
        env = given["env"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise BadInput(f"{spec[:80]!r} describes no environment: start a new run") from None
    if not isinstance(env, str):
        function = env.get("function") if isinstance(env, dict) else env
        raise BadInput(
            f"the environment was made by the function {str(function)[:80]}, which no file holds: call "
            "hyrl_mj.from_gymnasium with it first, in the same process"
        )
    with described(_shown(env)):
        if trust.is_received():
            _check_received(env, given, spec)
        return from_gymnasium(**given)


def _check_received(env: str, given: Mapping[str, Any], spec: str) -> None:
    """Raises `BadInput` if a file describes an environment that could run code or open files of its sender.

    What this machine has described by the same text before is allowed, if it is of the same module and given
    in the same folder. Else it is an environment of an installed package, and what is given to its maker and
    its reset are numbers and plain words.
    """
    if ":" in env:
        module = trust.module_file(env)
        known = module is not None and trust.is_known(module)
    else:
        register(env)
        known = env in gym.registry
    recorded = _recorded(spec, given)
    if not known or not (recorded == spec or trust.is_known_text(recorded)):
        args = {name: value for name, value in given.items() if name != "env"}
        how = f"--env {shlex.quote(env)}"
        if args:
            text = json.dumps(args, default=_plain)
            held = text if len(text) <= 120 else "its arguments, which stand in config.json"
            how += f" --env-args FILE, where FILE holds {held}"
        raise BadInput(
            f"the environment is {env}, and opening a run imports no module that you have not used before, "
            "as it is now, and opens no file that it names: if you trust it, use it once, as with "
            f"hyrl-mj diagnose --explain {how}"
        )


def _recorded(spec: str, given: Mapping[str, Any]) -> str:
    """Returns the text that a description is recorded by: names of files stand for files of a folder."""
    plain = _is_plain([given.get("kwargs"), given.get("reset")])
    return spec if plain else f"{spec} in {os.getcwd()}"


def _is_plain(value: Any) -> bool:
    """Returns whether an argument holds numbers and plain words only, none of which is the name of a file."""
    if isinstance(value, str):
        return re.fullmatch(r"[A-Za-z0-9_ -]{0,40}", value) is not None and not Path(value).exists()
    if isinstance(value, Mapping):
        return all(_is_plain(part) for pair in value.items() for part in pair)
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    return value is None or isinstance(value, int | float | np.number)


# ---- the command line


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
    for name, value in json.loads(task.spec.removeprefix(ENVIRONMENT)).items():
        lines.append(f"  {name}: {value if isinstance(value, str) else json.dumps(value)} (given)")
    for name, text in task.found.items():
        lines += [f"  {name}: {text}", f"    (to change it, give {_INSTEAD.get(name, name)})"]
    return "\n".join(map(printable, lines))


# What to give to change what was found, where it has another name.
_INSTEAD = {
    "noise": "noisy",
    "kept": "reset, pinned or seed",
    "goal": "reset, pinned or seed",
    "ways": "chart",
    "episodes": "an environment whose reset() sets that back",
    "lag": "an environment that calls mj_forward at the end of step()",
    "sample time": "kwargs, such as frame_skip, if the environment takes it",
    "camera": "task.scene another one in Python",
}


def _arguments(path: Path) -> dict[str, Any]:
    text = artifacts.read_given(path, "give a JSON file", LARGEST)
    try:
        artifacts.check_parts(whole := text.decode())
        content = json.loads(whole, object_hook=with_arrays)
    except BadInput as error:
        raise BadInput(f"{path} cannot be used: {error}") from None
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path} is no JSON ({brief(error)}): give a JSON file") from None
    if not isinstance(content, dict):
        raise BadInput(
            f"{path} holds no JSON object: give one with arguments of hyrl_mj.from_gymnasium"
        )
    allowed = [name for name in signature(from_gymnasium).parameters if name != "env"]
    for name in content:
        if name not in allowed:
            raise unknown(f"argument in {path}", name, allowed)
    return content


def _chart(words: tuple[str, ...]) -> AnyChart:
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
