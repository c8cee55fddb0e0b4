"""What an environment remembers, written down so that two moments, or two instances, can be compared.

Everything that attributes of the environment and of its wrappers lead to is looked at, closures included,
and what all instances share: variables of the modules and classes that define it. Values are only compared,
never set: pickles of them are written, and none is read.
"""

from __future__ import annotations

import copyreg
import inspect
import marshal
import os
import pickle
import random
import sys
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Set
from contextlib import suppress
from ctypes import c_int
from dataclasses import dataclass
from functools import cache, partial
from mmap import mmap
from multiprocessing.sharedctypes import SynchronizedBase
from operator import attrgetter
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

from hyrl_mj.files import sources
from hyrl_mj.files.artifacts import digest
from hyrl_mj.gym_import.opening import layers
from hyrl_mj.gym_import.physics import Physics, parts_of_model

# Objects of these modules hold no memory of an environment, or it is in MuJoCo's state.
PASSED = (
    "mujoco", "dm_control.mujoco", "dm_control.mjcf", "dm_control.rl.specs", "dm_env", "OpenGL",
    "gymnasium.spaces", "gymnasium.envs.registration", "gymnasium.envs.mujoco.mujoco_rendering",
    "lxml", "xml", "logging", "re", "_thread", "weakref", "hyrl_mj",
)  # fmt: skip
# Packages whose modules and classes hold no memory of an episode.
LIBRARIES = {
    "gymnasium", "dm_control", "shimmy", "numpy", "mujoco", "hyrl_mj", *sys.stdlib_module_names,
}  # fmt: skip
# How deep attributes of attributes are looked at, and how many values at most. What lies beyond cannot be
# compared, and counts as different.
DEEPEST, MOST = 10, 100_000
GENERATORS = np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random
PLAIN = (type(None), bool, int, float, complex, str, bytes)
# Values of C, which processes may share: of `ctypes`, by the class of all of them, and of `multiprocessing`.
SHARED = (array, bytearray, mmap, c_int.__mro__[2], SynchronizedBase)
# The kinds of variables of a class or a module whose values can change.
DATA = (*PLAIN, list, dict, set, deque, tuple, np.ndarray, np.generic, *GENERATORS, *SHARED)
FUNCTIONS = FunctionType | MethodType


class Fingerprint(dict[str, Any]):
    """What is remembered, by the names of its places.

    Attributes:
        generators: the generators of random numbers among it, by name.
    """

    def __init__(self) -> None:
        super().__init__()
        self.generators: dict[str, Any] = {}


@dataclass(frozen=True)
class Unknown:
    """A value that cannot be written down: all that is known is whether it is the same object.

    Attributes:
        number: of the object in this process, None of one that equals no other.
    """

    number: int | None = None

    def __eq__(self, other: object) -> bool:
        known = isinstance(other, Unknown) and self.number is not None
        return known and self.number == getattr(other, "number", None)


def fingerprint(env: gym.Env, physics: Physics) -> Fingerprint:
    """Returns what an environment remembers outside of its state in MuJoCo, by the names of its places."""
    seen = {id(physics.model), id(physics.data)}
    found = shared(env, seen)
    found.update((f"{name} of its model", value.tobytes()) for name, value in physics.parts.items())
    found["opt of its model"] = _of_options(physics.model)
    for layer in layers(env):
        _walk(layer, "" if layer is env.unwrapped else type(layer).__name__, found, seen, 0)
    return found


def shared(env: gym.Env, seen: set[int] | None = None) -> Fingerprint:
    """Returns what all instances of an environment share: variables of its classes and their modules.

    The ids of objects that are written down are added to `seen`.
    """
    found, seen = Fingerprint(), set() if seen is None else seen
    for where, owner, name in shared_variables(env):
        _walk(vars(owner).get(name), where, found, seen, 1)
    return found


def shared_variables(env: gym.Env) -> Iterator[tuple[str, Any, str]]:
    """Yields variables that all instances share: names, their classes or modules, and keys in these."""
    for kind in {kind: None for layer in layers(env) for kind in type(layer).__mro__}:
        module = kind.__module__ or ""
        if module.partition(".")[0] in LIBRARIES:
            continue
        owners = {f"class {kind.__name__}": kind, f"module {module}": sys.modules.get(module)}
        for where, owner in owners.items():
            if owner is not None:
                for name in _data_of(owner, len(vars(owner))):
                    # A script or a notebook has variables that are none of the environment's.
                    if owner is kind or name in _names_in(kind):
                        yield f"{where}.{name}", owner, name


def of_model(model: mujoco.MjModel) -> dict[str, bytes]:
    """Returns what may be changed in MuJoCo's model, by name."""
    found = {name: value.tobytes() for name, value in parts_of_model(model).items()}
    return {**found, "opt": _of_options(model)}


def _of_options(model: mujoco.MjModel) -> bytes:
    numbers = list[float]()
    for value in _options()(model.opt):
        numbers += value.ravel().tolist() if isinstance(value, np.ndarray) else [value]
    return np.array(numbers, dtype=float).tobytes()


@cache
def _options() -> Callable[[Any], tuple[Any, ...]]:
    """Returns what gives the values of all options."""
    return attrgetter(*(name for name in dir(mujoco.MjOption) if not name.startswith("_")))


def is_known(found: Fingerprint) -> bool:
    """Returns whether all that is remembered could be written down."""
    return not any(isinstance(value, Unknown) for value in found.values())


def differing(a: Fingerprint, b: Fingerprint) -> list[str]:
    """Returns the names of the places at which two fingerprints differ."""
    if a == b:
        return []
    return [name for name in {**a, **b} if name not in a or name not in b or a[name] != b[name]]


def is_shared(name: str) -> bool:
    """Returns whether all instances share the place of a name."""
    return name.startswith(("module ", "class "))


def state_of(generator: Any) -> bytes:
    """Returns the state of a generator of random numbers, to compare it."""
    if isinstance(generator, random.SystemRandom):
        return os.urandom(16)  # the system's, which nothing tells: it never is as it was
    if isinstance(generator, random.Random):
        return pickle.dumps(generator.getstate())
    if is_of_torch(generator, "Generator"):
        return bytes(generator.get_state().numpy())
    bits = getattr(generator, "bit_generator", generator)
    return pickle.dumps(bits.state if hasattr(bits, "state") else generator.get_state())


def _walk(value: Any, path: str, found: Fingerprint, seen: set[int], depth: int) -> None:
    """Writes down a value, and what its parts lead to."""
    if isinstance(value, PLAIN):
        found[path] = marshal.dumps(value, 0)  # NaN equals NaN so
    elif isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufcSU":
        found[path] = value.shape, value.dtype.str, value.tobytes()
    elif isinstance(value, GENERATORS) or is_of_torch(value, "Generator"):
        found[path], found.generators[path] = state_of(value), value
    elif isinstance(value, spaces.Space):
        parts: Any = getattr(value, "spaces", ())  # of a Dict or a Tuple
        numbered = parts.items() if isinstance(parts, Mapping) else enumerate(parts)
        _walk(value._np_random, f"{path}.np_random", found, seen, depth)
        for name, part in numbered:
            _walk(part, f"{path}[{name!r:.40}]", found, seen, depth + 1)
    elif id(value) in seen:
        return
    elif isinstance(value, mujoco.MjData | mujoco.MjModel):  # another one than that of its state
        seen.add(id(value))
        is_model = isinstance(value, mujoco.MjModel)
        found[path] = of_model(value) if is_model else Physics(value.model, value).read().tobytes()
    elif has_no_memory(value):
        return
    elif depth > DEEPEST or len(found) > MOST:
        found[path] = Unknown()
    else:
        seen.add(id(value))
        parts = _parts(value, path, found, depth)
        for name, part in parts.items():
            _walk(part, name, found, seen, depth + 1)


def _parts(value: Any, path: str, found: Fingerprint, depth: int) -> dict[str, Any]:
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
        return {f"{path}.{name}": part for name, part in _variables_of(value).items()}
    if isinstance(value, BuiltinFunctionType):
        return {f"{path}.self": value.__self__}
    if isinstance(value, partial):
        return {f"{path}()": [value.func, value.args, value.keywords]}
    if is_of_torch(value, "Tensor"):
        return {path: value.detach().cpu().numpy()}
    if not hasattr(value, "__dict__"):
        try:
            found[path] = memoryview(value).tobytes()  # of an array, also in shared memory
        except Exception:  # whatever a foreign class raises
            found[path] = _pickled(value)
        return {}
    own = attributes_of(value)
    kind: Any = type(value)
    if depth == 0:  # arguments of a constructor, and methods that are put in by `Instance`
        for name in ("_ezpickle_args", "_ezpickle_kwargs", "_saved_kwargs", "step", "reset"):
            own.pop(name, None)
    if _has_more(kind):
        try:
            own["()"] = value.__reduce_ex__(2)[1:3]
        except Exception:  # it cannot be written down
            found[path] = Unknown(id(value))
    return {f"{path}.{name}" if path else name: part for name, part in own.items()}


def attributes_of(value: Any) -> dict[str, Any]:
    """Returns the attributes of an object by name, with those that its class keeps in slots."""
    state = object.__getstate__(value)
    slots = state[1] if isinstance(state, tuple) else {}
    return {**getattr(value, "__dict__", {}), **slots}


def _pickled(value: Any) -> Any:
    try:
        return pickle.dumps(value)
    except Exception:  # whatever a foreign class raises
        return Unknown(id(value))


@cache
def _has_more(kind: type) -> bool:
    """Returns whether objects of a class keep something beside attributes, as those of C do."""
    pointers = (kind.__dictoffset__ > 0) + (kind.__weakrefoffset__ > 0)
    slots = len(copyreg._slotnames(kind))  # type: ignore[attr-defined]
    return kind.__basicsize__ > object.__basicsize__ + 8 * (pointers + slots)


def is_of_torch(value: Any, name: str) -> bool:
    """Returns whether a value is of a class of torch, which need not be installed."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, getattr(torch, name))


def _variables_of(function: Any) -> dict[str, Any]:
    """Returns what a function, or the object of a method, remembers from call to call, by name."""
    owner = getattr(function, "__self__", None)
    function = getattr(function, "__func__", function)
    found = {**vars(function), **({} if owner is None else {"self": owner})}
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=False)
    for name, cell in cells:
        with suppress(ValueError):  # the cell is empty
            found[name] = cell.cell_contents
    return found


def has_no_memory(value: Any) -> bool:
    """Returns whether a value is of a kind that remembers nothing outside of MuJoCo's state."""
    if isinstance(value, FUNCTIONS):
        return not _variables_of(value)
    if isinstance(value, BuiltinFunctionType):  # of a module, or of an object of C
        return isinstance(value.__self__, type | ModuleType | None)
    if isinstance(value, type | ModuleType | property):
        return True
    return _is_passed(type(value).__module__ or "")


@cache
def _is_passed(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in PASSED)


@cache
def _names_in(kind: type) -> frozenset[str]:
    """Returns the names that the methods of a class use, and the functions of its module that these call."""
    module, codes, names = vars(sys.modules[kind.__module__]), codes_of(kind), set[str]()
    while codes:
        for name in set(codes.pop().co_names) - names:
            names.add(name)
            if isinstance(part := module.get(name), FunctionType):
                codes += _with_inner(part.__code__)
            elif isinstance(part, type):
                codes += codes_of(part)
    return frozenset(names)


def codes_of(kind: type) -> list[CodeType]:
    """Returns the compiled code of the methods of a class, functions within them included."""
    parts = list(vars(kind).values())
    methods = [getattr(part, "__func__", part) for part in parts]  # of classes, and static ones
    methods += [f for part in parts if isinstance(part, property) for f in (part.fget, part.fset)]
    codes = [method.__code__ for method in methods if hasattr(method, "__code__")]
    return [inner for code in codes for inner in _with_inner(code)]


def _with_inner(code: CodeType) -> list[CodeType]:
    parts = [part for part in code.co_consts if isinstance(part, CodeType)]
    return [code, *(inner for part in parts for inner in _with_inner(part))]


def code_of(env: gym.Env, make: Any) -> str:
    """Returns a text of the code that defines an environment, its wrappers, a task of dm_control, and what
    makes it: SHA-256 of files, or what Python has compiled.
    """
    control = getattr(env.unwrapped, "_env", None)
    parts = (*layers(env), control, getattr(control, "task", None))
    found = {_code_of(kind) for part in parts for kind in type(part).__mro__}
    code = getattr(make, "__code__", None)
    return "".join(sorted(found)) + (_compiled(code) if code is not None else "")


@cache  # Python imports a file once, so what has become of it since is not what runs
def _code_of(kind: type) -> str:
    """Returns the SHA-256 of the file that defines a class, one of the user's with those beside it."""
    own = kind.__module__.partition(".")[0] not in LIBRARIES
    try:
        return (sources.digest_of if own else digest)(Path(inspect.getfile(kind)))
    except (TypeError, OSError):  # it is built in, or of a notebook
        return "".join(map(_compiled, codes_of(kind))) if own else ""


def _compiled(code: CodeType) -> str:
    """Returns a text of compiled code, the same in each process."""
    consts = [
        _compiled(one) if isinstance(one, CodeType)
        else sorted(map(repr, one)) if isinstance(one, frozenset) else repr(one)
        for one in code.co_consts
    ]  # fmt: skip
    return f"{code.co_code.hex()} {code.co_names} {consts}"


@cache
def _data_of(owner: Any, size: int) -> list[str]:
    """Returns the names of the variables of a class or module, of so many names, that can change."""
    return [
        name
        for name, value in vars(owner).items()
        if not name.startswith("__")
        and (isinstance(value, DATA) or is_of_torch(value, "Generator"))
    ]
