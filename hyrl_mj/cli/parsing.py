"""From the words of a command line to a call of a function, with help from its docstring.

Keyword-only parameters are options, the others are positional, and a parameter that is a frozen dataclass
stands for an option per field. An entry of the docstring ends in "; by default ..." if None has a meaning.

tyro collects the words and lays out the help. It does not read the values, because it answers a mistake with
a box of several lines, and shows Python's types and None.
"""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.runs.directory import Run, load_run
from hyrl_mj.runs.sweeps import MOST_RUNS


@dataclass(frozen=True)
class Kind:
    """How the values of a type are written on the command line.

    Attributes:
        metavar: stands for a value in the help.
        meaning: what to give, for errors.
        read: returns the value of a word, or raises ValueError.
        show: returns the word of a default.
        gather: returns the value of several words from what `read` returned for each; None for one word.
    """

    metavar: str
    meaning: str
    read: Callable[[str], Any]
    show: Callable[[Any], str] = str
    gather: Callable[[tuple[Any, ...]], Any] | None = None


def _size(text: str) -> tuple[int, int]:
    width, height = text.lower().split("x")
    return int(width), int(height)


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ValueError(text)
    return names


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split(",")))


def _integers(text: str) -> tuple[int, ...]:
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        more = range(int(first), int(last if dash else first) + 1)
        if not 0 < len(more) <= MOST_RUNS:
            raise ValueError(text)
        found += more
    return tuple(found)


def _change(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise ValueError(text)
    return name.strip(), value.strip()


def _changes(parts: tuple[tuple[str, str], ...]) -> dict[str, str]:
    if len(dict(parts)) < len(parts):
        raise ValueError(parts)
    return dict(parts)


def _joined(parts: tuple[tuple[Any, ...], ...]) -> tuple[Any, ...]:
    return tuple(chain(*parts))


FLAG = Kind("", "no value", bool, lambda default: "off")
RUN = Kind("RUN", "a run directory", Path)
NAMES = Kind("NAME,...", "names, separated by commas", _names, ",".join)
KINDS: dict[Any, Kind] = {
    bool: FLAG,
    str: Kind("NAME", "a name", str),
    int: Kind("INTEGER", "an integer", int),
    float: Kind("NUMBER", "a number", float, "{:g}".format),
    Path: Kind("PATH", "a path", Path),
    str | Path: Kind("PATH", "a path", Path),
    Run: RUN,
    tuple[float, ...]: Kind(
        "NUMBER ...", "one or more numbers", _numbers, "{0[0]:g}".format, _joined
    ),
    tuple[int, ...]: Kind(
        "INTEGER,...",
        f"integers or rising ranges, at most {MOST_RUNS:,} in all, as 0-9 or 0,3,7-9",
        _integers,
        "{0[0]}".format,
    ),
    tuple[str, ...]: NAMES,
    dict[str, Any]: Kind("NAME=VALUE ...", "NAME=VALUE, each NAME once", _change, str, _changes),
    tuple[int, int]: Kind(
        "WIDTHxHEIGHT", "WIDTHxHEIGHT in pixels, as 640x480", _size, "{0[0]}x{0[1]}".format
    ),
}


@dataclass(frozen=True)
class Argument:
    """One argument of a command.

    Attributes:
        name: of a parameter of the function, or of a field of its options.
        kind: how its values are written.
        default: or `MISSING`.
        text: its entry in the docstring.
        positional: whether it has no `--name`.
    """

    name: str
    kind: Kind
    default: Any
    text: str
    positional: bool

    @property
    def title(self) -> str:
        """The name on the command line: "--slow-motion", or "TASK"."""
        return self.name.upper() if self.positional else f"--{self.name.replace('_', '-')}"

    def field(self, helping: bool) -> tuple[str, Any, Any]:
        """Returns name, type and default of a field for which tyro collects the words, unread.

        tyro marks required arguments in its help; `call` has the better sentence when one is missing.
        """
        text, _, by_default = self.text.rstrip(".").partition("; by default ")
        required = self.default is MISSING
        # Python leaves the texts out if it is asked to, as by PYTHONOPTIMIZE=2.
        usual = by_default or ("none" if self.default is None else self.kind.show(self.default))
        hint = "required" if required else f"default: {usual}"
        shown = tyro.conf.arg(help=f"{text}.", help_behavior_hint=f"({hint})")
        if self.kind is FLAG:
            return self.name, Annotated[bool, shown], False
        words = tyro.constructors.PrimitiveConstructorSpec[Any](
            nargs="*" if self.kind.gather else 1,
            metavar=self.title if self.positional else self.kind.metavar,
            instance_from_str=list,
            is_instance=lambda value: True,
            str_from_instance=lambda value: [],
        )
        place = (tyro.conf.Positional,) if self.positional else ()
        default = MISSING if helping and required else None
        return self.name, Annotated[(Any, words, shown, *place)], field(default=default)

    def read(self, words: Sequence[str]) -> Any:
        """Returns the value of its words, or raises `BadInput`."""
        try:
            values = tuple(map(self.kind.read, words))
            return self.kind.gather(values) if self.kind.gather else values[0]
        except BadInput:
            raise
        except ValueError:
            wrong = f"{self.title} {shlex.join(words)!r}"
            raise BadInput(f"{wrong} cannot be used: give {self.kind.meaning}") from None


def documented(thing: Any) -> tuple[str, dict[str, str]]:
    """Returns the description in a docstring, and its entries by argument or attribute."""
    text = inspect.getdoc(thing) or ""
    description = re.split(r"\n\n(?:Args|Attributes|Raises|Returns):\n", text)[0]
    paragraphs = [" ".join(paragraph.split()) for paragraph in description.split("\n\n")]
    entries = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", text, re.MULTILINE)
    return "\n\n".join(paragraphs), {name: " ".join(entry.split()) for name, entry in entries}


def arguments(function: Callable[..., Any], inside: bool = False) -> Iterator[Argument]:
    """Yields the arguments of a command, in the order of its parameters.

    `inside` an options parameter, the function is its dataclass, and all arguments are options.
    """
    types, texts = get_type_hints(function), documented(function)[1]
    for name, parameter in inspect.signature(function).parameters.items():
        if _has_options(types[name]):
            yield from arguments(types[name], inside=True)
            continue
        kind = next(KINDS[kind] for kind in KINDS if types[name] in (kind, kind | None))
        default = MISSING if parameter.default is parameter.empty else parameter.default
        positional = not inside and parameter.kind is not parameter.KEYWORD_ONLY
        if positional and kind is NAMES:
            kind = replace(kind, gather=_joined)
        yield Argument(name, kind, default, texts.get(name) or kind.meaning, positional)


def _has_options(kind: Any) -> bool:
    return is_dataclass(kind) and kind not in KINDS


def call(function: Callable[..., None], name: str, words: Sequence[str]) -> None:
    """Calls the function of a command with the words that a user types after "hyrl-mj" and its name.

    Raises:
        BadInput: the words cannot be used.
    """
    every = [*arguments(function)]
    opens_run = any(argument.kind is RUN for argument in every)
    if opens_run:
        text = "the Python file of the run's task, which is executed; by default only a file that you have "
        every.append(Argument("task", KINDS[Path], None, f"{text}run before", positional=False))
    options = {argument.title: argument for argument in every if not argument.positional}
    titles = [word.partition("=")[0].replace("_", "-") for word in words]
    for (word, following), title in zip(pairwise([*words, "--"]), titles, strict=True):
        option = options.get(title)
        is_option = re.match(r"-[^\d.]", following)  # numbers may be negative
        if option and option.kind is not FLAG and "=" not in word and is_option:
            raise BadInput(f"{word} needs a value: give {option.kind.meaning}")
        if option and option.kind.gather and titles.count(title) > 1:
            raise BadInput(
                f"{title} is given twice: give it once, with {option.kind.meaning} after it"
            )
    helping = "-h" in words or "--help" in words
    parsed: Any
    parsed, rest = tyro.cli(
        make_dataclass("Words", [argument.field(helping) for argument in every], kw_only=True),
        prog=f"hyrl-mj {name}\n ",  # the options begin in a line of their own
        description=documented(function)[0],
        args=words,
        return_unknown_args=True,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    if rest:
        title = rest[0].partition("=")[0]
        if title.startswith("-"):
            raise unknown("option", title, [*options, "--help"])
        raise BadInput(f"{name} has no use for {rest[0]!r}: see hyrl-mj {name} --help")
    keywords: dict[str, Any] = {}
    for argument in every:
        typed = getattr(parsed, argument.name)
        if typed:
            keywords[argument.name] = typed if typed is True else argument.read(typed)
        elif argument.default is MISSING:
            raise BadInput(f"{name} needs {argument.title}: {argument.text}")
    if opens_run:
        keywords["run"] = load_run(keywords["run"], task=keywords.pop("task", None))
    for parameter, kind in get_type_hints(function).items():
        if _has_options(kind):
            inside = [option.name for option in fields(kind) if option.name in keywords]
            keywords[parameter] = kind(**{option: keywords.pop(option) for option in inside})
    function(**keywords)
