"""Conditions on what an environment reports at each step, such as `terminated and reward >= 1`.

An expression is text that Python's parser reads and that is never run: each node of its syntax tree has
to be one of those in this file, which compute with arrays over the copies of an environment.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import reduce
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np

from hyrl_mj.errors import BadInput

FORMS = 'terminated, truncated, reward, info["key"] and distance(a, b), with and, or, not and comparisons'
# Conditions are read by people: [characters], and levels of brackets and operators, where Python's stack is
# far from its end.
LENGTH, DEPTH = 1000, 50
# The names that need no others, and whether they are true or false.
NAMES = {"terminated": True, "truncated": True, "reward": False}
OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater, ast.GtE: np.greater_equal,
    # As every comparison false where a value is missing.
    ast.Eq: np.equal, ast.NotEq: lambda a, b: np.less(a, b) | np.greater(a, b),
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide,
    ast.And: np.logical_and, ast.Or: np.logical_or, ast.USub: np.negative, ast.UAdd: np.positive,
}  # fmt: skip

Path = tuple[str | int, ...]


class _Asked(dict[Any, np.ndarray]):
    """Values of one copy of which nothing is known, noted in the order in which they are asked for."""

    def __missing__(self, key: Any) -> np.ndarray:
        self[key] = np.full(1, np.nan)
        return self[key]


@dataclass(frozen=True)
class Expression:
    """A condition on what an environment reports after a step; `parse` makes one.

    What `info` does not hold at a step is missing (NaN): it is false, and so is every comparison with it.

    Attributes:
        text: the expression, as the user gives it.
        what: what it decides, as messages call it.
        asked: the names that it needs, each once: "terminated", "truncated", "reward"; ("info", path) of an
            entry of `info`, where `info["a"][0]` has the path ("a", 0); ("distance", a, b) of a pair of names
            in the model.
    """

    text: str
    what: str = "success"
    asked: tuple[Any, ...] = ()
    _tree: Any = field(default=None, repr=False, compare=False)

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
        tree, asked = cls(text, what)._parsed(), _Asked()
        unread = cls(text, what, _tree=tree)
        unread.holds(asked)
        if not asked:
            unread._refuse(f"it asks nothing of the environment: use {FORMS}")
        return cls(text, what, tuple(asked), tree)

    def holds(self, values: Mapping[Any, np.ndarray]) -> np.ndarray:
        """Returns where the expression holds, (k,) bool.

        Args:
            values: what k copies report, arrays (k,), by the names of `asked`: entries of `info` NaN where
                missing, and distances in metres.

        Raises:
            BadInput: an entry of `info` that has to be true or false is another number.
        """
        with np.errstate(all="ignore"):  # what is not finite is made missing
            return np.asarray(self._truth(self._tree, values))

    def needs(self, name: str) -> bool:
        """Returns whether the expression asks for a name otherwise than by `not`."""

        def holds(node: ast.AST) -> bool:
            if isinstance(node, ast.Name):
                return node.id == name
            negated = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
            parts = ast.iter_child_nodes(node)
            return not negated and any(holds(part) for part in parts)

        return self._tree is not None and holds(self._tree)

    def _refuse(self, why: str) -> NoReturn:
        raise BadInput(f"{self.what} {_short(self.text)!r} cannot be used: {why}")

    def _parsed(self) -> ast.expr:
        """Returns the syntax tree of the text."""
        source = self.text.strip()
        if not source:
            self._refuse(f"it is empty: use {FORMS}")
        if len(source) > LENGTH:
            self._refuse(f"it has {len(source)} characters: give at most {LENGTH}, to be legible")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # what Python's parser doubts is refused as well
                tree = ast.parse(source, mode="eval").body
        except SyntaxError as error:
            quotes = "; quote names that are no Python names" if "distance" in source else ""
            self._refuse(f"it is no expression ({_short(error.msg)}): use {FORMS}{quotes}")
        except (ValueError, RecursionError, MemoryError):  # null bytes, lone surrogates, nesting
            self._refuse(
                "Python cannot read it: give a short expression without special characters"
            )
        if _levels(tree) > DEPTH:
            self._refuse(f"it is nested deeper than {DEPTH} levels: write it simpler")
        return tree

    def _truth(self, node: ast.expr, values: Mapping[Any, np.ndarray]) -> Any:
        """Returns the values of a node that has to be true or false."""
        value = self._value(node, values)
        if value.dtype == bool:
            return value
        if not isinstance(node, ast.Subscript):
            text = self._text_of(node)
            self._refuse(f"{text!r} is neither true nor false: compare it, as in reward >= 1")
        odd = value[~(np.isnan(value) | (value == 0) | (value == 1))]
        if odd.size:
            text = self._text_of(node)
            self._refuse(f"{text} is {odd[0]:g}, neither true nor false: compare it")
        return value == 1

    def _number(self, node: ast.expr, values: Mapping[Any, np.ndarray]) -> Any:
        """Returns the values of a node that has to be a number."""
        value = self._value(node, values)
        if value.dtype == bool:
            text = self._text_of(node)
            self._refuse(f"{text!r} is true or false, no number: join it by and, or, not")
        return value

    def _value(self, node: ast.expr, values: Mapping[Any, np.ndarray]) -> Any:
        """Returns the values (k,) of a node, or of a constant one (), which are truths or numbers."""
        match node:
            case ast.Constant(value=bool()):
                self._refuse(f"{self._text_of(node)} is the same at every step: use {FORMS}")
            case ast.Constant(value=int() | float() as number):
                return self._computed(node, lambda: number)
            case ast.Constant():
                text = self._text_of(node)
                self._refuse(f"{text} is no number, and nothing else can be compared")
            case ast.Name(id=name):
                self._check_name(name)
                return np.asarray(values[name], dtype=bool if NAMES[name] else float)
            case ast.Subscript():
                return np.asarray(values["info", self._path(node)], dtype=float)
            case ast.Call(func=ast.Name(id="abs"), args=[of], keywords=[]):
                return self._computed(node, np.abs, self._number(of, values))
            case ast.Call(func=ast.Name(id="distance"), args=[a, b], keywords=[]):
                return np.asarray(values["distance", self._place(a), self._place(b)], dtype=float)
            case ast.Call(func=ast.Name(id="distance")):
                self._refuse(
                    "distance takes two names of the model, as distance(fingertip, target)"
                )
            case ast.Call():
                text = self._text_of(node)
                self._refuse(
                    f"{text!r} is not allowed in it: only distance(a, b) and abs(x) can be called"
                )
            case ast.BoolOp():
                # Each is asked, also where the first decides, so that an entry that is neither shows.
                truths = [self._truth(value, values) for value in node.values]
                return reduce(OPERATORS[type(node.op)], truths)
            case ast.UnaryOp(op=ast.Not()):
                return ~self._truth(node.operand, values)
            case ast.UnaryOp(op=op) if type(op) in OPERATORS:
                return self._computed(node, OPERATORS[type(op)], self._number(node.operand, values))
            case ast.BinOp(op=op) if type(op) in OPERATORS:
                sides = [self._number(side, values) for side in (node.left, node.right)]
                return self._computed(node, OPERATORS[type(op)], *sides)
            case ast.Compare() if all(type(op) in OPERATORS for op in node.ops):
                sides = [self._number(side, values) for side in (node.left, *node.comparators)]
                pairs = zip(node.ops, pairwise(sides), strict=True)
                return reduce(np.logical_and, [OPERATORS[type(op)](*pair) for op, pair in pairs])
        self._refuse(
            f"{self._text_of(node)!r} is not allowed in it: use <, <=, >, >=, == and !=, + - * / and, for "
            "truths, and, or, and not instead of ~"
        )

    def _computed(self, node: ast.expr, compute: Callable[..., Any], *numbers: np.ndarray) -> Any:
        """Returns what is computed from numbers, as far as it is finite."""
        try:
            value = np.asarray(compute(*numbers), dtype=float)
        except OverflowError:  # an integer beyond every float
            value = np.array(np.inf)
        finite = np.isfinite(value)
        if not value.ndim and not finite:
            self._refuse(f"{self._text_of(node)!r} is no finite number")
        return np.where(finite, value, np.nan)  # a quotient by 0 is none

    def _check_name(self, name: str) -> None:
        if name == "info":
            self._refuse('info holds many things: name one of them, as info["success"]')
        if name.lower() in ("nan", "inf", "infinity"):
            self._refuse(f"{name} is no finite number")
        if name not in NAMES:
            close = get_close_matches(name, [*NAMES, "info", "distance"], n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            self._refuse(f"{_short(name)!r} is not known: use {FORMS}{hint}")

    def _path(self, node: ast.expr) -> Path:
        inner = node
        steps: list[Any] = []
        while isinstance(inner, ast.Subscript):
            try:  # a string, a number, or one with a sign
                steps.insert(0, ast.literal_eval(inner.slice))
            except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
                steps.insert(0, None)
            inner = inner.value
        keyed = isinstance(inner, ast.Name) and inner.id == "info" and type(steps[0]) is str
        if not keyed or any(type(step) not in (str, int) for step in steps):
            text = self._text_of(node)
            self._refuse(
                f'{text!r} names no entry: write info["key"], or info["key"][0], with quotes'
            )
        return tuple(steps)

    def _place(self, node: ast.expr) -> str:
        """Returns a name in the model: quoted, or bare if it is a name of Python."""
        match node:
            case ast.Name(id=name) | ast.Constant(value=str() as name) if name:
                return name
        self._refuse(
            f"{self._text_of(node)!r} is no name of the model: quote names that are none of Python"
        )

    def _text_of(self, node: ast.expr) -> str:
        return _short(ast.get_source_segment(self.text.strip(), node) or "")


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
    single = isinstance(value, np.generic | np.ndarray) and value.size == 1
    if single and value.dtype.kind in "biuf":
        value = value.item()
    if not isinstance(value, bool | int | float):
        raise BadInput(
            f"{_written(path)} is of type {type(value).__name__}: use an entry that is one number, or true "
            "or false"
        )
    return float(value)


def _written(path: Path) -> str:
    return "info" + "".join(f"[{step!r}]" for step in path)


def _levels(tree: ast.AST) -> int:
    """Returns over how many levels a tree is nested, of which the path of an entry is one."""
    level, count = [tree], 0
    while level:
        inner = [node for node in level if not isinstance(node, ast.Subscript)]
        level = [child for node in inner for child in ast.iter_child_nodes(node)]
        count += 1
    return count


def _short(text: str) -> str:
    """Returns the beginning of a text, which leaves room for a sentence about it."""
    line = " ".join(text.split())
    return line if len(line) <= 40 else line[:37] + "..."
