"""Environments are made, from ids or functions, and what cannot work is refused."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import io
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext, redirect_stderr, suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from numbers import Real
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj.errors import BadInput, brief, check_seed
from hyrl_mj.files.trust import current_folder, only_installed
from hyrl_mj.gym_import.observations import parts_of
from hyrl_mj.physics import mjcf, mujoco_log
from hyrl_mj.ranges import Integer, OneOf, Optional, refused

# Packages that offer environments, with the extra that brings each.
PACKAGES = {"gymnasium_robotics": "robotics", "ogbench": "robotics", "shimmy": "dm-control"}
# Wrappers that count or check, and change nothing of what an environment does; the first write to `info`.
COUNTING = ("RecordEpisodeStatistics", "Monitor")
PEELED = (*COUNTING, "TimeLimit", "OrderEnforcing", "PassiveEnvChecker", "Autoreset")
# Conditions, as messages name them.
FORMS = '"terminated and reward >= 1", \'info["solved"]\' or "distance(fingertip, target) <= 0.05"'
# Chart, as users give it: one name, several, or new names with the names of what they stand for.
AnyChart = str | Sequence[str] | Mapping[str, str]


@dataclass(frozen=True)
class Description:
    """What the user says of an environment: the arguments of `from_gymnasium`, which tells what each is.

    Raises:
        BadInput: one of them is of another kind.
    """

    env: str | Callable[..., gym.Env]
    chart: AnyChart | None = None
    noisy: Sequence[float] | None = None
    success: str | None = None
    failure: str | None = None
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    steps: int | None = None
    starts: str = "chart"
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    reset: Mapping[str, Any] = field(default_factory=dict)
    pinned: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None

    def __post_init__(self) -> None:
        chart, noisy, name = self.chart, self.noisy, type(self.env).__name__
        if isinstance(self.env, gym.Env):
            raise BadInput(
                f"this {name} is one environment, and episodes are played by several: give a function that "
                "makes it, as lambda: gymnasium.make(...)"
            )
        names = chart.values() if isinstance(chart, Mapping) else chart
        if chart is not None and not isinstance(chart, str) and not _all(names, str):
            raise refused(
                "chart", chart, "a name, a list of names, or new names with those they stand for"
            )
        if noisy is not None:
            if not _all(noisy, Real) or not np.isfinite([*noisy]).all() or min([*noisy, 0]) < 0:
                raise refused(
                    "noisy", noisy, "a list of numbers from 0 on, one for each coordinate"
                )
            if not any(noisy):
                raise refused("noisy", noisy, "a share above 0 for at least one coordinate")
        for name in ("success", "failure"):
            if not isinstance(condition := getattr(self, name), str | None):
                raise refused(name, condition, FORMS)
        for name in ("bounds", "kwargs", "reset", "pinned"):
            named = getattr(self, name)
            if not (isinstance(named, Mapping) and _all([*named], str)):
                raise refused(name, named, "a dictionary of names and values")
        if self.kwargs.get("render_mode") == "human":
            raise refused(
                "render_mode",
                "human",
                "rgb_array, or none: hundreds of copies would open a window each",
            )
        for name, ends in self.bounds.items():
            if not _all(ends, Real) or len(ends) != 2 or not 0 < ends[1] - ends[0] <= 1e6:
                raise refused(f"bounds of {name}", ends, "its low and its high end, as [-2, 2]")
        for name, value in self.pinned.items():
            if not isinstance(value, Real) or not np.isfinite(float(value)):
                raise refused(f"pinned {name}", value, "a finite number")
        Optional(Integer(1, 1_000_000)).checked("steps", self.steps)
        check_seed(0 if self.seed is None else self.seed)
        OneOf(("chart", "reset")).checked("starts", self.starts)

    @property
    def name(self) -> str:
        """The name of the environment, which is also that of its task."""
        if isinstance(self.env, str):
            return self.env.rpartition(":")[2].rpartition("/")[2]
        return getattr(self.env, "__name__", type(self.env).__name__).strip("<>") or "environment"


def _all(values: Any, kind: type) -> bool:
    """Returns whether a value is a list, or another collection, of one kind."""
    several = isinstance(values, Collection) and not isinstance(values, str | Mapping)
    return several and all(isinstance(value, kind) for value in values)


def with_arrays(content: dict[str, Any]) -> Any:
    """Returns the array that an object of JSON stands for, else the object."""
    return _array(content["array"]) if content.keys() == {"array"} else content


def _array(value: Any) -> np.ndarray:
    """Returns an array of numbers; raises ValueError for others.

    In an array of texts each takes the room of the longest, so that a small file fills the memory.
    """
    if not all(isinstance(one, Real | np.bool_) for one in np.array(value, dtype=object).flat):
        raise ValueError("an array holds numbers alone")
    return np.array(value)


def made(description: Description) -> gym.Env:
    """Returns an environment that can be used, with all of its wrappers.

    Raises:
        BadInput: it cannot be made, or it is none that can be used.
    """
    mujoco_log.install()  # what MuJoCo warns of while it reads a model is not written to a file
    make, name = description.env, description.name
    kwargs = copy.deepcopy(dict(description.kwargs))  # which the environment may change
    try:
        if isinstance(make, str):
            register(make)
            own = ":" in make  # of a module of the user's, as "my_module:Puck-v0"
            with mjcf.compiled_once(), current_folder(make) if own else nullcontext():
                env: Any = gym.make(make, disable_env_checker=True, **kwargs)
        else:
            with mjcf.compiled_once():
                env = make(**kwargs)
    except (Exception, SystemExit) as error:  # whatever a foreign constructor raises
        if isinstance(make, str):
            raise BadInput(_why_not_made(make, error)) from error
        raise BadInput(f"{name} cannot be made ({brief(error)}): repair the function") from error
    mjcf.check_names(_checked(env, name), name)
    return env


def preload(description: Description) -> None:
    """Imports what makes an environment, without making it; what fails is told when it is made."""
    make = description.env
    if not isinstance(make, str):
        return
    own = ":" in make
    with suppress(Exception, SystemExit), current_folder(make) if own else nullcontext():
        register(make)
        if own:
            importlib.import_module(make.partition(":")[0])
        entry = gym.spec(make.rpartition(":")[2]).entry_point
        if isinstance(entry, str):
            gym.envs.registration.load_env_creator(entry)


def steps_of(env: gym.Env) -> int | None:
    """Returns after how many steps an episode of an environment is truncated; None if it does not say."""
    limits = [
        int(layer._max_episode_steps)
        for layer in layers(env)
        if isinstance(layer, gym.wrappers.TimeLimit)
    ]
    if limits:
        return min(limits)
    # Some keep an MjSpec by that name.
    if most := getattr(env.unwrapped.spec, "max_episode_steps", None):
        return int(most)
    limit = getattr(getattr(env.unwrapped, "_env", None), "_step_limit", np.inf)  # of dm_control
    return int(limit) if np.isfinite(limit) else None


def register(name: str) -> None:
    """Imports the packages that offer environments, as far as they are installed."""
    if name in gym.registry:
        return
    for module in PACKAGES:
        try:
            # What a package prints is about environments that nobody has asked for.
            with redirect_stderr(io.StringIO()), only_installed():
                package = importlib.import_module(module)
        except ImportError:
            continue
        if module == "shimmy":
            _adapt_dm_control()
        gym.register_envs(package)
        if name in gym.registry:
            return


def _adapt_dm_control() -> None:
    """Takes the fields out of dm_control's table of MuJoCo's arrays that this version of MuJoCo lacks.

    dm_control 1.0.50 reads them all when it loads a model, and MuJoCo 4 has renamed some.
    """
    try:
        from dm_control.mujoco.wrapper.mjbindings import sizes
    except ImportError:
        return
    for name, kind in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
        table = sizes.array_sizes[name]
        for field_name in [key for key in table if not hasattr(kind, key)]:
            del table[field_name]


def _why_not_made(name: str, error: BaseException) -> str:
    if name not in gym.registry and isinstance(error, gym.error.Error):
        missing = {e: m for m, e in PACKAGES.items() if importlib.util.find_spec(m) is None}
        close = get_close_matches(name[:80], list(gym.registry), n=3, cutoff=0.5)
        near = f"; near it are {', '.join(close)}" if close else ""
        install = "".join(
            f'; if it is of {module}: pip install "hyrl-mj[{extra}]"'
            for extra, module in missing.items()
        )
        return (
            f"there is no environment {name!r}: give the id of one that is installed{near}{install}; if "
            f"another package has it, name the module that registers it, as module:{name.rpartition(':')[2]}"
        )
    if isinstance(error, ImportError):
        module = name.partition(":")[0] if ":" in name else ""
        own = f", or give the command in the folder of {module}.py" if module else ""
        return f"the environment {name} takes a package that is missing ({brief(error)}): install it{own}"
    origin = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"the environment {name} cannot be made ({brief(error)}, in {Path(origin.filename).name}, line "
        f"{origin.lineno}): give it other kwargs, or see whether its package fits MuJoCo {mujoco.__version__}"
    )


def _checked(env: Any, name: str) -> mujoco.MjModel:
    """Returns the model of an environment of one agent in MuJoCo, with vectors; refuses others."""
    if {"possible_agents", "agents"} & {*dir(env)}:  # not what a `__getattr__` may say
        raise BadInput(f"{name} has several agents: hyrl_mj takes environments of one agent")
    if isinstance(env, gym.vector.VectorEnv) or not isinstance(env, gym.Env):
        raise BadInput(
            f"{name} is a {type(env).__name__}: give a single gymnasium.Env, or a function that makes one"
        )
    physics = None
    with suppress(Exception):  # whatever it raises before its first reset
        physics = physics_of(env)
    if physics is None:
        raise BadInput(
            f"{name} is not simulated by MuJoCo, as far as its attributes model and data tell: give an "
            "environment of MuJoCo, which has its MjModel and its MjData under these names when it is made"
        )
    for part in parts_of(env.observation_space).values():
        rows = 2 if part.dtype == np.uint8 else 3
        is_image = isinstance(part, spaces.Box) and len(part.shape) >= rows
        if is_image or not isinstance(part, spaces.Box):
            what = "images" if is_image else f"a space {type(part).__name__}"
            raise BadInput(
                f"{name} observes {what} {getattr(part, 'shape', '')}: hyrl_mj takes vectors, or a Dict of "
                "vectors; choose the observation of its state"
            )
        if part.dtype not in (np.float32, np.float64):
            raise BadInput(
                f"{name} observes numbers in a space of {part.dtype}, as which SB3 may show agents others: "
                "give it a space of float32 or float64"
            )
    actions = actions_of(env)
    if not isinstance(actions, spaces.Box | spaces.Discrete):
        raise BadInput(f"{name} takes actions of {actions}: hyrl_mj takes a Box, or Discrete")
    if isinstance(actions, spaces.Box) and actions.dtype.kind != "f":
        raise BadInput(
            f"{name} takes a Box of {actions.dtype} as its actions, to which an agent's numbers would be "
            "rounded: let it take a Box of floats, or Discrete"
        )
    if isinstance(actions, spaces.Discrete) and actions.start != 0:
        raise BadInput(
            f"{name} counts its actions from {actions.start}, and levels are counted from 0, by SB3, too, so "
            f"that an agent's numbers would stand for others: let it take Discrete({actions.n})"
        )
    if isinstance(actions, spaces.Box) and not np.isfinite([actions.low, actions.high]).all():
        raise BadInput(f"{name} takes actions without limits: give its action_space limits")
    return physics[0]


def actions_of(env: gym.Env) -> Any:
    """Returns the space of the actions that an environment takes: that to which a ClipAction clips them."""
    usual: Any = gym.Wrapper
    for layer in layers(env):
        passes = isinstance(layer, gym.Wrapper) and layer._action_space is None
        if passes:  # unless it has a property of its own
            passes = getattr(type(layer), "action_space", None) is usual.action_space
        if not (passes or isinstance(layer, gym.wrappers.ClipAction)):
            return layer.action_space
    return env.action_space


def checked_step(result: Any, name: str) -> tuple[Any, float, Any, Any, dict[str, Any]]:
    """Returns what the step of an environment of a name returns; refuses what no step returns."""
    if not isinstance(result, tuple) or len(result) != 5:
        raise BadInput(
            f"step() of {name} returns a {type(result).__name__}: let it return an observation, a reward, "
            "terminated, truncated and info"
        )
    observation, reward, terminated, truncated, info = result
    number = np.asarray(reward)
    if number.size != 1 or number.dtype.kind not in "biuf" or not isinstance(info, dict):
        raise BadInput(
            f"step() of {name} returns {reward!r:.60} as its reward and a {type(info).__name__} as its info: "
            "let it return a number and a dictionary"
        )
    return observation, float(number.item()), terminated, truncated, info


def layers(env: gym.Env) -> list[Any]:
    """Returns the wrappers of an environment, the outermost first, and the environment within."""
    found: list[Any] = [env]
    while isinstance(found[-1], gym.Wrapper):
        found.append(found[-1].env)
    return found


def physics_of(env: gym.Env) -> tuple[mujoco.MjModel, mujoco.MjData] | None:
    """Returns model and data of an environment, of Gymnasium or of dm_control; None if it has none."""
    inner: Any = env.unwrapped
    of_control = getattr(getattr(inner, "_env", None), "physics", None)
    for model, data in (
        [getattr(inner, key, None) for key in ("model", "data")],
        [getattr(getattr(of_control, key, None), "ptr", None) for key in ("model", "data")],
    ):
        if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
            return model, data
    return None


def peeled(env: gym.Env) -> gym.Env:
    """Returns an environment without the wrappers of libraries that count or check."""
    if not isinstance(env, gym.Wrapper):
        return env
    kind, inner = type(env), peeled(env.env)
    # A wrapper of the user's may have such a name.
    library = kind.__module__.partition(".")[0] in ("gymnasium", "stable_baselines3")
    if library and kind.__name__ in PEELED:
        return inner
    env.env = inner
    return env
