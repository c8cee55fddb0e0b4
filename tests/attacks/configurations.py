"""Settings of config.json with one change that no run can mean, written with a right SHA-256."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from attacks import Trial, child, command
from attacks.forgery import content_of, write
from attacks.material import TASK, Material

NAN, INF, HUGE, LONG = float("nan"), float("inf"), 2**40, "x" * 10**4
# Values of the wrong type for every number and name.
TYPES: tuple[Any, ...] = ("abc", "", None, [], [1], {}, {"a": 1}, True, False, "5", "NaN")
COUNTS = (0, -1, -5, 1.5, -HUGE, NAN, INF)  # of what there is at least one of
STAGES = (
    "train", "critical-set", "partition", "extended-sets", "retrain", "robustness", "simulate",
    "figures", "replay", "report",
)  # fmt: skip

# The wrong values of each setting, besides those of the wrong type.
TRAINING: dict[str, tuple[Any, ...]] = {
    "algorithm": ("PP0", "os:system", ":", "a:b:c", "../evil:X", 3, "dqn"),
    "samples": COUNTS,
    "envs": (*COUNTS, HUGE),
    "hidden": ([0], [-1], [1.5], ["a"], [HUGE], [[8]], [NAN], 8, [64, None]),
    "activation": ("Tanh", "os.system", 1, "relu\n"),
    "learning_rate": (0, -1e-3, NAN, INF, -INF),
    "anneal": (1, 0, 2, "yes", NAN),
    "final_rate": (-0.1, 1.1, NAN, INF),
    "gamma": (-0.1, 1.1, NAN, INF, 100),
    "rehearse_lost": (-0.1, 1.1, NAN),
    "rehearse_deciding": (-0.1, 0.7, NAN),
    "symmetric": (1, "no", NAN),
    "warm_start": (1, "no", NAN),
    "episode": COUNTS,
    "attempts": COUNTS,
    "action_noise": (-0.1, NAN, INF, -INF),
    "options": (
        {"n_steps": 0}, {"n_steps": "many"}, {"n_steps": 1.5}, {"batch_size": -1}, {"n_epochs": None},
        {"no_such": 1}, {"policy": "CnnPolicy"}, {"env": None}, {"learning_rate": 1e-3},
        {"gamma": 2}, {"clip_range": -1}, {"clip_range": "abc"}, {"device": "no_such"},
        {"n_steps": HUGE}, {"ent_coef": NAN}, {"verbose": "loud"}, {"_init_setup_model": False},
        {"tensorboard_log": "/etc"}, {"policy_kwargs": {"net_arch": [0]}}, {"seed": "a"}, 3, "abc", [],
    ),
}  # fmt: skip
SETTINGS: dict[str, tuple[Any, ...]] = {
    "task": ("unit_square", "unit_circle ", "UNIT_CIRCLE", 5, "a.py", "../..", LONG),
    "preset": ("quick", "Fast", 5, LONG),
    "seed": (-1, 2**32, 1.5, NAN, -HUGE, 10**400),
    "eps": (-0.1, NAN, INF, -INF, 1e308, 100, 3.2),
    "horizon": (0, -0.5, NAN, INF, -INF),
    "stage1": ("abc", None, [], {}, {"algorithm": "ppo"}, 3),
    "stage6": ("abc", None, [], {}, {"algorithm": "ppo"}, 3),
    "cells": (*COUNTS, HUGE),
    "rods": (*COUNTS, HUGE),
    "lattice": (*COUNTS[1:], HUGE),
    "resolution": (0, -1, 2, NAN, INF, -INF),
    "search": ("rod", "Rods", 5, LONG),
    **dict.fromkeys(("ways", "overlap", "modes", "table"), ("abc", None, [], {}, {"wedge": 4}, 3)),
}
# The same of the groups of settings: of the first numbers in each, which stand for the others.
GROUPS: dict[tuple[str, str], tuple[Any, ...]] = {
    ("ways", "samples"): COUNTS,
    ("ways", "parting"): (0, 1.1, NAN, INF),
    ("overlap", "longest"): (0, -1, NAN, INF),
    ("modes", "margin"): (0.9, NAN, INF),
    ("modes", "batches"): ([], [0], [1.5], ["a"], [HUGE], 8),
    ("table", "tables"): (*COUNTS, HUGE),
}
# What is no mistake: a missing horizon or episode has a meaning.
MEANT = {("horizon", "null"), ("hidden", "[1]"), ("episode", "null"), ("options", "{}"), ("anneal", "true"),
         ("anneal", "false"), ("symmetric", "true"), ("symmetric", "false"), ("warm_start", "true"),
         ("warm_start", "false"), ("versions", "{}")}  # fmt: skip


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns trials of changes drawn from all of them, as many of each setting as possible."""
    material.finished()
    by_setting = [list(_changes(*place)) for place in _places()]
    for changes in by_setting:
        draw.shuffle(changes)
    drawn = []
    while len(drawn) < count and any(by_setting):
        drawn += [changes.pop() for changes in by_setting if changes]
    return [Trial(name, partial(_attempt, material, change)) for name, change in drawn[:count]]


Place = tuple[tuple[str, ...], tuple[Any, ...]]
Change = tuple[tuple[str, ...], str, Any]


def _places() -> Iterator[Place]:
    """Yields every setting with its wrong values."""
    for name, values in SETTINGS.items():
        yield ("settings", name), values
    for stage in ("stage1", "stage6"):
        for name, values in TRAINING.items():
            yield ("settings", stage, name), values
    for place, values in GROUPS.items():
        yield ("settings", *place), values
    yield ("settings",), ()
    yield ("versions",), ()


def _changes(place: tuple[str, ...], values: tuple[Any, ...]) -> Iterator[tuple[str, Change]]:
    """Yields the changes of one setting: removed, joined by an unknown one, of a wrong type or range."""
    title = ".".join(place)
    yield f"{title} removed", (place, "remove", None)
    yield f"{title} beside an unknown one", (place, "add", 1)
    for value in (*values, *TYPES):
        import json

        if (place[-1], json.dumps(value)) not in MEANT and not (
            len(place) == 1 and value == {"a": 1}
        ):
            shown = repr(value)
            yield f"{title} = {shown[:40]}", (place, "set", value)


def _attempt(material: Material, change: Change, folder: Path) -> str:
    """Changes a setting of a finished run, and runs every stage, until one says what is wrong."""
    path = material.copy(folder)
    place, how, value = change
    content = content_of(path / "config.json")
    inner = content
    for name in place[:-1]:
        inner = inner[name]
    if how == "remove":
        del inner[place[-1]]
    elif how == "add":
        inner[f"{place[-1]}_"] = value
    else:
        inner[place[-1]] = value
    write(path / "config.json", content)
    for stage in STAGES:
        answer = child(command(stage, TASK), folder)
        if broke := answer.broke(ended=(0, 1, 2)):
            return f"{stage}: {broke}"
        if answer.status == 2:
            return _named(answer.err, place, stage)
        if answer.status == 1 and stage == "train":
            return ""
    return "taken without a word by all stages"


def _named(said: str, place: tuple[str, ...], stage: str) -> str:
    """Returns what is wrong with a sentence about a setting: it must say which file or setting is wrong."""
    return "" if "config.json" in said or place[-1] in said else f"{stage} names neither: {said!r}"
