"""The algorithms that can train: those of SB3 by their names, and others like them as `module:Class`."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hyrl_mj.errors import BadInput, brief, unknown

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

# Of SB3, and whether an algorithm needs levels of the input (True), needs that there are none (False), or
# takes either (None).
ALGORITHMS: dict[str, bool | None] = {
    "ppo": None,
    "a2c": None,
    "dqn": True,
    "sac": False,
    "td3": False,
    "ddpg": False,
}


def algorithm_title(name: str) -> str:
    """An algorithm for people: "PPO"; "TQC" of "sb3_contrib:TQC"."""
    return name.rpartition(":")[2].upper()


def check_algorithm(name: str, task: str, levels: int | None) -> None:
    """Raise `BadInput` where an algorithm is unknown, or cannot have the inputs of a task.

    Args:
        name: one of `ALGORITHMS`, or `module:Class` of another one.
        task: what messages call the task.
        levels: of its input, None for continuous inputs.
    """
    if ":" not in name and name not in ALGORITHMS:
        raise unknown("algorithm", name, [*ALGORITHMS, "or module:Class of another one"])
    discrete = levels is not None
    if ALGORITHMS[relative(name, levels)] in (None, discrete):
        return
    which = f"takes no levels of the input, {task} has {levels}"
    if not discrete:
        which = f"needs levels of the input, {task} has none"
    able = [other for other, needs in ALGORITHMS.items() if needs in (None, discrete)]
    raise BadInput(f"{name} {which}: choose one of {', '.join(able)}")


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm, by one of the names of `ALGORITHMS` or as `module:Class`.

    Modules are also looked for in the current folder.

    Raises:
        BadInput: there is no such module or class, or it is no algorithm of SB3's kind.
    """
    import stable_baselines3  # slow to import, and only needed here
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    if name in ALGORITHMS:
        found: type[BaseAlgorithm] = getattr(stable_baselines3, name.upper())
        return found
    module, _, attribute = name.partition(":")
    sys.path.insert(0, "")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (Exception, SystemExit) as error:  # whatever a foreign module raises
        raise BadInput(f"the algorithm {name} cannot be imported: {brief(error)}") from error
    finally:
        sys.path.remove("")
    kinds = (OnPolicyAlgorithm, OffPolicyAlgorithm)
    if not (isinstance(found, type) and issubclass(found, kinds)):
        raise BadInput(
            f"the algorithm {name} is no algorithm of SB3's kind: give a subclass of its "
            "OnPolicyAlgorithm or OffPolicyAlgorithm"
        )
    return found


def relative(name: str, levels: int | None) -> str:
    """The algorithm of SB3 whose settings suit one: itself, what it is derived from, or a similar one."""
    if name in ALGORITHMS:
        return name
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    kind = algorithm_class(name)
    own = {algorithm_class(known): known for known in ALGORITHMS}
    derived = (own[base] for base in kind.__mro__ if base in own)
    similar = "ppo" if issubclass(kind, OnPolicyAlgorithm) else "dqn" if levels else "sac"
    return next(derived, similar)


def accepted(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of SB3's keywords that an algorithm takes."""
    takes = inspect.signature(algorithm_class(name).__init__).parameters
    if any(p.kind is p.VAR_KEYWORD for p in takes.values()):
        return dict(options)
    return {key: value for key, value in options.items() if key in takes}
