"""What an environment remembers, written down so that two moments, or two instances, can be compared.

Everything that attributes of the environment and of its wrappers lead to is looked at, closures included,
and what all instances share: variables of the modules and classes that define it. Values are only compared,
never set.
"""

from __future__ import annotations

import marshal
import pickle
import sys
from collections import deque
from collections.abc import Mapping, Set
from contextlib import suppress
from functools import cache
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from hyrl_mj.environments.opening import layers

# Objects of these modules hold no memory of an environment, or it is in MuJoCo's state.
PASSED = (
    "mujoco", "dm_control.mujoco", "dm_control.mjcf", "dm_control.rl.specs", "dm_env", "OpenGL",
    "gymnasium.spaces", "gymnasium.envs.registration", "gymnasium.envs.mujoco.mujoco_rendering",
    "lxml", "xml", "logging", "re", "_thread", "threading", "weakref", "hyrl_mj",
)  # fmt: skip
# Packages whose modules and classes hold no memory of an episode.
LIBRARIES = {
    "gymnasium", "dm_control", "shimmy", "numpy", "mujoco", "hyrl_mj", *sys.stdlib_module_names,
}  # fmt: skip
# Attributes that hold the arguments of a constructor, and methods that are put in by `Instance`.
LEFT_OUT = frozenset(("_ezpickle_args", "_ezpickle_kwargs", "_saved_kwargs", "step", "reset"))
# How deep attributes of attributes are looked at, and how many values at most. What lies beyond cannot be
# compared, and counts as different.
DEEPEST, MOST = 10, 100_000
# What may be changed in MuJoCo's model so that runs go on differently.
MODEL = (
    "qpos0", "qpos_spring", "body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "geom_pos",
    "geom_quat", "geom_size", "geom_friction", "geom_contype", "geom_conaffinity", "geom_solref",
    "geom_solimp", "geom_margin", "site_pos", "site_quat", "jnt_range", "jnt_axis", "jnt_stiffness",
    "dof_damping", "dof_armature", "dof_frictionloss", "actuator_gear", "actuator_gainprm",
    "actuator_biasprm", "actuator_dynprm", "actuator_ctrlrange", "actuator_forcerange", "tendon_range",
    "eq_data", "hfield_data",
)  # fmt: skip
PLAIN = (type(None), bool, int, float, complex, str, bytes)
# The kinds of variables of a class or a module whose values can change.
DATA = (*PLAIN, list, dict, set, deque, tuple, np.ndarray, np.generic, np.random.Generator)
FUNCTIONS = FunctionType | MethodType


class Fingerprint(dict[str, Any]):
    """What is remembered, by the names of its places.

    Attributes:
        generators: the generators of random numbers among it, by name.
    """

    def __init__(self) -> None:
        super().__init__()
        self.generators: dict[str, Any] = {}


class Unknown:
    """A value that cannot be written down: it equals no other, and not even itself at another moment."""


def fingerprint(env: gym.Env) -> Fingerprint:
    """Returns what an environment remembers outside of MuJoCo's data, by the names of its places."""
    seen: set[int] = set()
    found = shared(env, seen)
    for layer in layers(env):
        _walk(layer, "" if layer is env.unwrapped else type(layer).__name__, found, seen, 0)
    return found


def shared(env: gym.Env, seen: set[int] | None = None) -> Fingerprint:
    """Returns what all instances of an environment share: variables of its classes and their modules.

    The ids of objects that are written down are added to `seen`.
    """
    found, seen = Fingerprint(), set() if seen is None else seen
    for kind in {kind for layer in layers(env) for kind in type(layer).__mro__}:
        module = kind.__module__ or ""
        if module.partition(".")[0] in LIBRARIES:
            continue
        owners = {f"class {kind.__name__}": kind, f"module {module}": sys.modules.get(module)}
        for where, owner in owners.items():
            if owner is not None and id(owner) not in seen:
                seen.add(id(owner))
                for name in _data_of(owner, len(vars(owner))):
                    _walk(vars(owner).get(name), f"{where}.{name}", found, seen, 1)
    return found


def of_model(model: mujoco.MjModel) -> dict[str, bytes]:
    """Returns what may be changed in MuJoCo's model, by name."""
    found = {name: getattr(model, name).tobytes() for name in MODEL}
    options = (model.opt.timestep, *model.opt.gravity, *model.opt.wind, model.opt.disableflags)
    return {**found, "opt": np.array(options, dtype=float).tobytes()}


def differing(a: Fingerprint, b: Fingerprint) -> list[str]:
    """Returns the names of the places at which two fingerprints differ; what is `Unknown` does."""
    if a == b:
        return []
    return [name for name in {**a, **b} if name not in a or name not in b or a[name] != b[name]]


def is_shared(name: str) -> bool:
    """Returns whether all instances share the place of a name."""
    return name.startswith(("module ", "class "))


def state_of(generator: Any) -> bytes:
    """Returns the state of a generator of random numbers, to compare it."""
    bits = getattr(generator, "bit_generator", None)
    return pickle.dumps(generator.get_state() if bits is None else bits.state)


def _walk(value: Any, path: str, found: Fingerprint, seen: set[int], depth: int) -> None:
    """Writes down a value, and what its parts lead to."""
    if isinstance(value, PLAIN):
        found[path] = marshal.dumps(value, 0)  # NaN equals NaN so
    elif isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufcSU":
        found[path] = value.shape, value.dtype.str, value.tobytes()
    elif isinstance(value, np.random.Generator | np.random.RandomState):
        found[path], found.generators[path] = state_of(value), value
    elif _has_no_memory(value) or id(value) in seen:
        return
    elif depth > DEEPEST or len(found) > MOST:
        found[path] = Unknown()
    else:
        seen.add(id(value))
        parts = _parts(value, path, found)
        for name, part in parts.items():
            _walk(part, name, found, seen, depth + 1)


def _parts(value: Any, path: str, found: Fingerprint) -> dict[str, Any]:
    """Returns the parts of a value by the names of their places; what has none is written down."""
    if isinstance(value, list | tuple | dict):
        try:
            found[path] = marshal.dumps(value, 0)
            return {}
        except ValueError:  # something within is not of Python's own types
            pass
    if isinstance(value, Set) and all(isinstance(item, PLAIN) for item in value):
        found[path] = frozenset(value)
        return {}
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        value = value.ravel().tolist()
    if isinstance(value, list | tuple | deque | Set):
        value = dict(enumerate(value))
    if isinstance(value, Mapping):
        found[f"len({path})"] = len(value)
        return {f"{path}[{repr(key)[:40]}]": item for key, item in value.items()}
    if isinstance(value, FUNCTIONS):
        function = getattr(value, "__func__", value)
        return {f"{path}.{name}": part for name, part in _variables_of(function).items()}
    if type(value).__module__.partition(".")[0] == "torch" and hasattr(value, "detach"):
        return {path: value.detach().cpu().numpy()}
    if not hasattr(value, "__dict__"):
        found[path] = _written(value)
        return {}
    slots = {name: getattr(value, name) for name in _slots(value.__class__) if hasattr(value, name)}
    own = {name: part for name, part in vars(value).items() if name not in LEFT_OUT}
    return {f"{path}.{name}" if path else name: part for name, part in {**own, **slots}.items()}


def _variables_of(function: Any) -> dict[str, Any]:
    """Returns the variables of its own that a function remembers from call to call, by name."""
    found = dict(vars(function))
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=False)
    for name, cell in cells:
        with suppress(ValueError):  # the cell is empty
            found[name] = cell.cell_contents
    return found


@cache
def _slots(kind: Any) -> list[str]:
    """Returns the names of attributes that a class keeps outside of `__dict__`."""
    names: list[str] = []
    for base in kind.__mro__:
        slots = vars(base).get("__slots__", ())
        names += [slots] if isinstance(slots, str) else list(slots)
    return [name for name in names if name not in ("__dict__", "__weakref__")]


def _written(value: Any) -> Any:
    """Returns a value of some other type as bytes, as far as it can be written down."""
    try:
        return pickle.dumps(value)
    except Exception:  # whatever a foreign class raises
        return Unknown()


def _has_no_memory(value: Any) -> bool:
    if isinstance(value, FUNCTIONS):
        function = getattr(value, "__func__", value)
        return not (function.__closure__ or vars(function))
    if isinstance(value, type | ModuleType | BuiltinFunctionType | property):
        return True
    return _is_passed(type(value).__module__ or "")


@cache
def _is_passed(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in PASSED)


@cache
def _data_of(owner: Any, size: int) -> list[str]:
    """Returns the names of the variables of a class or module, of so many names, that can change."""
    return [n for n, v in vars(owner).items() if not n.startswith("__") and isinstance(v, DATA)]
