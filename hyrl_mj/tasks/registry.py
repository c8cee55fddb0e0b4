"""The registry of tasks: those of this package, of other installed packages, and of the user's files."""

import importlib
import importlib.util
import shlex
import sys
from collections.abc import Callable
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from hyrl_mj.errors import BadInput, brief, line_in, unknown
from hyrl_mj.files import trust
from hyrl_mj.files.sources import (
    FromSource,
    check_helpers,
    compile_each_time,
    digest_of,
    forget_helpers,
)
from hyrl_mj.tasks.base import Task

_REGISTRY: dict[str, type[Task]] = {}
# The task that each file defines, as the file is at that time.
_FILES: dict[tuple[Path, str], type[Task]] = {}
# The text of an environment begins with this.
ENVIRONMENT = "env:"
# Names of the tasks that other installed packages offer, as far as they have been loaded.
_INSTALLED: set[str] = set()


def register(task: type[Task]) -> type[Task]:
    """Registers a task by its name, and in Gymnasium by its `env_id`; use it as a class decorator.

    Raises:
        BadInput: another file has a task of that name.
    """
    here, other = _file(task), _REGISTRY.get(task.name)
    if other is not None and _file(other) != here:
        raise BadInput(
            f"{here} defines a task {task.name}, and so does {_file(other)}: rename one of them"
        )
    if here is not None and Path(__file__).resolve().parents[1] not in here.parents:
        task.source, task._digest = here, digest_of(here) if here.is_file() else ""
    if "env_id" not in vars(task):
        task.env_id = f"hyrl_mj/{task.__name__}-v0"
    registered = gym.registry.pop(task.env_id, None)  # of this very class if it was decorated, too
    if registered is not None and registered.kwargs.get("task") != task.name:
        gym.registry[task.env_id] = registered
        raise BadInput(
            f"{here} defines an environment {task.env_id}, and there is another: rename the class, or give "
            "it an env_id"
        )
    try:
        gym.register(
            id=task.env_id,
            entry_point="hyrl_mj.gym_export.gym_env:TaskEnv",
            vector_entry_point="hyrl_mj.gym_export.gym_env:TaskVectorEnv",
            kwargs={"task": task.name},
            max_episode_steps=getattr(task, "max_steps", None),  # `check_task` says what is missing
        )
    except gym.error.Error as error:
        raise BadInput(f"{here} has the env_id {task.env_id!r:.60} ({brief(error)})") from error
    _REGISTRY[task.name] = task
    return task


def task_names() -> list[str]:
    """Returns the names of all tasks of this package and of other installed ones."""
    return sorted(_REGISTRY.keys() | _offered().keys())


def get_task(name: str | Path | Task) -> Task:
    """Returns a task, by its name or by the Python file that defines it; a task itself as it is.

    The file is executed, as Python executes what it imports. It defines one subclass of `Task`, and its
    MJCF lies beside it: `<name>.xml`.

    Raises:
        BadInput: there is no such task, or its file cannot be used; the message says why.
    """
    if isinstance(name, Task):
        return name
    if str(name).startswith(ENVIRONMENT):
        maker = importlib.import_module("hyrl_mj.gym_import.making")  # it lies above
        made: Task = maker.from_spec(str(name))
        return made
    if str(name).endswith(".py"):
        path = Path(name).resolve()
        if not path.is_file():
            remedy = f"hyrl-mj new-task {shlex.quote(path.stem)} writes one to start from"
            if trust.is_received():
                remedy = (
                    "if it lies elsewhere, name it with --task FILE, in Python with "
                    "load_run(path, task=FILE)"
                )
            raise BadInput(f"there is no task file {path}: {remedy}")
        # A file that nobody has run is not even read: it may have no end.
        has_run = any(known == path for known, _ in _FILES) and (path, digest_of(path)) in _FILES
        if trust.is_received() and not has_run and not trust.is_known(path):
            raise BadInput(
                f"the task is defined in {path}, and opening a run executes no file that you have not run "
                "before, as it is now: if you trust the file, name it with --task FILE, in Python with "
                "load_run(path, task=FILE)"
            )
        task = _instance(_from_file(path), str(name))
        trust.remember(path)
        return task
    name = str(name)
    if name not in _REGISTRY and name in (offered := _offered()):
        _from_entry_point(offered[name])
    if name not in _REGISTRY:
        raise unknown("task", name, [*task_names(), "or a file my_robot.py"])
    return _instance(_REGISTRY[name], name)


def is_of_this_package(task: Task) -> bool:
    """Returns whether a task is one of this package, whose episodes its tests have played."""
    return type(task).__module__.startswith("hyrl_mj.tasks.")


def reference(task: Task) -> str:
    """Returns what `get_task` finds a task by in another process: its name, its file, or its text."""
    if task.spec:
        return task.spec
    named = task.source is None or task.name in _INSTALLED
    return task.name if named else str(task.source)


def described_task(name: str) -> Task:
    """Returns the task that a file of a run names, by `reference`; code of unknown origin does not run.

    A task's file is executed only if the user has named it, in this process or before on this machine, and
    so are modules and arguments of environments.

    Raises:
        BadInput: there is no such task, or it is in a file that the user has not named.
    """
    with trust.received():
        return get_task(name)


def _offered() -> dict[str, EntryPoint]:
    """Returns the tasks that installed packages offer, as hyrl_mj.tasks: name = "its.module:Class"."""
    with trust.only_installed():
        return {entry.name: entry for entry in entry_points(group="hyrl_mj.tasks")}


def _instance(kind: type[Task], what: str) -> Task:
    try:
        return kind()
    except TypeError as error:  # methods that a task must have are missing
        raise BadInput(f"the task of {what} is not finished: {error}") from error


def _file(task: type[Task]) -> Path | None:
    """Returns the file that defines a task; None in an interactive session."""
    file = getattr(sys.modules.get(task.__module__), "__file__", None)
    return None if file is None else Path(file).resolve()


def _from_entry_point(entry: EntryPoint) -> None:
    try:
        task = entry.load()
    except (Exception, SystemExit) as error:  # whatever a foreign module raises
        if isinstance(error, BadInput):
            raise
        raise BadInput(
            f"the task {entry.name} of {entry.value} cannot be imported ({brief(error)}): repair or "
            "uninstall the package that offers it"
        ) from error
    if not (isinstance(task, type) and issubclass(task, Task)) or task.name != entry.name:
        raise BadInput(
            f"the entry point {entry.name} = {entry.value} offers no task of that name: give a subclass "
            f"of hyrl_mj.Task with name = {entry.name!r}, as its.module:Class"
        )
    register(task)
    _INSTALLED.add(task.name)


def _from_file(path: Path) -> type[Task]:
    key = path, digest_of(path)
    if key not in _FILES:
        module = _run(path)
        tasks = [
            value
            for value in vars(module).values()
            if isinstance(value, type)
            and issubclass(value, Task)
            and value.__module__ == module.__name__
            and hasattr(value, "name")
        ]
        if len(tasks) != 1:
            names = ", ".join(task.__name__ for task in tasks) or "none"
            raise BadInput(
                f"{path} must define one task, a subclass of hyrl_mj.Task with a name: it has {names}"
            )
        _FILES[key] = register(tasks[0])
        # Another process finds the class by its file, not by the name of the module here.
        _FILES[key].__reduce__ = _by_reference  # type: ignore[assignment]
    elif _REGISTRY.get(_FILES[key].name) is not _FILES[key]:
        register(_FILES[key])  # the file is again as it was before
    return _FILES[key]


def check_as_made(task: Task) -> None:
    """Raises `BadInput` unless a task is as `get_task` makes it, by which a run directory finds it.

    That holds no objects: attributes that were given to an object, or changed after it was made, would be
    lost. What cannot be compared is not, and what is computed from others only where both have computed it.
    """
    kind, registered = type(task), _REGISTRY.get(task.name)
    if task.spec:
        made = get_task(task.spec)
    else:
        code = kind.__qualname__, kind._digest
        if registered is None:
            raise BadInput(
                f"the task {task.name} is not registered: put @hyrl_mj.register before its class, or write "
                "it into a file and give that"
            )
        changed = task.source is not None and kind._digest != digest_of(task.source)
        if changed or (registered.__qualname__, registered._digest) != code:
            raise BadInput(
                f"the task {task.name} is of code that has been defined anew since it was made: make it "
                f"again, as by get_task({reference(task)[:80]!r})"
            )
        made = _instance(kind, task.name)
    if differing := _differing(task, made):
        name = differing[0]
        own, usual = (getattr(one, name, None) for one in (task, made))
        raise BadInput(
            f"the task {task.name} has {name} = {own!r:.60}, and runs find it by {reference(task)[:80]}, "
            f"where {name} is {usual!r:.60}: change it in its class, or give it a class and a name of its own"
        )


def _differing(task: Task, made: Task) -> list[str]:
    """Returns the names of attributes in which a task differs from another one, public ones first."""
    names = vars(task).keys() | vars(made).keys()
    found = []
    for name in sorted(names, key=lambda name: (name.startswith("_"), name)):
        if isinstance(getattr(type(task), name, None), cached_property) and not (
            name in vars(task) and name in vars(made)
        ):
            continue
        own, usual = getattr(task, name, None), getattr(made, name, None)
        filled = usual is None and name.startswith("_")  # as a cache is
        if not filled and not alike(own, usual):
            found.append(name)
    return found


def alike(a: Any, b: Any) -> bool:
    """Returns whether two attributes are the same, as far as can be told."""
    if a is b:
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(alike(value, b[key]) for key, value in a.items())
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(alike, a, b))
    if isinstance(a, np.random.Generator):
        return repr(a.bit_generator.state) == repr(b.bit_generator.state)
    if isinstance(a, np.ndarray | np.generic | float):
        return np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind in "fc")
    if type(a).__eq__ is object.__eq__:  # nothing tells
        return True
    try:
        return bool(a == b)
    except Exception:  # whatever a user's class does
        return True


def _by_reference(task: Task) -> tuple[Callable[[str], Task], tuple[str], dict[str, object]]:
    """Returns how another process makes a task: by its file, with the attributes in which it differs."""
    try:
        names = _differing(task, type(task)())
    except Exception:  # it takes arguments
        names = [
            n for n in vars(task) if not isinstance(getattr(type(task), n, None), cached_property)
        ]
    return (
        get_task,
        (reference(task),),
        {name: vars(task)[name] for name in names if name in vars(task)},
    )


def made_again(task: Task) -> Task | None:
    """Returns the task of a file that is executed once more; None of a task that no file makes twice.

    What it imports from its folder is executed, too, unless that can be done once only.
    """
    kind = type(task)
    # A script may do anything where it is executed, such as to begin this run once more.
    if kind.source is None or kind.__module__ == "__main__" or not kind.source.is_file():
        return None
    known, name = dict(_REGISTRY), f"{kind.__module__}_again"
    for helpers in (forget_helpers(kind.source), {}):
        try:
            again: type[Task] = getattr(_executed(kind.source, name), kind.__name__)
            again.source = kind.source
            return again()
        except Exception:  # such as of what can be registered once
            continue
        finally:
            sys.modules.pop(name, None)
            sys.modules.update(helpers)
            _REGISTRY.clear()
            _REGISTRY.update(known)
    return None


def _run(path: Path) -> ModuleType:
    """Imports a file as a module of its own, which can import from its folder as a script can."""
    check_helpers(path)
    if any(known == path for known, _ in _FILES):  # something has changed
        forget_helpers(path)
    return _executed(path, f"hyrl_mj_task_{path.stem}_{len(_FILES)}")


def _executed(path: Path, name: str) -> ModuleType:
    """Returns a file as a module of that name."""
    compile_each_time(path)
    loader = FromSource(name, str(path))
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever the user's file raises
        del sys.modules[name]
        if isinstance(error, BadInput):
            raise
        raise BadInput(
            f"{path} cannot be imported: {brief(error)}{line_in(error, path)}"
        ) from error
    finally:
        sys.path.remove(str(path.parent))
    return module
