"""From the words of a command line to a call: help, types, defaults and mistakes in plain language.

`call` makes a command of a function. Keyword-only parameters are options, the others are given by their
place, and a parameter that is a frozen dataclass stands for an option per field. Help is what the docstrings
say of parameters and fields; the end of an entry, "; by default ...", says what None stands for.
"""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from functools import reduce
from itertools import pairwise
from operator import or_
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_type_hints

import tyro

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.run_directory import Run, load_run


@dataclass(frozen=True)
class Kind:
    """How the values of a type are written on the command line.

    Attributes:
        metavar: what stands for a value in the help.
        meaning: what to give, in an error.
        read: makes the value of a word, or raises ValueError.
        show: makes the word of a default.
    """

    metavar: str
    meaning: str
    read: Callable[[str], Any]
    show: Callable[[Any], str] = str


def _size(text: str) -> tuple[int, int]:
    width, height = text.lower().split("x")
    return int(width), int(height)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


KINDS: dict[Any, Kind] = {
    str: Kind("NAME", "a name", str),
    int: Kind("INTEGER", "an integer", int),
    float: Kind("NUMBER", "a number", float, "{:g}".format),
    Path: Kind("PATH", "a path", Path),
    str | Path: Kind("PATH", "a path", Path),
    Run: Kind("RUN", "a run directory", load_run),
    tuple[float, ...]: Kind("NUMBER ...", "one or more numbers", float),
    tuple[str, ...]: Kind("NAME,...", "names, separated by commas", _names, ",".join),
    tuple[int, int]: Kind(
        "WIDTHxHEIGHT",
        "WIDTHxHEIGHT in pixels, as 640x480",
        _size,
        lambda size: "x".join(map(str, size)),
    ),
}
SEVERAL = tuple[float, ...]  # the type that takes several words
BY_DEFAULT = "; by default "


@dataclass(frozen=True)
class Argument:
    """One argument of a command.

    Attributes:
        parameter: the parameter of the function that it is, or a field of.
        name: of the parameter or the field.
        type: its type, without None.
        default: its default, or `MISSING`.
        text: what its docstring says.
        positional: whether it is given by its place.
    """

    parameter: str
    name: str
    type: Any
    default: Any
    text: str
    positional: bool

    @property
    def title(self) -> str:
        """How the user sees it: "--slow-motion", or "TASK"."""
        return self.name.upper() if self.positional else f"--{self.name.replace('_', '-')}"

    @property
    def hint(self) -> str:
        """What the help says of its default."""
        if self.default is MISSING:
            return "(required)"
        if self.type is bool:
            return "(default: off)"
        described = self.text.partition(BY_DEFAULT)[2].rstrip(".")
        return f"(default: {described or KINDS[self.type].show(self.default)})"

    def field(self, helping: bool) -> tuple[str, Any, Any]:
        """Returns name, type and default of a field for which tyro collects the words, unread.

        Only for its help tyro is told what is required: `call` has the better sentence.
        """
        help_text = self.text.partition(BY_DEFAULT)[0].rstrip(".") + "."
        if self.type is bool:
            shown = tyro.conf.arg(help=help_text, help_behavior_hint=self.hint)
            return self.name, Annotated[bool, shown], False
        metavar = self.title if self.positional else KINDS[self.type].metavar
        shown = tyro.conf.arg(metavar=metavar, help=help_text, help_behavior_hint=self.hint)
        words = tyro.constructors.PrimitiveConstructorSpec[Any](
            nargs="*" if self.type == SEVERAL else 1,
            metavar=metavar,
            instance_from_str=list,
            is_instance=lambda value: True,
            str_from_instance=lambda value: [],
        )
        marks = (tyro.conf.Positional,) if self.positional else ()
        annotated = Annotated[(Any, words, shown, *marks)]
        required = helping and self.default is MISSING
        return self.name, annotated, field(default=MISSING if required else None)

    def read(self, words: Sequence[str]) -> Any:
        """Returns the value of its words.

        Raises:
            BadInput: they are of another type.
        """
        kind = KINDS[self.type]
        try:
            values = tuple(map(kind.read, words))
        except BadInput:
            raise
        except ValueError:
            value = shlex.join(words)
            raise BadInput(f"{self.title} {value!r} cannot be used: give {kind.meaning}") from None
        return values if self.type == SEVERAL else values[0]


def documented(thing: Any) -> tuple[str, dict[str, str]]:
    """Returns the description in a docstring, and what it says of each argument or attribute."""
    text = inspect.getdoc(thing) or ""
    description = re.split(r"\n\n(?:Args|Attributes|Raises|Returns):\n", text)[0]
    paragraphs = [" ".join(paragraph.split()) for paragraph in description.split("\n\n")]
    entries = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", text, re.MULTILINE)
    return "\n\n".join(paragraphs), {name: " ".join(entry.split()) for name, entry in entries}


def arguments(function: Callable[..., None]) -> Iterator[Argument]:
    """Yields the arguments of a command, in the order of its parameters."""
    types, texts = get_type_hints(function), documented(function)[1]
    for parameter in inspect.signature(function).parameters.values():
        name, kind = parameter.name, types[parameter.name]
        if _has_options(kind):
            inner, inner_texts = get_type_hints(kind), documented(kind)[1]
            for option in fields(kind):
                of_type, text = _given(inner[option.name]), inner_texts[option.name]
                yield Argument(name, option.name, of_type, option.default, text, False)
        else:
            default = MISSING if parameter.default is parameter.empty else parameter.default
            kind, positional = _given(kind), parameter.kind is not parameter.KEYWORD_ONLY
            text = texts.get(name) or KINDS[kind].meaning
            yield Argument(name, name, kind, default, text, positional)


def _given(kind: Any) -> Any:
    """Returns a type without None."""
    kinds = [option for option in get_args(kind) if option is not NoneType]
    return reduce(or_, kinds) if NoneType in get_args(kind) else kind


def call(
    function: Callable[..., None],
    name: str,
    words: Sequence[str],
    renamed: Mapping[str, str],
) -> None:
    """Call the function of a command with the words of a user.

    Args:
        function: the command.
        name: the name of the command, which follows "hyrl-mj".
        words: what the user types after it.
        renamed: options that the command no longer has, and what they are called now.

    Raises:
        BadInput: the words cannot be used.
    """
    every = [*arguments(function)]
    options = {argument.title: argument for argument in every if not argument.positional}
    for word, following in pairwise([*words, "--"]):
        option = options.get(word.replace("_", "-"))
        if option and option.type is not bool and following.startswith("--"):
            raise BadInput(f"{word} needs a value: give {KINDS[option.type].meaning}")
    helping = "-h" in words or "--help" in words
    parsed: Any
    parsed, rest = tyro.cli(
        make_dataclass("Words", [argument.field(helping) for argument in every], kw_only=True),
        prog=f"hyrl-mj {name}",
        description=documented(function)[0],
        args=words,
        return_unknown_args=True,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    if rest:
        raise _unexpected(rest[0], name, words, options, renamed)
    values: dict[str, dict[str, Any]] = {}
    for argument in every:
        said = getattr(parsed, argument.name)
        if said:
            value = said if argument.type is bool else argument.read(said)
            values.setdefault(argument.parameter, {})[argument.name] = value
        elif argument.default is MISSING:
            raise BadInput(f"{name} needs {argument.title}: {argument.text}")
    types = get_type_hints(function)
    keywords: dict[str, Any] = {}
    for parameter in inspect.signature(function).parameters:
        inner, kind = values.get(parameter, {}), types[parameter]
        keywords |= {parameter: kind(**inner)} if _has_options(kind) else inner
    function(**keywords)


def _has_options(kind: Any) -> bool:
    """Returns whether a type stands for an option per field."""
    return is_dataclass(kind) and kind not in KINDS


def _unexpected(
    word: str, name: str, words: Sequence[str], options: Iterable[str], renamed: Mapping[str, str]
) -> BadInput:
    """Returns the error for a word that the command of this name has no use for."""
    option = word.partition("=")[0]
    if option in renamed:
        new = renamed[option]
        again = [new + w[len(option) :] if w.partition("=")[0] == option else w for w in words]
        return BadInput(f"{option} is now called {new}: hyrl-mj {name} {shlex.join(again)}")
    if option.startswith("-"):
        return unknown("option", option, [*options, "--help"])
    return BadInput(f"{name} has no use for {word!r}: see hyrl-mj {name} --help")
