"""What the pages of a run share: templates, and pictures and videos as data URIs."""

from __future__ import annotations

import os
from base64 import b64encode
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from hyrl_mj import artifacts
from hyrl_mj.game import Robustness
from hyrl_mj.run_directory import Run
from hyrl_mj.viz.figures import FIGURES
from hyrl_mj.viz.figures.style import task_title
from hyrl_mj.viz.tables import episode_table, margin_table, percent, score_table


@dataclass(frozen=True)
class Picture:
    """A PNG: its name, the file as a data URI, size [pixels] and caption, and the video that it begins."""

    name: str
    data: str
    width: int
    height: int
    caption: str
    video: str = ""


def write(path: Path, text: str) -> None:
    """Writes a page, whole or not at all."""
    with artifacts.replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def fill(template: str, run: Run, robustness: Robustness | None, **values: Any) -> str:
    """Returns a page from its template, with the values that every page of a run shows."""
    task, game = run.task, robustness.game if robustness else None
    episodes = robustness.episodes if robustness else ()
    environment = Environment(
        loader=PackageLoader("hyrl_mj"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(
        # A name that is not Unicode must not keep the page from being written.
        name=os.fsencode(run.path.resolve().name).decode("utf-8", "replace"),
        title=task_title(task),
        task=task,
        settings=run.settings,
        agent=run.agent,
        exact=run.exact,
        critical=run.critical_set,
        unit=task.noise_on()[1],
        percent=percent,
        robustness=robustness,
        game=game,
        scores=score_table(task, game) if game else None,
        margins=margin_table(task, game) if game else None,
        episodes=episode_table(task, episodes) if episodes else None,
        **values,
    )


def film(path: Path) -> Picture | None:
    """Returns the poster of a replay with its video, or None unless both files exist."""
    poster = path.with_suffix(".png")
    if not (path.is_file() and poster.is_file()):
        return None
    return replace(_picture(poster, "replay", ""), video=_data(path, "video/mp4"))


def pictures(folder: Path) -> list[Picture]:
    """Returns the figures that have been drawn into a folder."""
    return [
        _picture(path, name.replace("_", " "), entry.caption)
        for name, entry in FIGURES.items()
        if (path := folder / f"{name}.png").is_file()
    ]


def _picture(path: Path, name: str, caption: str) -> Picture:
    with artifacts.reading(path), Image.open(path, formats=("PNG",)) as image:
        image.verify()
        return Picture(name, _data(path, "image/png"), *image.size, caption)


def _data(path: Path, kind: str) -> str:
    """Returns a file as a data URI."""
    return f"data:{kind};base64,{b64encode(path.read_bytes()).decode()}"
