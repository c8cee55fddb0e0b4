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
from enum import Enum
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple, NoReturn

import numpy as np

from hyrl_mj.errors import BadInput

# What the environment reports by name, and as what.
NAMES = ("terminated", "truncated", "reward")
FORMS = 'terminated, truncated, reward, info["key"] and distance(a, b), with and, or, not and comparisons'
# Conditions are read by people: [characters], and levels of brackets and operators, where Python's stack is
# far from its end.
LENGTH, DEPTH = 1000, 50
PLACE = re.compile(r"[\w.-]+")  # a name in a model that need not be quoted

Values = Mapping[Any, np.ndarray]
Path = tuple[str | int, ...]


class Kind(Enum):
    """What a part of an expression is: an entry of `info` is a number, or true or false."""

    CONSTANT, NUMBER, TRUTH, ENTRY = range(4)


class Part(NamedTuple):
    """A part of an expression: its text, its kind, and its values (k,) for what k copies report."""

    text: str
    kind: Kind
    of: Callable[[Values], Any]


def _differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.less(a, b) | np.greater(a, b)  # as every comparison false where a value is missing


COMPARISONS: dict[type[ast.cmpop], Callable] = {
    ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater, ast.GtE: np.greater_equal,
    ast.Eq: np.equal, ast.NotEq: _differ,
}  # fmt: skip
ARITHMETIC: dict[type[ast.operator], Callable] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide,
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
        rule = reader.truth(reader.part(reader.tree(), 0))
        if not reader.reports:
            reader.refuse(f"it asks nothing of the environment: use {FORMS}")
        return cls(text, what, tuple(reader.keys), tuple(reader.places), rule)

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
        listed = isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, (str, bytes))
        if isinstance(value, Mapping):
            value = value.get(step)
        elif listed and isinstance(step, int):
            value = value[step] if -len(value) <= step < len(value) else None
        else:
            kind = type(value).__name__
            raise BadInput(f"{_written(path[:depth])} is of type {kind}: it has no entry {step!r}")
        if value is None:
            return math.nan
    array = (
        np.asarray(value) if isinstance(value, (bool, int, float, np.generic, np.ndarray)) else None
    )
    if array is None or array.size != 1 or array.dtype.kind not in "biuf":
        kind = type(value).__name__
        raise BadInput(
            f"{_written(path)} is of type {kind}: use an entry that is one number, or true or false"
        )
    return float(array.item())


def _written(path: Path) -> str:
    return "info" + "".join(f"[{step!r}]" for step in path)


class _Reader:
    """Translates the syntax tree of one text, and notes what it needs."""

    def __init__(self, text: str, what: str) -> None:
        if not isinstance(text, str):
            raise BadInput(
                f"{what} is of type {type(text).__name__}: give text, such as 'reward >= 1'"
            )
        self.text, self.what = text, what
        self.source = text.strip()
        self.keys: dict[Path, None] = {}  # in order, each once
        self.places: dict[tuple[str, str], None] = {}
        self.reports = False  # whether anything is asked of the environment

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

    def part(self, node: ast.expr, depth: int) -> Part:
        """Returns a node as a part."""
        if depth > DEPTH:
            self.refuse(f"it is nested deeper than {DEPTH} levels: write it simpler")
        # Looked up by the node's own type, so that nothing passes that is not listed here.
        known: dict[type[ast.expr], Callable[[Any, int], Part]] = {
            ast.Constant: self._constant, ast.Name: self._name, ast.Subscript: self._entry,
            ast.Call: self._call, ast.BoolOp: self._joined, ast.UnaryOp: self._signed,
            ast.BinOp: self._computed, ast.Compare: self._compared,
        }  # fmt: skip
        translate = known.get(type(node))
        if translate is None:
            self.refuse(f"{self._of(node)!r} is not allowed in it: use {FORMS}")
        return translate(node, depth + 1)

    def truth(self, part: Part) -> Callable[[Values], np.ndarray]:
        """Returns the values of a part that has to be true or false."""
        if part.kind is Kind.TRUTH:
            return part.of
        if part.kind is not Kind.ENTRY:
            self.refuse(f"{part.text!r} is neither true nor false: compare it, as in reward >= 1")

        def told(values: Values) -> np.ndarray:
            value = np.asarray(part.of(values), dtype=float)
            odd = value[~(np.isnan(value) | (value == 0) | (value == 1))]
            if odd.size:
                self.refuse(f"{part.text} is {odd[0]:g}, neither true nor false: compare it")
            return value == 1

        return told

    def _number(self, part: Part) -> Callable[[Values], Any]:
        if part.kind is Kind.TRUTH:
            self.refuse(f"{part.text!r} is true or false, no number: join it by and, or, not")
        return part.of

    def _constant(self, node: ast.Constant, depth: int) -> Part:
        value = node.value
        if isinstance(value, bool):
            self.refuse(f"{value} is the same at every step: use {FORMS}")
        if not isinstance(value, (int, float)):
            self.refuse(f"{self._of(node)} is no number, and nothing else can be compared")
        return Part(self._of(node), Kind.CONSTANT, self._finite(node, lambda values: float(value)))

    def _finite(self, node: ast.expr, of: Callable[[Values], Any]) -> Callable[[Values], Any]:
        """Returns a function that takes no values, if what it gives is finite."""
        try:
            with np.errstate(all="ignore"):
                finite = math.isfinite(of({}))
        except OverflowError:  # an integer beyond every float
            finite = False
        if not finite:
            self.refuse(f"{self._of(node)!r} is no finite number")
        return of

    def _name(self, node: ast.Name, depth: int) -> Part:
        name = node.id
        if name not in NAMES:
            if name == "info":
                self.refuse('info holds many things: name one of them, as info["success"]')
            if name.lower() in ("nan", "inf", "infinity"):
                self.refuse(f"{name} is no finite number")
            close = get_close_matches(name, [*NAMES, "info", "distance"], n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            self.refuse(f"{_short(name)!r} is not known: use {FORMS}{hint}")
        self.reports = True
        if name == "reward":
            return Part(name, Kind.NUMBER, lambda values: np.asarray(values[name], dtype=float))
        return Part(name, Kind.TRUTH, lambda values: np.asarray(values[name], dtype=bool))

    def _entry(self, node: ast.Subscript, depth: int) -> Part:
        steps: list[Any] = []
        inner: ast.expr = node
        while isinstance(inner, ast.Subscript):
            try:
                steps.insert(
                    0, ast.literal_eval(inner.slice)
                )  # a literal: a string, a number, a sign and a number
            except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
                steps.insert(0, None)
            inner = inner.value
        keyed = isinstance(inner, ast.Name) and inner.id == "info" and type(steps[0]) is str
        if not keyed or any(type(step) not in (str, int) for step in steps):
            self.refuse(
                f'{self._of(node)!r} names no entry: write info["key"], or info["key"][0], with quotes'
            )
        path, self.reports = tuple(steps), True
        self.keys[path] = None
        key = ("info", path)
        return Part(self._of(node), Kind.ENTRY, lambda values: np.asarray(values[key], dtype=float))

    def _call(self, node: ast.Call, depth: int) -> Part:
        name = node.func.id if isinstance(node.func, ast.Name) else None
        if name == "abs" and len(node.args) == 1 and not node.keywords:
            inner = self.part(node.args[0], depth)
            number = self._number(inner)
            kind = Kind.CONSTANT if inner.kind is Kind.CONSTANT else Kind.NUMBER
            return Part(self._of(node), kind, lambda values: np.abs(number(values)))
        if name != "distance":
            self.refuse(
                f"{self._of(node)!r} is not allowed in it: only distance(a, b) and abs(x) can be called"
            )
        if len(node.args) != 2 or node.keywords:
            self.refuse("distance takes two names of the model, as distance(fingertip, target)")
        pair = self._place(node.args[0]), self._place(node.args[1])
        self.places[pair], self.reports = None, True
        key = ("distance", *pair)
        return Part(
            self._of(node), Kind.NUMBER, lambda values: np.asarray(values[key], dtype=float)
        )

    def _place(self, node: ast.expr) -> str:
        """Returns a name in the model: quoted, or bare if it looks like names, dots and hyphens."""
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value:
            return node.value
        # The source itself: `finger-tip` is a difference, and `body.1` would be no tree at all.
        source = ast.get_source_segment(self.source, node) or ""
        if not PLACE.fullmatch(source):
            self.refuse(
                f"{_short(source)!r} is no name of the model: quote names with other characters than . and -"
            )
        return source

    def _joined(self, node: ast.BoolOp, depth: int) -> Part:
        truths = [self.truth(self.part(value, depth)) for value in node.values]
        join = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
        # Each is asked, also where the first decides, so that an entry that is neither is never overlooked.
        return Part(
            self._of(node),
            Kind.TRUTH,
            lambda values: reduce(join, [truth(values) for truth in truths]),
        )

    def _signed(self, node: ast.UnaryOp, depth: int) -> Part:
        inner = self.part(node.operand, depth)
        if isinstance(node.op, ast.Not):
            truth = self.truth(inner)
            return Part(self._of(node), Kind.TRUTH, lambda values: ~truth(values))
        if not isinstance(node.op, (ast.USub, ast.UAdd)):
            self.refuse(f"{self._of(node)!r} is not allowed in it: write not instead of ~")
        number = self._number(inner)
        kind = Kind.CONSTANT if inner.kind is Kind.CONSTANT else Kind.NUMBER
        sign = np.negative if isinstance(node.op, ast.USub) else np.positive
        return Part(self._of(node), kind, lambda values: sign(number(values)))

    def _computed(self, node: ast.BinOp, depth: int) -> Part:
        compute = ARITHMETIC.get(type(node.op))
        if compute is None:
            self.refuse(
                f"{self._of(node)!r} is not allowed in it: use + - * / and, for truths, and, or"
            )
        parts = self.part(node.left, depth), self.part(node.right, depth)
        left, right = (self._number(part) for part in parts)

        def of(values: Values) -> Any:
            value = compute(left(values), right(values))
            return np.where(np.isfinite(value), value, np.nan)  # a quotient by 0 is none

        if all(part.kind is Kind.CONSTANT for part in parts):
            return Part(self._of(node), Kind.CONSTANT, self._finite(node, of))
        return Part(self._of(node), Kind.NUMBER, of)

    def _compared(self, node: ast.Compare, depth: int) -> Part:
        sides = [self._number(self.part(value, depth)) for value in (node.left, *node.comparators)]
        comparisons = []
        for op in node.ops:
            if type(op) not in COMPARISONS:
                self.refuse(f"{self._of(node)!r} is not allowed in it: use <, <=, >, >=, == or !=")
            comparisons.append(COMPARISONS[type(op)])

        def of(values: Values) -> np.ndarray:
            pairs = pairwise([side(values) for side in sides])
            each = [compare(a, b) for compare, (a, b) in zip(comparisons, pairs, strict=True)]
            return reduce(np.logical_and, each)

        return Part(self._of(node), Kind.TRUTH, of)

    def _of(self, node: ast.expr) -> str:
        return _short(ast.get_source_segment(self.source, node) or "")


def _short(text: str) -> str:
    """Returns the beginning of a text, which leaves room for a sentence about it."""
    line = " ".join(text.split())
    return line if len(line) <= 40 else line[:37] + "..."
