"""The report: one page with all that a run has found, which opens anywhere and prints well."""

from __future__ import annotations

import os
import shlex
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from hyrl_mj import artifacts
from hyrl_mj.errors import BadInput
from hyrl_mj.game import LIMIT, MAP_CLASSES
from hyrl_mj.learning import Settings, Training, preset
from hyrl_mj.policies import Agent, MlpPolicy
from hyrl_mj.run_directory import Run
from hyrl_mj.tasks import get_task
from hyrl_mj.viz.figures import CAPTIONS, CLASS_COLOURS
from hyrl_mj.viz.tables import (
    Arcs,
    Table,
    arrivals,
    episode_table,
    excursion_text,
    extent,
    lasts,
    margin_table,
    margin_text,
    percent,
    replay_sentence,
    replay_table,
    robustness_sentence,
    score_table,
)

# What the classes of the maps mean, in the order of MAP_CLASSES.
MEANINGS = (
    "Whatever the noise does, in whichever mode the controller starts, the run ends well.",
    "Whatever the noise does, the run ends well if the controller picks its start mode from the first "
    "measurement. Started in the other mode it can be lost.",
    "Some noise within the bound makes the run fail, although it could be won.",
    "Decided by what is measured, neither way can be held against the worst noise.",
    "Nothing is left to be decided: an obstacle, the edge of the arena, or the goal.",
)


@dataclass(frozen=True)
class Picture:
    """A PNG in the page.

    Attributes:
        name: for people.
        data: the file as a data URI.
        width, height: [pixels].
        caption: what it shows.
    """

    name: str
    data: str
    width: int
    height: int
    caption: str = ""


@dataclass(frozen=True)
class Number:
    """A figure that the page begins with, of the policy and of HyRL.

    Attributes:
        what: it is.
        policy, hyrl: the values, with unit.
        note: what else is to be known.
    """

    what: str
    policy: str
    hyrl: str
    note: str


def write_report(run: Run, path: Path) -> None:
    """Write the page; what a run lacks is said in its place.

    The same artifacts give the same bytes.

    Args:
        run: with its hybrid controller.
        path: of the page, an html.

    Raises:
        BadArtifact: the controller is not finished, or a file is damaged.
        BadInput: the path is no html, or cannot be written.
    """
    if path.suffix != ".html":
        raise BadInput(f"a report is an html, {path} is not: give a name that ends in .html")
    page = render(run)
    with artifacts.replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def render(run: Run) -> str:
    """The page as HTML."""
    task, modes = run.task, run.controller.modes
    robustness = run.robustness if (run.path / "robustness.json").is_file() else None
    arcs = run.arcs() if all(path.is_file() for path in run.arc_paths().values()) else None
    game = robustness["game"] if robustness else None
    return fill(
        "report.html",
        run,
        modes=[task.mode_name(q) for q in modes],
        worst=task.noise_on(bool(robustness and robustness["everywhere"])),
        video=film(run.path / "replay.mp4"),
        pictures=pictures(run.path / "figures"),
        robustness=robustness,
        game=game,
        arcs=arcs,
        arrivals=arcs and {who: arrivals(run, arcs, who == "policy") for who in ("policy", "hyrl")},
        numbers=_numbers(run, robustness, arcs),
        replays=arcs and replay_table(run, arcs),
        **_tables(run, robustness),
        stages=_stages(run, robustness, arcs),
        table=_settings(run.settings),
        training=_training(run.settings),
        versions=run.versions,
        commands=_commands(run.settings, robustness),
        changed=_changed(run),
        classes=list(zip(MAP_CLASSES, CLASS_COLOURS, MEANINGS, strict=True)),
    )


def fill(template: str, run: Run, **values: Any) -> str:
    """A page from its template, with what every page of a run says."""
    environment = Environment(
        loader=PackageLoader("hyrl_mj"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(
        # A name that is no Unicode must not keep the page from being written.
        name=os.fsencode(run.path.resolve().name).decode("utf-8", "replace"),
        title=run.task.name.replace("_", " ").capitalize(),
        task=run.task,
        settings=run.settings,
        agent=run.agent,
        exact=run.exact,
        critical=run.critical_set,
        unit=run.task.noise_on()[1],
        percent=percent,
        **values,
    )


def _tables(run: Run, robustness: Mapping[str, Any] | None) -> dict[str, Table | None]:
    """The tables of what noise can do, None for those that there are not."""
    task, found = run.task, robustness or {"game": None, "episodes": []}
    return {
        "scores": score_table(task, found) if found["game"] else None,
        "margins": margin_table(task, found) if found["game"] else None,
        "episodes": episode_table(task, found) if found["episodes"] else None,
    }


# ---- pictures


def film(path: Path) -> dict[str, Any] | None:
    """A replay and its poster, if both are there."""
    poster = path.with_suffix(".png")
    if not (path.is_file() and poster.is_file()):
        return None
    return {"data": _data(path, "video/mp4"), "poster": _picture(poster, "replay")}


def pictures(folder: Path) -> list[Picture]:
    """The figures that are there."""
    paths = {name: folder / f"{name}.png" for name in CAPTIONS}
    return [
        _picture(path, name.replace("_", " "), CAPTIONS[name])
        for name, path in paths.items()
        if path.is_file()
    ]


def _picture(path: Path, name: str, caption: str = "") -> Picture:
    with artifacts.reading(path), Image.open(path, formats=("PNG",)) as image:
        image.verify()
        return Picture(name, _data(path, "image/png"), *image.size, caption)


def _data(path: Path, kind: str) -> str:
    """A file as a data URI."""
    return f"data:{kind};base64,{b64encode(path.read_bytes()).decode()}"


# ---- numbers


def _numbers(run: Run, robustness: Mapping[str, Any] | None, arcs: Arcs | None) -> list[Number]:
    """The key scores."""
    found: list[Number] = []
    if robustness is not None and robustness["game"] is not None:
        found += _game_numbers(run, robustness)
    elif robustness is not None:
        found += _episode_numbers(robustness)
    if arcs is not None:
        (won, runs), (ours, all_ours) = (arrivals(run, arcs, policy) for policy in (True, False))
        note = f"the paper's starts, alternating noise {run.settings.noise:g}"
        found.append(
            Number(
                "replays that reach the set-point",
                f"{won} of {runs}",
                f"{ours} of {all_ours}",
                note,
            )
        )
    return found


def _game_numbers(run: Run, robustness: Mapping[str, Any]) -> list[Number]:
    game = robustness["game"]
    where, unit = run.task.noise_on(robustness["everywhere"])
    policy, hyrl, limit = (game["scores"][who][-1] for who in ("policy", "hyrl", LIMIT))
    noise = f"worst noise on {where} up to {hyrl['eps']:g} {unit}"
    margins = {who: margin_text(margin, unit) for who, margin in game["margin"].items()}
    found = [
        Number("winnable starts won", percent(policy["won"]), percent(hyrl["won"]), noise),
        Number(
            "winnable starts won from every start mode",
            percent(policy["won_any"]),
            percent(hyrl["won_any"]),
            f"{noise}; the limit is {percent(limit['won_any'])}",
        ),
        Number(
            "noise up to which all of them are won",
            margins["policy"],
            margins["hyrl"],
            f"the margin: worst noise on {where}",
        ),
    ]
    if lasts(game):
        off, ours = (f"{excursion_text(score['excursion'])} {unit}" for score in (policy, hyrl))
        found.append(Number("kept off the set-point for ever, at most", off, ours, noise))
    return found


def _episode_numbers(robustness: Mapping[str, Any]) -> list[Number]:
    """The shares of the kind of noise that is worst, by start region."""
    records = robustness["episodes"]
    regions = dict.fromkeys(r["region"] for r in records)
    shares = {
        (region, who): min(
            r["reached"] for r in records if (r["region"], r["controller"]) == (region, who)
        )
        for region in regions
        for who in ("policy", "hyrl")
    }
    note = f"the least over {', '.join(dict.fromkeys(r['noise'] for r in records))} noise"
    return [
        Number(
            f"episodes that reach the set-point, starts {region}",
            percent(shares[region, "policy"]),
            percent(shares[region, "hyrl"]),
            note,
        )
        for region in regions
    ]


# ---- stages, settings, commands


def _stages(
    run: Run, robustness: Mapping[str, Any] | None, arcs: Arcs | None
) -> list[tuple[str, str]]:
    """What each stage has found, in a sentence."""
    task, s, modes = run.task, run.settings, run.extended_sets.modes
    reach = "; ".join(f"mode {task.mode_name(q)}: {extent(run, q)}" for q in modes)
    each = f"up to {s.stage6.attempts} times " if s.stage6.attempts > 1 else ""
    if isinstance(s.stage1, Agent):
        first = f"none: {s.stage1} was given"
    else:
        assert isinstance(run.policy, MlpPolicy)
        size = sum(weight.size for weight in run.policy.weights.values())
        first = f"{s.stage1.title}, {s.stage1.samples:,} samples, no noise: {size:,} weights"
    return [
        ("train", first),
        ("critical-set", run.critical_set.sentence(task)),
        ("partition", run.partition.sentence(task)),
        ("extended-sets", f"{run.extended_sets.sentence(task)}; {reach}"),
        (
            "retrain",
            f"a policy for each of {len(modes)} modes: {s.stage6.title}, "
            f"{each}{s.stage6.samples:,} samples",
        ),
        ("robustness", "not done" if robustness is None else robustness_sentence(robustness)),
        ("simulate", "not done" if arcs is None else replay_sentence(run, arcs)),
    ]


def _settings(settings: Settings) -> list[tuple[str, str]]:
    """All settings but those of the two trainings."""
    return [
        (_words(name), _value(value))
        for name, value in vars(settings).items()
        if not isinstance(value, Training | Agent)
    ]


def _training(settings: Settings) -> list[tuple[str, str, str]]:
    """The settings of the trainings of stages 1 and 6, side by side; an agent has its own."""
    first, sixth = (
        vars(stage) | (stage.options if isinstance(stage, Training) else {})
        for stage in (settings.stage1, settings.stage6)
    )
    return [
        (
            _words(name),
            _value(first[name]) if name in first else "",
            _value(sixth[name]) if name in sixth else "",
        )
        for name in first | sixth
        if name != "options"
    ]


def _words(name: str) -> str:
    return name.replace("_", " ")


def _value(value: object) -> str:
    """A setting for people."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return "by default" if value is None else f"{value}"


def _commands(settings: Settings, robustness: Mapping[str, Any] | None) -> list[str]:
    """What to type to repeat the run, and the examination if it was another than the run's own."""
    s = settings
    commands = [beginning(settings)]
    if robustness and (
        robustness["episodes"] or robustness["everywhere"] or robustness["eps"] != s.noise
    ):
        commands.append(_examination(robustness))
    return commands


def beginning(settings: Settings, out: Path | None = None) -> str:
    """What begins such a run, or goes on with it: a command, or a call where the agent is no file."""
    s, agent = settings, settings.stage1 if isinstance(settings.stage1, Agent) else None
    if agent and not agent.source:
        rest = "" if s.horizon is None else f", horizon={s.horizon}"
        rest += "" if out is None else f", out={str(out)!r}"
        return (
            f"hyrl_mj.robustify({s.task!r}, policy, noise={s.noise}, seed={s.seed}, "
            f"preset_name={s.preset!r}{rest})"
        )
    words = ["hyrl-mj", *(["robustify", s.task, *agent.options] if agent else ["run", s.task])]
    words += ["--noise", f"{s.noise}", "--seed", f"{s.seed}", "--preset", s.preset]
    if not agent and s.stage1.algorithm != get_task(s.task).algorithm:
        words += ["--algorithm", s.stage1.algorithm]
    if s.horizon is not None:
        words += ["--horizon", f"{s.horizon}"]
    if out is not None:
        words += ["--out", f"{out}"]
    return shlex.join(words)


def _examination(robustness: Mapping[str, Any]) -> str:
    command = ["hyrl-mj", "robustness", "RUN", "--eps", f"{robustness['eps']}"]
    if robustness["everywhere"]:
        command.append("--all-coordinates")
    records = robustness["episodes"]
    if records:
        kinds = list(dict.fromkeys(r["noise"] for r in records))
        one = [r for r in records if (r["noise"], r["controller"]) == (kinds[0], "hyrl")]
        command += ["--episodes", f"{sum(r['episodes'] for r in one)}", "--noise", ",".join(kinds)]
        if "seed" in robustness:  # older files do not tell
            command += ["--seed", f"{robustness['seed']}"]
    return shlex.join(command)


def _changed(run: Run) -> list[str]:
    """Settings that the command would not give again: those of a preset of another version."""
    s = run.settings
    again = preset(
        run.task, s.preset, noise=s.noise, seed=s.seed, horizon=s.horizon, agent=run.agent
    ).to_json()
    return [_words(name) for name, value in s.to_json().items() if value != again[name]]
