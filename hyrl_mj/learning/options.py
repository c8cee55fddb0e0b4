"""The options of SB3's algorithms that a training can have, with their ranges."""

from collections.abc import Mapping
from typing import Any

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.ranges import Flag, Integer, Number, Optional, Rule, Text, refused

_SHARE, _POSITIVE, _ANY = Number(0, 1), Number(0, 1e6, above=True), Number(0, 1e6)
_COUNT = Integer(1, 10**6)
_ON_POLICY: dict[str, Rule] = {
    "n_steps": _COUNT,
    "gae_lambda": _SHARE,
    "ent_coef": _ANY,
    "vf_coef": _ANY,
    "max_grad_norm": _POSITIVE,
    "normalize_advantage": Flag(),
}
_OFF_POLICY: dict[str, Rule] = {
    "buffer_size": Integer(1, 10**7),
    "learning_starts": Integer(0, 10**9),
    "batch_size": _COUNT,
    "tau": Number(0, 1, above=True),
    "train_freq": _COUNT,
    "gradient_steps": Integer(-1, 10**4),
    "n_steps": Integer(1, 1_000),
}
OPTIONS: dict[str, dict[str, Rule]] = {
    "ppo": _ON_POLICY
    | {
        "batch_size": Integer(2, 10**6),
        "n_epochs": Integer(1, 1_000),
        "clip_range": _POSITIVE,
        "clip_range_vf": Optional(_POSITIVE),
        "target_kl": Optional(_POSITIVE),
    },
    "a2c": _ON_POLICY | {"rms_prop_eps": _POSITIVE, "use_rms_prop": Flag()},
    "dqn": _OFF_POLICY
    | {
        "target_update_interval": Integer(1, 10**9),
        "exploration_fraction": Number(0, 1, above=True),
        "exploration_initial_eps": _SHARE,
        "exploration_final_eps": _SHARE,
        "max_grad_norm": _POSITIVE,
    },
    "sac": _OFF_POLICY | {"ent_coef": _ANY, "target_update_interval": Integer(1, 10**9)},
    "td3": _OFF_POLICY
    | {
        "policy_delay": Integer(1, 1_000),
        "target_policy_noise": _ANY,
        "target_noise_clip": _ANY,
    },
    "ddpg": _OFF_POLICY,
}
# What `Training` itself gives to every algorithm, and what this package decides.
OWN = ("policy", "env", "seed", "device", "gamma", "learning_rate", "policy_kwargs", "action_noise")


def check_options(algorithm: str, options: Mapping[str, Any], *, samples: int, envs: int) -> None:
    """Raises `BadInput` if SB3's algorithm does not take these options, or a training of this length.

    Of a `module:Class` the names are not known: only the values are checked, and `training.build` tries
    them.
    """
    if not isinstance(options, Mapping):
        raise refused("options", options, "a dictionary of SB3's keyword arguments")
    rules = OPTIONS.get(algorithm)
    for name, value in options.items():
        if rules is None:
            _check_plain(name, value)
        elif name not in rules:
            raise unknown(f"option of {algorithm}", name, rules)
        else:
            rules[name].checked(f"options.{name}", value)
    first = options.get("learning_starts", 0)
    if rules is not None and first >= samples:
        raise BadInput(
            f"options.learning_starts {first:,} cannot be used, because nothing would be learned in "
            f"{samples:,} samples: give fewer"
        )
    most = 2**24  # a rollout of PPO or A2C lies in memory
    if algorithm in ("ppo", "a2c") and options.get("n_steps", 1) * envs > most:
        raise BadInput(
            f"options.n_steps {options['n_steps']:,} in {envs:,} episodes side by side cannot be used: "
            f"together give at most {most:,} samples"
        )


def _check_plain(name: Any, value: Any) -> None:
    """Checks the option of an unknown algorithm: a number, a text, True, False or None."""
    Text().checked("the name of an option", name)
    if name in OWN:
        raise BadInput(
            f"options.{name} cannot be used: `Training` has a field or a rule of its own for it"
        )
    if not (value is None or isinstance(value, bool | str)):
        Number(-1e12, 1e12).checked(f"options.{name}", value)
