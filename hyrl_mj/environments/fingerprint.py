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

    def __init__(self, kind: str):
        self.kind = kind


def fingerprint(env: gym.Env) -> Fingerprint:
    """Returns what an environment remembers outside of MuJoCo's data, by the names of its places."""
    found = Fingerprint()
    seen: set[int] = set()
    for layer in layers(env):
        _walk(layer, "" if layer is env.unwrapped else f"{type(layer).__name__}", found, seen, 0)
    return _with_shared(env, found, seen)


def shared(env: gym.Env) -> Fingerprint:
    """Returns what all instances of an environment share: variables of its classes and their modules."""
    return _with_shared(env, Fingerprint(), set())


def _with_shared(env: gym.Env, found: Fingerprint, seen: set[int]) -> Fingerprint:
    for kind in {kind for layer in layers(env) for kind in type(layer).__mro__}:
        _shared(kind, found, seen)
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
    if isinstance(value, PLAIN):
        found[path] = marshal.dumps(value, 0)  # NaN equals NaN so
    elif isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufcSU":
        found[path] = value.shape, value.dtype.str, value.tobytes()
    elif isinstance(value, np.random.Generator | np.random.RandomState):
        found[path], found.generators[path] = state_of(value), value
    elif _has_no_memory(value) or id(value) in seen:
        return
    elif depth > DEEPEST or len(found) > MOST:
        found[path] = Unknown(type(value).__name__)
    else:
        seen.add(id(value))
        _walk_parts(value, path, found, seen, depth + 1)


def _walk_parts(value: Any, path: str, found: Fingerprint, seen: set[int], depth: int) -> None:
    if isinstance(value, list | tuple | dict):
        try:
            found[path] = marshal.dumps(value, 0)
            return
        except ValueError:  # something within is not of Python's own types
            pass
    if isinstance(value, Set) and all(isinstance(item, PLAIN) for item in value):
        found[path] = frozenset(value)
    elif isinstance(value, list | tuple | deque | Set) or (
        isinstance(value, np.ndarray) and value.dtype.kind == "O"
    ):
        items = list(value.ravel() if isinstance(value, np.ndarray) else value)
        found[f"len({path})"] = len(items)
        for i, item in enumerate(items):
            _walk(item, f"{path}[{i}]", found, seen, depth)
    elif isinstance(value, Mapping):
        found[f"len({path})"] = len(value)
        for key, item in list(value.items()):
            _walk(item, f"{path}[{str(key)[:40]!r}]", found, seen, depth)
    elif isinstance(value, FunctionType | MethodType):
        function = getattr(value, "__func__", value)
        for name, cell in zip(
            function.__code__.co_freevars, function.__closure__ or (), strict=False
        ):
            try:
                _walk(cell.cell_contents, f"{path}.{name}", found, seen, depth)
            except ValueError:  # the cell is empty
                continue
        _walk(vars(function), f"{path}.__dict__", found, seen, depth)
    elif type(value).__module__.partition(".")[0] == "torch" and hasattr(value, "detach"):
        _walk(value.detach().cpu().numpy(), path, found, seen, depth)
    elif hasattr(value, "__dict__"):
        for name, item in list(vars(value).items()):
            if name not in LEFT_OUT:
                _walk(item, f"{path}.{name}" if path else name, found, seen, depth)
        for name in _slots(value.__class__):
            if hasattr(value, name):
                _walk(getattr(value, name), f"{path}.{name}", found, seen, depth)
    else:
        found[path] = _written(value)


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
        return Unknown(type(value).__name__)


def _has_no_memory(value: Any) -> bool:
    if isinstance(value, FunctionType | MethodType):
        function = getattr(value, "__func__", value)
        return not (function.__closure__ or vars(function))
    if isinstance(value, type | ModuleType | BuiltinFunctionType | property):
        return True
    return _is_passed(type(value).__module__ or "")


@cache
def _is_passed(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in PASSED)


def _shared(kind: type, found: Fingerprint, seen: set[int]) -> None:
    """Writes down the variables that the instances of a class share: its own, and those of its module."""
    module = kind.__module__ or ""
    if module.partition(".")[0] in LIBRARIES:
        return
    for where, owner in (
        (f"class {kind.__name__}", kind),
        (f"module {module}", sys.modules.get(module)),
    ):
        if owner is not None and id(owner) not in seen:
            seen.add(id(owner))
            for name in _data_of(owner, len(vars(owner))):
                _walk(vars(owner).get(name), f"{where}.{name}", found, seen, 1)


@cache
def _data_of(owner: Any, size: int) -> list[str]:
    """Returns the names of the variables of a class or module, of so many names, that can change."""
    return [n for n, v in vars(owner).items() if not n.startswith("__") and _is_data(v)]


def _is_data(value: Any) -> bool:
    """Returns whether a variable of a class or a module is a value that can change."""
    kinds = (*PLAIN, list, dict, set, deque, tuple, np.ndarray, np.generic, np.random.Generator)
    return isinstance(value, kinds)
