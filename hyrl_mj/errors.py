"""Errors whose text says in one sentence what was given, what is allowed, and what to do."""

import math
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from numbers import Integral, Real
from pathlib import Path
from unicodedata import category

# The longest text of an error [characters]: what is longer holds something of a file that nobody reads.
LONGEST = 500
# The largest number that a user gives: its square is a number, too.
LARGEST_NUMBER = 1e30


class HyrlError(Exception):
    """Base of every error that the package raises on purpose.

    Control characters in its text, which may come from a file, are written as escapes, and the middle of a
    text that is too long is left out.
    """

    exit_status = 1

    def __init__(self, text: object = "") -> None:
        # Escapes are longer than what they stand for, and a text that is far too long takes long to escape.
        super().__init__(_cut(printable(_cut(str(text)))))


def _cut(text: str) -> str:
    """Returns a text without its middle, if it is too long."""
    half = LONGEST // 2
    return text if len(text) <= LONGEST else f"{text[:half]} [...] {text[-half:]}"


class BadInput(HyrlError, ValueError):
    """A value from the user that cannot be used."""

    exit_status = 2


class BadArtifact(BadInput):
    """A file that is missing, truncated, of another version, or not what its name says."""


class NoRenderer(HyrlError):
    """Off-screen rendering or video encoding is not possible on this machine."""


def printable(text: str) -> str:
    """Returns a text that cannot control a terminal, and that a file can hold.

    Control and format characters, line separators and surrogates are written as escapes.
    """
    if text.isprintable():  # the usual case, without a look at each character
        return text
    controls = ("Cc", "Cf", "Cs", "Zl", "Zp")
    return "".join(ascii(c)[1:-1] if category(c) in controls else c for c in text)


def has_controls(text: str) -> bool:
    """Returns whether a text has characters that control a terminal, or that no file can hold."""
    return printable(text) != text


def counted(n: int, noun: str) -> str:
    """Returns "1 jump", "2 jumps"."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def listed(words: Sequence[str]) -> str:
    """Returns "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def unknown(what: str, value: object, allowed: Iterable[str]) -> BadInput:
    """Returns the error for a name that is not one of `allowed`."""
    names = list(allowed)
    close = get_close_matches(str(value)[:LONGEST], names, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return BadInput(f"unknown {what} {value!r}: choose one of {', '.join(names)}.{hint}")


def brief(error: BaseException) -> str:
    """Returns the kind of an error and the beginning of its text, in one line that can be printed."""
    kind, text = type(error).__name__, printable(" ".join(str(error).split()))
    return f"{kind}: {text if len(text) <= 160 else text[:157] + '...'}" if text else kind


@contextmanager
def described(what: str) -> Iterator[None]:
    """Raises `BadInput` where the block, which makes something of a description, raises another error."""
    try:
        yield
    except HyrlError:
        raise
    except Exception as error:  # a description can be wrong in any way
        raise BadInput(
            f"{what} cannot be made as it is described ({brief(error)}): correct its arguments"
        ) from error


def line_in(error: BaseException, path: Path | None) -> str:
    """Returns the line of a file that an error came from: ", line 7"; "" if it came from elsewhere."""
    if isinstance(error, SyntaxError):
        return ""  # its text names the line
    calls = traceback.extract_tb(error.__traceback__)
    lines = [call.lineno for call in calls if call.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""


def check_seed(seed: int) -> int:
    """Returns the seed, if it can be used.

    Raises:
        BadInput: it is not an integer from 0 to 2**32 - 1, what NumPy, torch and SB3 all take.
    """
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise BadInput(f"seed {seed!r} cannot be used: give an integer from 0 to 4294967295")
    return int(seed)


def check_bound(bound: float) -> float:
    """Returns the noise bound, if it can be used.

    Raises:
        BadInput: it is negative, far too large or not a number.
    """
    if not (isinstance(bound, Real) and math.isfinite(bound) and bound >= 0):
        raise BadInput(f"noise bound {bound!r} cannot be used: give a finite number >= 0")
    if bound > LARGEST_NUMBER:
        raise BadInput(f"noise bound {bound:g} cannot be used: give at most {LARGEST_NUMBER:g}")
    return float(bound)
