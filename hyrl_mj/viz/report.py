"""The report of all results of a run, and what its pages share: pictures and videos as data URIs."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from hyrl_mj.errors import BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.judging import POLICIES, listed
from hyrl_mj.judging.game import MapClass, Robustness
from hyrl_mj.learning import Training
from hyrl_mj.policies import Agent, MlpPolicy
from hyrl_mj.runs.arcs import attack_replay
from hyrl_mj.runs.directory import Run
from hyrl_mj.viz import tables
from hyrl_mj.viz.commands import changed, commands
from hyrl_mj.viz.figures import CLASS_COLOURS, FIGURES
from hyrl_mj.viz.figures.style import task_title

# The largest picture and video that a page shows [bytes]: there they take several times the memory.
PICTURE, VIDEO = 2**22, 2**25


@dataclass(frozen=True)
class Picture:
    """A PNG: its name, the file as a data URI, size [pixels] and caption; of a poster also the video."""

    name: str
    data: str
    width: int
    height: int
    caption: str
    video: str = ""


def write_report(run: Run, path: Path) -> None:
    """Writes the page; where a result is missing the page says how to get it.

    The same artifacts give the same bytes.

    Raises:
        BadArtifact: the hybrid controller is not finished, or a file is damaged.
        BadInput: the path is no html, or cannot be written.
    """
    if path.suffix != ".html":
        raise BadInput(f"a report is an html, {path} is not: give a name that ends in .html")
    write(path, render(run))


def render(run: Run) -> str:
    """Returns the page as HTML."""
    task = run.task
    has = run.manifest.has
    robustness = run.robustness if has(run.path / "robustness.json") else None
    arcs = run.arcs() if all(map(has, run.arc_paths().values())) else None
    facts = [run.path / name for name in ("arrivals.json", "retraining.json")]
    stages = run.settings.stage1, run.settings.stage6
    options = [stage.options if isinstance(stage, Training) else {} for stage in stages]
    first, sixth = (_texts(vars(s) | more) for s, more in zip(stages, options, strict=True))
    return fill(
        "report.html",
        run.path,
        **about(run, robustness),
        modes=[task.mode_name(q) for q in run.controller.modes],
        listed=listed,
        worst=task.noise_on(bool(robustness and robustness.everywhere)),
        video=film(run.path / "replay.mp4", has),
        pictures=pictures(run.path / "figures", has),
        arrivals={who: tables.arrivals(run, arcs, who == "policy") for who in ("policy", "hyrl")}
        if arcs
        else None,
        attacked=bool(attack_replay(run)),
        verdict=run.verdict if robustness and all(map(has, facts)) else None,
        replays=arcs and tables.replay_table(run, arcs),
        stages=_stages(run, robustness, arcs),
        table=_texts(vars(run.settings)),
        training=[(name, first.get(name, ""), sixth.get(name, "")) for name in first | sixth],
        commands=commands(run, robustness),
        changed=changed(run),
        classes=[(c.label, colour) for c, colour in zip(MapClass, CLASS_COLOURS, strict=True)],
    )


# ---- stages and settings


def _stages(
    run: Run, robustness: Robustness | None, arcs: tables.Arcs | None
) -> list[tuple[str, str]]:
    """Returns the result of each stage in a sentence."""
    task, s, modes = run.task, run.settings, run.extended_sets.modes
    reach = "; ".join(f"mode {task.mode_name(q)}: {tables.extent(run, q)}" for q in modes)
    attempts = f"up to {s.stage6.attempts} times " if s.stage6.attempts > 1 else ""
    known = run.manifest.has(run.path / "retraining.json")
    given = [r for r in run.retraining.modes if r.policy in POLICIES] if known else []
    retrained = "nothing was trained"
    if count := len(modes) - len(given):
        many = f"each of {count} modes" if not given else f"{count} of {len(modes)} modes"
        retrained = f"a policy for {many}: {s.stage6.title}, {attempts}{s.stage6.samples:,} samples"
    if isinstance(s.stage1, Agent):
        first = f"none: the agent {s.stage1} takes its place"
    else:
        assert isinstance(run.policy, MlpPolicy)
        size = sum(weight.size for weight in run.policy.weights.values())
        first = f"{s.stage1.title}, {s.stage1.samples:,} samples, no noise: {size:,} weights"
    return [
        ("train", first),
        ("critical-set", run.critical_set.sentence(task)),
        ("partition", run.partition.sentence(task, run.settings.ways)),
        ("extended-sets", f"{run.extended_sets.sentence(task)}; {reach}"),
        ("retrain", retrained),
        (
            "robustness",
            "not done" if robustness is None else tables.robustness_sentence(robustness),
        ),
        ("simulate", "not done" if arcs is None else tables.replay_sentence(run, arcs)),
    ]


def _texts(settings: Mapping[str, object]) -> dict[str, str]:
    """Returns the texts of settings by their names in words, without trainings, agents and options.

    The settings of a group stand one by one.
    """
    plain: dict[str, object] = {}
    for name, value in settings.items():
        if is_dataclass(value) and not isinstance(value, Training | Agent):
            plain |= {f"{name}: {field}": one for field, one in vars(value).items()}
        elif not isinstance(value, Training | Agent | Mapping):
            plain[name] = value
    return {name.replace("_", " "): _text(value) for name, value in plain.items()}


def _text(value: object) -> str:
    """Returns the text of a setting."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return "by default" if value is None else f"{value}"


# ---- what pages share


def write(path: Path, text: str) -> None:
    """Writes a page, whole or not at all."""
    with artifacts.replacing(path) as temporary:
        # The name of a folder may have bytes that are no characters.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def fill(template: str, folder: Path, **values: Any) -> str:
    """Returns a page from its template, which escapes what it fills in."""
    environment = Environment(
        loader=PackageLoader("hyrl_mj.viz"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # A name that is not Unicode must not keep the page from being written.
    name = os.fsencode(folder.resolve().name).decode("utf-8", "replace")
    return environment.get_template(template).render(name=name, **values)


def about(run: Run, robustness: Robustness | None) -> dict[str, Any]:
    """Returns the values that every page of a run shows."""
    return {
        "title": task_title(run.task),
        "run": run,
        "task": run.task,
        "settings": run.settings,
        "critical": run.critical_set,
        "unit": run.task.noise_on()[1],
        "tables": tables,
        "robustness": robustness,
        "game": robustness.game if robustness else None,
        "episodes": robustness.episodes if robustness else (),
    }


def film(path: Path, has: Callable[[Path], bool] = Path.is_file) -> Picture | None:
    """Returns the poster of a replay with its video, or None unless both files can be shown."""
    poster = path.with_suffix(".png")
    if not (_fits(path, VIDEO, has) and _fits(poster, PICTURE, has)):
        return None
    return replace(_picture(poster, "replay", ""), video=data_uri(path.read_bytes(), "video/mp4"))


def pictures(folder: Path, has: Callable[[Path], bool] = Path.is_file) -> list[Picture]:
    """Returns the figures in a folder that can be shown."""
    return [
        _picture(path, name.replace("_", " "), entry.caption)
        for name, entry in FIGURES.items()
        if _fits(path := folder / f"{name}.png", PICTURE, has)
    ]


def _fits(path: Path, most: int, has: Callable[[Path], bool]) -> bool:
    """Returns whether a file can be shown, and is no larger than so many bytes."""
    return has(path) and path.stat().st_size <= most


def _picture(path: Path, name: str, caption: str) -> Picture:
    with artifacts.reading(path), Image.open(path, formats=("PNG",)) as image:
        image.verify()
        return Picture(name, data_uri(path.read_bytes(), "image/png"), *image.size, caption)


def data_uri(content: bytes, kind: str) -> str:
    """Returns the content of a file as a data URI."""
    return f"data:{kind};base64,{b64encode(content).decode()}"
