"""Which values the fields of a record may have: rules that stand beside the types, as metadata.

    samples: Annotated[int, Integer(1, 1_000_000_000)]

`Checked` applies them where a record is made, also from a file. Pydantic, which reads the files, has
ranges, too. But it takes the text "12" and True for integers, or in its strict mode no numbers of NumPy; it
names neither the value nor the other end of a range; and its import takes a fifth of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from typing import Any, Protocol, get_type_hints

from hyrl_mj.errors import BadInput, has_controls, unknown


class Rule(Protocol):
    """Says which values are allowed."""

    def checked(self, name: str, value: Any) -> Any:
        """Returns the value as a plain Python one.

        Raises:
            BadInput: it is not allowed; the message names the field, the value, and what is allowed.
        """


def refused(name: str, value: object, allowed: str) -> BadInput:
    """Returns the error for a value of a field, with what is allowed instead."""
    shown = repr(value)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    return BadInput(f"{name} {shown} cannot be used: give {allowed}")


@dataclass(frozen=True)
class Number:
    """A number from `low` to `high`, or `above` low; True and False are none."""

    low: float
    high: float
    above: bool = False

    def checked(self, name: str, value: Any) -> float:
        return float(self._within(name, value, Real))

    def _within(self, name: str, value: Any, kind: type) -> Any:
        is_one = isinstance(value, kind) and not isinstance(value, bool)
        # NaN is not within any range.
        if not (is_one and self.low <= value <= self.high) or (self.above and value == self.low):
            raise refused(name, value, self.allowed)
        return value

    @property
    def allowed(self) -> str:
        if self.above:
            return f"a number > {self.low:g} and <= {self.high:g}"
        return f"a number from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Integer(Number):
    """An integer from `low` to `high`."""

    def checked(self, name: str, value: Any) -> int:
        return int(self._within(name, value, Integral))

    @property
    def allowed(self) -> str:
        return f"an integer from {self.low:,} to {self.high:,}"


@dataclass(frozen=True)
class Flag:
    """True or False."""

    def checked(self, name: str, value: Any) -> bool:
        if not isinstance(value, bool):
            raise refused(name, value, "True or False")
        return value


@dataclass(frozen=True)
class Text:
    """A string that is not empty and has no control characters."""

    def checked(self, name: str, value: Any) -> str:
        if not (isinstance(value, str) and value and not has_controls(value)):
            raise refused(name, value, "a text that can be printed")
        return str(value)


@dataclass(frozen=True)
class OneOf:
    """One of some names."""

    names: Collection[str]

    def checked(self, name: str, value: Any) -> str:
        if not isinstance(value, str) or value not in self.names:
            raise unknown(name, value, self.names)
        return str(value)


@dataclass(frozen=True)
class Optional:
    """None, or what another rule allows."""

    rule: Rule

    def checked(self, name: str, value: Any) -> Any:
        return None if value is None else self.rule.checked(name, value)


@dataclass(frozen=True)
class Several:
    """`fewest` to `most` values, each of which another rule allows, as a tuple."""

    rule: Rule
    fewest: int
    most: int

    def checked(self, name: str, value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or not self.fewest <= len(value) <= self.most:
            count = f"{self.fewest} to {self.most}" if self.fewest < self.most else f"{self.most}"
            raise refused(name, value, f"a tuple of {count} value{'s' if self.most > 1 else ''}")
        return tuple(self.rule.checked(f"{name}[{i}]", part) for i, part in enumerate(value))


@dataclass(frozen=True)
class By:
    """What a function returns that raises `BadInput` for other values."""

    function: Callable[[Any], Any]

    def checked(self, name: str, value: Any) -> Any:
        return self.function(value)


@dataclass(frozen=True)
class Instance:
    """An object of one of some types."""

    types: tuple[type, ...]

    def checked(self, name: str, value: Any) -> Any:
        if not isinstance(value, self.types):
            names = " or ".join(kind.__name__ for kind in self.types)
            raise refused(name, value, f"a {names}")
        return value


class Checked:
    """Base of frozen dataclasses whose fields are checked by their rules, and stored as plain Python values.

    To make one raises `BadInput` if a value is not allowed.
    """

    def __post_init__(self) -> None:
        for name, rule in _rules(type(self)).items():  # type: ignore[arg-type]
            object.__setattr__(self, name, rule.checked(name, getattr(self, name)))


@cache
def _rules(kind: type) -> dict[str, Rule]:
    """Returns the rule of each field that has one."""
    hints = get_type_hints(kind, include_extras=True)
    return {
        name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")
    }
