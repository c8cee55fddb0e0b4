"""From words to calls: every command's help is readable, and every mistake is one sentence."""

import re
from dataclasses import MISSING, dataclass
from pathlib import Path

import pytest

from hyrl_mj import __version__, cli
from hyrl_mj.cli.parsing import arguments, call, documented
from hyrl_mj.errors import BadInput


@dataclass(frozen=True)
class Colour:
    """A colour.

    Attributes:
        hue: which of the colours of the rainbow, as seen by the
            3 kinds of cones; by default the last one.
        strength: how strong.
        bright: bright instead of dark.
    """

    hue: str | None = None
    strength: float = 1.0
    bright: bool = False


def paint(
    wall: str,
    *,
    count: int = 3,
    points: tuple[float, ...] | None = None,
    size: tuple[int, int] = (640, 480),
    into: str | Path | None = None,
    layers: tuple[str, ...] = ("base",),
    who: Path,
    colour: Colour,
) -> None:
    """Paint a wall.

    It takes
    a while.

    Args:
        wall: the wall.
        count: how often.
        points: where; by default everywhere.
        size: how large.
        into: the folder; by default this one.
        layers: what is painted first.
        who: the painter.
    """
    CALLS.append({name: value for name, value in locals().items() if value is not None})


CALLS = []
KNOWN = "--count, --points, --size, --into, --layers, --who, --hue, --strength, --bright, --help"
DEFAULTS = {"count": 3, "size": (640, 480), "layers": ("base",), "colour": Colour()}


def painted(text):
    """What `paint` is called with."""
    CALLS.clear()
    call(paint, "paint", text.split())
    (only,) = CALLS
    return only


def helped(command, name, width, monkeypatch, capsys):
    """The help of a command in so many columns."""
    monkeypatch.setenv("COLUMNS", str(width))
    with pytest.raises(SystemExit) as ended:
        call(command, name, ["--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


# ---- what is said


def test_only_what_is_said_differs_from_the_defaults():
    assert painted("north --who me") == DEFAULTS | {"wall": "north", "who": Path("me")}
    said = painted(
        "--who=me --points -1 0.5 --size 8X6 --into a/b --layers x,y --hue red north --bright --count -2"
    )
    assert said == {
        "wall": "north",
        "who": Path("me"),
        "count": -2,
        "points": (-1.0, 0.5),
        "size": (8, 6),
        "into": Path("a/b"),
        "layers": ("x", "y"),
        "colour": Colour("red", bright=True),
    }


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "paint needs WALL: the wall."),
        ("north", "paint needs --who: the painter."),
        ("north --who", "--who needs a value: give a path"),
        ("north --who --bright", "--who needs a value: give a path"),
        ("north --who me --points", "--points needs a value: give one or more numbers"),
        ("north --who me --points 1 x", "--points '1 x' cannot be used: give one or more numbers"),
        ("north --who me --count 1.5", "--count '1.5' cannot be used: give an integer"),
        ("north --who me --strength much", "--strength 'much' cannot be used: give a number"),
        ("north --who me --size 640", "--size '640' cannot be used: give WIDTHxHEIGHT in pixels, as 640x480"),
        ("north south --who me", "paint has no use for 'south': see hyrl-mj paint --help"),
        ("north --who me --bright yes", "paint has no use for 'yes': see hyrl-mj paint --help"),
        ("north --who me --hew red", f"unknown option '--hew': choose one of {KNOWN}. Did you mean '--hue'?"),
        ("north --who me -c 3", f"unknown option '-c': choose one of {KNOWN}."),
    ],
)  # fmt: skip
def test_a_mistake_is_one_sentence(text, sentence, capsys):
    with pytest.raises(BadInput) as refused:
        painted(text)
    assert str(refused.value) == sentence
    assert capsys.readouterr() == ("", ""), "it is for the caller to say it"


# ---- help


def test_help_shows_types_and_defaults(monkeypatch, capsys):
    text = helped(paint, "paint", 120, monkeypatch, capsys)
    assert "usage: hyrl-mj paint\n  [-h] [OPTIONS]" in text
    assert "It takes a while." in text
    rows = [" ".join(line.strip("│ ").split()) for line in text.splitlines()]
    assert set(rows) >= {
        "WALL the wall. (required)",
        "--count INTEGER how often. (default: 3)",
        "--points NUMBER ... where. (default: everywhere)",
        "--size WIDTHxHEIGHT how large. (default: 640x480)",
        "--into PATH the folder. (default: this one)",
        "--layers NAME,... what is painted first. (default: base)",
        "--who PATH the painter. (required)",
        "--strength NUMBER how strong. (default: 1)",
        "--bright bright instead of dark. (default: off)",
    }
    assert "as seen by the 3 kinds of cones. (default: the last one)" in " ".join(rows)


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_can_be_read(name, width, monkeypatch, capsys):
    text = helped(cli.COMMANDS[name], name, width, monkeypatch, capsys)
    assert f"usage: hyrl-mj {name}" in text
    assert not re.search(r"None|True|False|\bSTR\b|\{|`None`", text)
    assert max(map(len, text.splitlines())) <= width
    for argument in arguments(cli.COMMANDS[name]):
        assert argument.title in text
        assert argument.text
        if argument.default in (None, ()):
            assert "; by default " in argument.text, f"what is {argument.title} by default?"
        assert argument.default is not MISSING or "(required)" in text
        assert argument.default is not MISSING or f"[{argument.title}" not in text


def test_the_overview_has_every_command_in_a_line_or_two(capsys):
    cli.dispatch(["--help"])
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    for name, command in cli.COMMANDS.items():
        assert re.search(rf"^  {name} +\w", text, re.MULTILINE)
        assert documented(command)[0].split()[0] in text


def test_the_version_is_said(capsys):
    cli.dispatch(["--version"])
    assert capsys.readouterr().out == f"hyrl-mj {__version__}\n"


# ---- commands


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("", ["give a command, one of list, new-task, run"]),
        ("traim", ["unknown command 'traim'", "Did you mean 'train'?"]),
        ("run vehicle --nose 0.2", ["unknown option '--nose'", "--noise"]),
        ("run", ["give a TASK, see hyrl-mj list"]),
        ("train", ["train needs RUN: a run directory"]),
    ],
)  # fmt: skip
def test_what_people_mistype(words, parts):
    with pytest.raises(BadInput) as refused:
        cli.dispatch(words.split())
    assert [part for part in parts if part not in str(refused.value)] == []
