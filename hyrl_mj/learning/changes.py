"""Single settings that a user changes, by their names in `config.json`, and how settings differ."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.learning.settings import Settings, Training
from hyrl_mj.policies import Agent

STAGES = ("stage1", "stage6")
# Settings that have options of their own.
OPTIONS = {
    "task": "TASK",
    "preset": "--preset",
    "seed": "--seed, in a sweep --seeds",
    "eps": "--eps",
    "sensor": "--noise",
    "horizon": "--horizon",
    "everywhere": "--all-coordinates",
    "stage1.algorithm": "--algorithm",
}
# Names of options that differ from those of their settings.
NAMES = {"sensor": "noise", "stage1": "policy", "everywhere": "all_coordinates"}


def changed(settings: Settings, changes: Mapping[str, object]) -> Settings:
    """Returns settings with some of them changed.

    Args:
        settings: of a preset.
        changes: the new values by name, as "lattice", "ways.wedge", "stage1.samples" or
            "stage6.options.n_epochs"; a text is read as JSON where it can be.

    Raises:
        BadInput: an unknown setting, a value that it cannot have, or a setting with an option of its own.
    """
    groups: dict[str, dict[str, Any]] = {}
    known, records = dict(_leaves(settings)), dict(_records(settings))
    of_sb3 = [f"{name}.options" for name, record in records.items() if isinstance(record, Training)]
    for name, value in changes.items():
        if name in OPTIONS:
            raise BadInput(
                f"the setting {name} has an option of its own: give it with {OPTIONS[name]}"
            )
        group, _, field = name.rpartition(".")
        if name not in known and group not in of_sb3:
            alike = [n for n in known if n.rpartition(".")[0] == group and n not in OPTIONS]
            raise unknown("setting", name, alike or known)
        groups.setdefault(group, {})[field] = _value(value, known.get(name))
    top = groups.pop("", {})
    for group, record in records.items():
        new = groups.get(group, {})
        if more := groups.get(f"{group}.options"):
            new["options"] = record.options | more
        if new:
            try:
                top[group] = replace(record, **new)
            except BadInput as error:
                raise BadInput(f"{group}: {error}") from error
    return replace(settings, **top)


def _records(settings: Any) -> Iterator[tuple[str, Any]]:
    """Yields the groups of settings within others, by name; an agent has none that can be changed."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value) and not isinstance(value, Agent):
            yield field.name, value


def _leaves(record: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Returns the settings that can be changed, with their values, by name."""
    leaves: list[tuple[str, Any]] = []
    groups = dict(_records(record))
    for field in fields(record):
        name, value = prefix + field.name, getattr(record, field.name)
        if field.name in groups:
            leaves += _leaves(value, f"{name}.")
        elif field.name == "options":
            leaves += [(f"{name}.{option}", known) for option, known in value.items()]
        elif name not in STAGES:
            leaves.append((name, value))
    return leaves


def setting_value(value: object) -> object:
    """Returns a value as JSON holds it; a text is read as JSON where it can be.

    Raises:
        BadInput: JSON cannot hold it.
    """
    try:
        return json.loads(value if isinstance(value, str) else json.dumps(value))
    except ValueError:
        return {"True": True, "False": False, "None": None}.get(value, value)  # type: ignore[call-overload]
    except TypeError:
        raise BadInput(
            f"a setting cannot be {value!r}: give a number, a text, a list or None"
        ) from None


def _value(value: object, present: object) -> object:
    """Returns the value of a setting; 3e5 is an integer where the present value is one."""
    value = setting_value(value)
    whole = isinstance(value, float) and value.is_integer() and type(present) is int
    return int(value) if whole else value  # type: ignore[call-overload]


def changes(settings: Settings, of: Settings) -> dict[str, Any]:
    """Returns what `changed` has to change of other settings to get these."""
    before = dict(_leaves(of))
    return {
        name: value
        for name, value in _leaves(settings)
        if name not in OPTIONS and before.get(name) != value
    }


def differing(old: Any, new: Any, of: str = "") -> Iterator[str]:
    """Yields a description of each setting that differs, by the name of its option.

    Trainings with different algorithms, and agents, are described as a whole.
    """
    groups = dict(_records(old))
    for name, before in vars(old).items():
        now = getattr(new, name)
        alike = type(before) is type(now) and name in groups
        if alike and getattr(before, "algorithm", "") == getattr(now, "algorithm", ""):
            yield from differing(before, now, f"{name}.")
        elif before != now:
            option = of + NAMES.get(name, name)
            old_text, new_text = _brief(before), _brief(now)
            change = f": {old_text} there, {new_text} given" if old_text != new_text else ""
            yield option + change


def _brief(setting: object) -> str:
    """Returns a short description of the value of a setting."""
    if isinstance(setting, Agent):
        return f"{setting} of sha256 {setting.sha256[:8]}"
    return f"training with {setting.algorithm}" if isinstance(setting, Training) else str(setting)
