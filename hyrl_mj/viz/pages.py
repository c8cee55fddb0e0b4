"""What pages share: their template and parts, with pictures and videos as data URIs."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from PIL import Image

from hyrl_mj.files import artifacts
from hyrl_mj.viz.figures import FIGURES, style
from hyrl_mj.viz.tables import Table, markdown

# The largest picture and video that a page shows [bytes]: there they take several times the memory.
PICTURE, VIDEO = 2**22, 2**25


@dataclass(frozen=True)
class Picture:
    """A PNG: its name, the file, size [pixels] and caption; of a poster also the file of the video."""

    name: str
    content: bytes
    width: int
    height: int
    caption: str
    film: bytes = b""

    @property
    def data(self) -> str:
        """The picture as a data URI."""
        return f"data:image/png;base64,{b64encode(self.content).decode()}"

    @property
    def video(self) -> str:
        """The video as a data URI, "" if there is none."""
        return f"data:video/mp4;base64,{b64encode(self.film).decode()}" if self.film else ""


# What a section of a page consists of: strings are HTML, and sequences of them become a list.
Part = Table | Picture | Markup | Sequence[str]
Section = tuple[str, Sequence[Part]]


def write(path: Path, text: str) -> None:
    """Writes a page, whole or not at all."""
    with artifacts.replacing(path) as temporary:
        # The name of a folder may have bytes that are no characters.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def fill(template: str = "page.html", **values: Any) -> str:
    """Returns a page from its template, which escapes what it fills in.

    A page has a `heading` for the browser, a `title`, a `subtitle`, and what its template asks for, which by
    default are `sections`.
    """
    environment = Environment(
        loader=PackageLoader("hyrl_mj.viz"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["missing"] = missing
    return environment.get_template(template).render(**values)


def name_of(folder: Path) -> str:
    """Returns the name of a folder; one that is not Unicode must not keep a page from being written."""
    return os.fsencode(folder.resolve().name).decode("utf-8", "replace")


# ---- parts of a page


def paragraph(text: str) -> Markup:
    """Returns a paragraph."""
    return Markup("<p>{}</p>").format(text)


def missing(what: str, cure: str = "") -> Markup:
    """Returns a paragraph about what is missing, and the command that cures it."""
    command = Markup(" <code>{}</code>").format(cure) if cure else ""
    return Markup('<p class="missing">{}{}</p>').format(what, command)


def code(text: str) -> Markup:
    """Returns text as it stands."""
    return Markup("<pre><code>{}</code></pre>").format(text)


def to_paste(table: Table) -> Section:
    """Returns a section with a table as Markdown."""
    return "To paste as Markdown", [code(markdown(table))]


def as_picture(name: str, figure: Figure, caption: str) -> Picture:
    """Returns a figure as a picture of a page."""
    content = BytesIO()
    style.save(figure, content)
    with Image.open(content) as image:
        return Picture(name, content.getvalue(), *image.size, caption)


def film(
    path: Path, name: str, caption: str, has: Callable[[Path], bool] = Path.is_file
) -> Picture | None:
    """Returns the poster of a replay with its video, or None unless both files can be shown."""
    poster = path.with_suffix(".png")
    if not (_fits(path, VIDEO, has) and _fits(poster, PICTURE, has)):
        return None
    return _picture(poster, name, caption, path.read_bytes())


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


def _picture(path: Path, name: str, caption: str, film: bytes = b"") -> Picture:
    with artifacts.reading(path), Image.open(path, formats=("PNG",)) as image:
        image.verify()
        return Picture(name, path.read_bytes(), *image.size, caption, film)
