"""The algorithms that can train: those of SB3 by their names, and others like them as `module:Class`."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hyrl_mj.errors import BadInput, brief, unknown

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


@dataclass(frozen=True)
class Algorithm:
    """An algorithm of SB3: the inputs that it can have, and how its policies are built.

    Attributes:
        levels: True if it needs levels of the input, False if it needs a continuous input, None if it takes
            either.
        parts: beginnings of the names of the tensors of the network that acts, from observation to output.
        activation: SB3's default between the layers.
        squashed: whether the output goes through tanh and is stretched to the task's input limits;
            otherwise it is clipped to them.
        log_std: the tensor, or the layer beside the last one, that holds the logarithm of the standard
            deviation during training; None if nothing is drawn from a distribution.
    """

    levels: bool | None
    parts: tuple[str, ...]
    activation: str
    squashed: bool = False
    log_std: str | None = None

    def takes(self, discrete: bool) -> bool:
        """Whether it can have levels of the input (`discrete`), or a continuous input."""
        return self.levels in (None, discrete)

    @property
    def is_actor_critic(self) -> bool:
        """Whether its policy network is trained directly, beside a value function (PPO and A2C)."""
        return self.parts == _ACTOR_CRITIC.parts


# SB3 1.x had layers that policy and value function share.
_ACTOR_CRITIC = Algorithm(
    levels=None,
    parts=("mlp_extractor.shared_net.", "mlp_extractor.policy_net.", "action_net."),
    activation="tanh",
    log_std="log_std",
)
_DETERMINISTIC = Algorithm(levels=False, parts=("actor.mu.",), activation="relu", squashed=True)
ALGORITHMS = {
    "ppo": _ACTOR_CRITIC,
    "a2c": _ACTOR_CRITIC,
    "dqn": Algorithm(levels=True, parts=("q_net.q_net.",), activation="relu"),
    "sac": Algorithm(
        levels=False,
        parts=("actor.latent_pi.", "actor.mu."),
        activation="relu",
        squashed=True,
        log_std="actor.log_std",
    ),
    "td3": _DETERMINISTIC,
    "ddpg": _DETERMINISTIC,
}


def algorithm_title(name: str) -> str:
    """Returns the display name of an algorithm: "PPO", or "TQC" for "sb3_contrib:TQC"."""
    return name.rpartition(":")[2].upper()


def check_algorithm(name: str, task: str, levels: int | None) -> None:
    """Raise `BadInput` where an algorithm is unknown, or cannot have the inputs of a task.

    Args:
        name: one of `ALGORITHMS`, or `module:Class` of another one.
        task: what messages call the task.
        levels: of its input, None for continuous inputs.
    """
    if ":" not in name and name not in ALGORITHMS:
        raise unknown(
            "algorithm", name, [*ALGORITHMS, f"or module:Class of another one for {task}"]
        )
    discrete = levels is not None
    if ALGORITHMS[relative(name, levels)].takes(discrete):
        return
    which = f"takes no levels of the input, {task} has {levels}"
    if not discrete:
        which = f"needs levels of the input, {task} has none"
    able = [other for other, algorithm in ALGORITHMS.items() if algorithm.takes(discrete)]
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
