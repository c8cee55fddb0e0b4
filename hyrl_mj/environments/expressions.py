"""Conditions on what an environment reports at each step, such as `terminated and reward >= 1`.

An expression is text that Python's parser reads and that is never run: each node of its syntax tree has
to be one of those in this file, and becomes operations on arrays over the copies of an environment.
"""

from __future__ import annotations

import ast
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple, NoReturn

import numpy as np

from hyrl_mj.errors import BadInput

FORMS = 'terminated, truncated, reward, info["key"] and distance(a, b), with and, or, not and comparisons'
# Conditions are read by people: [characters], and levels of brackets and operators, where Python's stack is
# far from its end.
LENGTH, DEPTH = 1000, 50
PLACE = re.compile(r"[\w.-]+")  # a name in a model that need not be quoted
# What a part of an expression is. An entry of `info` is a number, or true or false.
CONSTANT, NUMBER, TRUTH, ENTRY = "constant", "number", "truth", "entry"
NAMES = {"terminated": TRUTH, "truncated": TRUTH, "reward": NUMBER}

Values = Mapping[Any, np.ndarray]
Path = tuple[str | int, ...]


class Part(NamedTuple):
    """A part of an expression: its text, what it is, and its values (k,) for what k copies report."""

    text: str
    kind: str
    of: Callable[[Values], Any]


OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater, ast.GtE: np.greater_equal,
    # As every comparison false where a value is missing.
    ast.Eq: np.equal, ast.NotEq: lambda a, b: np.less(a, b) | np.greater(a, b),
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide,
    ast.And: np.logical_and, ast.Or: np.logical_or, ast.USub: np.negative, ast.UAdd: np.positive,
}  # fmt: skip


@dataclass(frozen=True)
class Expression:
    """A condition on what an environment reports after a step; `parse` makes one.

    What `info` does not hold at a step is missing (NaN): it is false, and so is every comparison with it.

    Attributes:
        text: the expression, as the user gives it.
        what: what it decides, as messages call it.
        keys: the entries of `info` that it needs, as paths: `info["a"][0]` is ("a", 0).
        places: the pairs of names in the model whose distance it needs.
    """

    text: str
    what: str
    keys: tuple[Path, ...]
    places: tuple[tuple[str, str], ...]
    _rule: Callable[[Values], np.ndarray] = field(repr=False, compare=False)

    @classmethod
    def parse(cls, text: str, what: str = "success") -> Expression:
        """Returns the expression that a text is.

        Args:
            text: Python's syntax, with `terminated`, `truncated`, `reward`, `info["key"]`, `distance(a, b)`,
                `abs(x)`, numbers, + - * /, comparisons, `and`, `or` and `not`.
            what: what it decides, for messages.

        Raises:
            BadInput: it is no expression, has other parts, or is neither true nor false.
        """
        reader = _Reader(text, what)
        rule = reader.truth(reader.tree(), 0)
        needed = list(reader.needed)
        if not needed:
            reader.refuse(f"it asks nothing of the environment: use {FORMS}")
        keys = tuple(name[1] for name in needed if name[0] == "info")
        return cls(text, what, keys, tuple(name[1:] for name in needed if len(name) == 3), rule)

    def holds(self, values: Values) -> np.ndarray:
        """Returns where the expression holds, (k,) bool.

        Args:
            values: what k copies report, arrays (k,): "terminated", "truncated", "reward"; for each of `keys`
                ("info", path), NaN where missing; for each of `places` ("distance", a, b), in metres.

        Raises:
            BadInput: an entry of `info` that has to be true or false is another number.
        """
        with np.errstate(all="ignore"):  # what is not finite is made missing
            return np.asarray(self._rule(values), dtype=bool)


def entry(info: Mapping[str, Any], path: Path) -> float:
    """Returns an entry of `info` as a number: 1 and 0 for true and false, NaN where there is none.

    Raises:
        BadInput: it is neither a number nor true or false, or lies in something that has no such entries.
    """
    value: Any = info
    for depth, step in enumerate(path):
        listed = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes)
        if isinstance(value, Mapping):
            value = value.get(step)
        elif listed and isinstance(step, int):
            value = value[step] if -len(value) <= step < len(value) else None
        else:
            what = f"is of type {type(value).__name__}: it has no entry {step!r}"
            raise BadInput(f"{_written(path[:depth])} {what}")
        if value is None:
            return math.nan
    if isinstance(value, bool | int | float):  # nearly all are
        return float(value)
    if (
        not isinstance(value, np.generic | np.ndarray)
        or value.size != 1
        or value.dtype.kind not in "biuf"
    ):
        raise BadInput(
            f"{_written(path)} is of type {type(value).__name__}: use an entry that is one number, or true "
            "or false"
        )
    return float(value.item())


def _written(path: Path) -> str:
    return "info" + "".join(f"[{step!r}]" for step in path)


class _Reader:
    """Translates the syntax tree of one text, and notes what it needs."""

    def __init__(self, text: str, what: str) -> None:
        if not isinstance(text, str):
            raise BadInput(
                f"{what} is of type {type(text).__name__}: give text, such as 'reward >= 1'"
            )
        self.text, self.what, self.source = text, what, text.strip()
        self.needed: dict[tuple[Any, ...], None] = {}  # in order, each once

    def refuse(self, why: str) -> NoReturn:
        raise BadInput(f"{self.what} {_short(self.text)!r} cannot be used: {why}")

    def tree(self) -> ast.expr:
        """Returns the syntax tree of the text."""
        if not self.source:
            self.refuse(f"it is empty: use {FORMS}")
        if len(self.source) > LENGTH:
            self.refuse(
                f"it has {len(self.source)} characters: give at most {LENGTH}, to be legible"
            )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # what Python's parser doubts is refused as well
                return ast.parse(self.source, mode="eval").body
        except SyntaxError as error:
            quotes = "; quote names that are no Python names" if "distance" in self.source else ""
            self.refuse(f"it is no expression ({_short(error.msg)}): use {FORMS}{quotes}")
        except (ValueError, RecursionError, MemoryError):  # null bytes, lone surrogates, nesting
            self.refuse("Python cannot read it: give a short expression without special characters")

    def truth(self, node: ast.expr, depth: int) -> Callable[[Values], np.ndarray]:
        """Returns the values of a node that has to be true or false."""
        part = self._part(node, depth)
        if part.kind == TRUTH:
            return part.of
        if part.kind != ENTRY:
            self.refuse(f"{part.text!r} is neither true nor false: compare it, as in reward >= 1")

        def told(values: Values) -> np.ndarray:
            value = np.asarray(part.of(values), dtype=float)
            odd = value[~(np.isnan(value) | (value == 0) | (value == 1))]
            if odd.size:
                self.refuse(f"{part.text} is {odd[0]:g}, neither true nor false: compare it")
            return value == 1

        return told

    def _number(self, node: ast.expr, depth: int) -> Part:
        """Returns a node that has to be a number."""
        part = self._part(node, depth)
        if part.kind == TRUTH:
            self.refuse(f"{part.text!r} is true or false, no number: join it by and, or, not")
        return part

    def _asked(self, name: tuple[Any, ...], kind: str, text: str) -> Part:
        """Returns what an environment reports under a name."""
        self.needed[name] = None
        key, dtype = name if len(name) > 1 else name[0], bool if kind == TRUTH else float
        return Part(text, kind, lambda values: np.asarray(values[key], dtype=dtype))

    def _part(self, node: ast.expr, depth: int) -> Part:
        if depth > DEPTH:
            self.refuse(f"it is nested deeper than {DEPTH} levels: write it simpler")
        text, depth = _short(self._source_of(node)), depth + 1
        match node:
            case ast.Constant():
                return self._constant(node.value, text)
            case ast.Name():
                return self._name(node.id)
            case ast.Subscript():
                return self._asked(("info", self._path(node, text)), ENTRY, text)
            case ast.Call():
                return self._call(node, text, depth)
            case ast.BoolOp():
                truths, join = (
                    [self.truth(value, depth) for value in node.values],
                    OPERATORS[type(node.op)],
                )
                # Each is asked, also where the first decides, so that an entry that is neither shows.
                return Part(text, TRUTH, lambda v: reduce(join, [truth(v) for truth in truths]))
            case ast.UnaryOp(op=ast.Not()):
                truth = self.truth(node.operand, depth)
                return Part(text, TRUTH, lambda v: ~truth(v))
            case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
                return self._computed(OPERATORS[type(node.op)], [node.operand], text, depth)
            case ast.BinOp(op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div()):
                return self._computed(
                    OPERATORS[type(node.op)], [node.left, node.right], text, depth
                )
            case ast.Compare() if all(type(op) in OPERATORS for op in node.ops):
                sides = [self._number(side, depth).of for side in (node.left, *node.comparators)]
                operators = [OPERATORS[type(op)] for op in node.ops]

                def compared(v: Values) -> Any:
                    pairs = zip(operators, pairwise([side(v) for side in sides]), strict=True)
                    return reduce(np.logical_and, [compare(*pair) for compare, pair in pairs])

                return Part(text, TRUTH, compared)
        self.refuse(
            f"{text!r} is not allowed in it: use <, <=, >, >=, == and !=, + - * / and, for truths, and, or, "
            "and not instead of ~"
        )

    def _constant(self, value: Any, text: str) -> Part:
        if isinstance(value, bool):
            self.refuse(f"{value} is the same at every step: use {FORMS}")
        if not isinstance(value, int | float):
            self.refuse(f"{text} is no number, and nothing else can be compared")
        return self._checked(Part(text, CONSTANT, lambda values: float(value)))

    def _checked(self, constant: Part) -> Part:
        """Returns a constant if it is finite."""
        try:
            with np.errstate(all="ignore"):
                finite = math.isfinite(constant.of({}))
        except OverflowError:  # an integer beyond every float
            finite = False
        if not finite:
            self.refuse(f"{constant.text!r} is no finite number")
        return constant

    def _name(self, name: str) -> Part:
        if name in NAMES:
            return self._asked((name,), NAMES[name], name)
        if name == "info":
            self.refuse('info holds many things: name one of them, as info["success"]')
        if name.lower() in ("nan", "inf", "infinity"):
            self.refuse(f"{name} is no finite number")
        close = get_close_matches(name, [*NAMES, "info", "distance"], n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        self.refuse(f"{_short(name)!r} is not known: use {FORMS}{hint}")

    def _path(self, node: ast.expr, text: str) -> Path:
        steps: list[Any] = []
        while isinstance(node, ast.Subscript):
            try:
                steps.insert(
                    0, ast.literal_eval(node.slice)
                )  # a string, a number, or one with a sign
            except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
                steps.insert(0, None)
            node = node.value
        keyed = isinstance(node, ast.Name) and node.id == "info" and type(steps[0]) is str
        if not keyed or any(type(step) not in (str, int) for step in steps):
            self.refuse(
                f'{text!r} names no entry: write info["key"], or info["key"][0], with quotes'
            )
        return tuple(steps)

    def _call(self, node: ast.Call, text: str, depth: int) -> Part:
        name = node.func.id if isinstance(node.func, ast.Name) else None
        if name == "abs" and len(node.args) == 1 and not node.keywords:
            return self._computed(np.abs, node.args, text, depth)
        if name != "distance":
            self.refuse(
                f"{text!r} is not allowed in it: only distance(a, b) and abs(x) can be called"
            )
        if len(node.args) != 2 or node.keywords:
            self.refuse("distance takes two names of the model, as distance(fingertip, target)")
        return self._asked(("distance", *map(self._place, node.args)), NUMBER, text)

    def _place(self, node: ast.expr) -> str:
        """Returns a name in the model: quoted, or bare if it looks like names, dots and hyphens."""
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value:
            return node.value
        # The source itself: `finger-tip` is a difference, and `body.1` would be no tree at all.
        source = self._source_of(node)
        if not PLACE.fullmatch(source):
            self.refuse(
                f"{_short(source)!r} is no name of the model: quote names with other characters than . and -"
            )
        return source

    def _computed(
        self, compute: Callable[..., Any], nodes: Sequence[ast.expr], text: str, depth: int
    ) -> Part:
        parts = [self._number(node, depth) for node in nodes]

        def of(values: Values) -> Any:
            value = compute(*[part.of(values) for part in parts])
            return np.where(np.isfinite(value), value, np.nan)  # a quotient by 0 is none

        if all(part.kind == CONSTANT for part in parts):
            return self._checked(Part(text, CONSTANT, of))
        return Part(text, NUMBER, of)

    def _source_of(self, node: ast.expr) -> str:
        return ast.get_source_segment(self.source, node) or ""


def _short(text: str) -> str:
    """Returns the beginning of a text, which leaves room for a sentence about it."""
    line = " ".join(text.split())
    return line if len(line) <= 40 else line[:37] + "..."
