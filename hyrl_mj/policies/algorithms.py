"""The training algorithms: those of SB3 by name, and others with its interface as `module:Class`."""

from __future__ import annotations

import importlib
import inspect
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyrl_mj.errors import BadInput, brief, unknown
from hyrl_mj.files import trust

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


@dataclass(frozen=True)
class Algorithm:
    """An algorithm of SB3: which inputs it takes, and how its policies are built.

    Attributes:
        levels: True if it needs levels of the input, False if it needs a continuous input, None if it takes
            either.
        parts: prefixes of the tensor names of the policy network, from observation to output.
        activation: SB3's default between the layers.
        squashed: whether the output goes through tanh and is stretched to the task's input limits;
            otherwise it is clipped to them.
        log_std: the tensor, or the layer beside the last one, that holds the logarithm of the standard
            deviation during training; None if the policy has no distribution.
    """

    levels: bool | None
    parts: tuple[str, ...]
    activation: str
    squashed: bool = False
    log_std: str | None = None

    def takes(self, discrete: bool) -> bool:
        """Returns whether it takes levels of the input (`discrete`), or a continuous input."""
        return self.levels in (None, discrete)

    @property
    def is_actor_critic(self) -> bool:
        """Whether it trains the policy network directly, beside a value function (PPO and A2C)."""
        return "action_net." in self.parts


ALGORITHMS = {
    **dict.fromkeys(
        ("ppo", "a2c"),
        Algorithm(
            None,
            # SB3 1.x had layers that policy and value function share.
            ("mlp_extractor.shared_net.", "mlp_extractor.policy_net.", "action_net."),
            "tanh",
            log_std="log_std",
        ),
    ),
    "dqn": Algorithm(True, ("q_net.q_net.",), "relu"),
    "sac": Algorithm(
        False, ("actor.latent_pi.", "actor.mu."), "relu", squashed=True, log_std="actor.log_std"
    ),
    **dict.fromkeys(("td3", "ddpg"), Algorithm(False, ("actor.mu.",), "relu", squashed=True)),
}


def title(name: str) -> str:
    """Returns the display name of an algorithm: "PPO", or "TQC" for "sb3_contrib:TQC"."""
    return name.rpartition(":")[2].upper()


def check(name: str, task: str, levels: int | None) -> None:
    """Raises `BadInput` if an algorithm is unknown, or does not take the inputs of a task.

    The inputs have a number of levels, or None if they are continuous.
    """
    if ":" not in name and name not in ALGORITHMS:
        names = [*ALGORITHMS, f"or module:Class of another one for {task}"]
        raise unknown("algorithm", name, names)
    discrete = levels is not None
    if ALGORITHMS[sb3_relative(name, levels)].takes(discrete):
        return
    needs = f"needs levels of the input, {task} has none"
    if discrete:
        needs = f"takes no levels of the input, {task} has {levels}"
    allowed = [other for other, algorithm in ALGORITHMS.items() if algorithm.takes(discrete)]
    raise BadInput(f"{name} {needs}: choose one of {', '.join(allowed)}")


def sb3_class(name: str) -> type[BaseAlgorithm]:
    """Returns the class of one of `ALGORITHMS`, or of a `module:Class`, from the current folder, too.

    Raises:
        BadInput: there is no such module or class, or it is no algorithm of SB3's kind.
    """
    # Slow to import, and only needed here.
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    named = f"stable_baselines3:{name.upper()}" if name in ALGORITHMS else name
    algorithm: type[BaseAlgorithm] = imported(named, f"the algorithm {name}")
    kinds = (OnPolicyAlgorithm, OffPolicyAlgorithm)
    if not (isinstance(algorithm, type) and issubclass(algorithm, kinds)):
        raise BadInput(
            f"the algorithm {name} is no algorithm of SB3's kind: give a subclass of its "
            "OnPolicyAlgorithm or OffPolicyAlgorithm"
        )
    return algorithm


def imported(name: str, what: str) -> Any:
    """Returns the object that `module:object` names, from the current folder where it is not installed.

    Raises:
        BadInput: there is none; `what` names it.
    """
    module, _, attribute = name.partition(":")
    try:
        with trust.current_folder(module):
            return attrgetter(attribute)(importlib.import_module(module))
    except (Exception, SystemExit) as error:  # a foreign module can raise anything
        raise BadInput(f"{what} cannot be imported: {brief(error)}") from error


def remember(name: str) -> None:
    """Records that the user has named an algorithm, so that runs with it can be trained again."""
    if (source := _source(name)) is not None:
        trust.remember(source)


def check_named(name: str) -> None:
    """Raises `BadInput` if an algorithm, which a file names, is in a module that the user has not named."""
    if name in ALGORITHMS:
        return
    source = _source(name)
    if source is None or not trust.is_known(source):
        raise BadInput(
            f"the run trains with {name}, from a module that you have not named before, as it is now: if "
            f"you trust it, name it with hyrl-mj run TASK --algorithm {shlex.quote(name)}"
        )


def _source(name: str) -> Path | None:
    """Returns the file of the top-level module of a `module:Class`, without an import of it."""
    return None if name in ALGORITHMS else trust.module_file(name)


def sb3_relative(name: str, levels: int | None) -> str:
    """Returns the one of `ALGORITHMS` whose settings suit: itself, a base class, or a similar one."""
    if name in ALGORITHMS:
        return name
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    kind = sb3_class(name)
    known = {sb3_class(known): known for known in ALGORITHMS}
    bases = (known[base] for base in kind.__mro__ if base in known)
    similar = "ppo" if issubclass(kind, OnPolicyAlgorithm) else "dqn" if levels else "sac"
    return next(bases, similar)


def accepted_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns those of SB3's keywords that an algorithm takes."""
    parameters = inspect.signature(sb3_class(name).__init__).parameters
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return dict(options)
    return {key: value for key, value in options.items() if key in parameters}
