"""What can go wrong, in sentences for people: what was given, what is allowed, how to mend it."""

import math
from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral, Real


class HyrlError(Exception):
    """Base of every error that the package raises on purpose; its text is one clear sentence."""

    exit_status = 1


class BadInput(HyrlError, ValueError):
    """A value from the user that cannot be used."""

    exit_status = 2


class BadArtifact(BadInput):
    """A file that is missing, truncated, of another version, or not what its name says."""


class NoRenderer(HyrlError):
    """Off-screen rendering or video encoding is not possible on this machine."""


def unknown(what: str, given: object, allowed: Iterable[str]) -> BadInput:
    """The error for a name that is not one of `allowed`."""
    names = list(allowed)
    close = get_close_matches(str(given), names, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return BadInput(f"unknown {what} {given!r}: choose one of {', '.join(names)}.{hint}")


def brief(error: BaseException) -> str:
    """The kind of an error and the beginning of what it says, in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text if len(text) <= 160 else text[:157] + '...'}"


def check_seed(seed: int) -> int:
    """The seed itself, if it is one.

    Raises:
        BadInput: it is not an integer from 0 to 2**32 - 1, what NumPy, torch and SB3 all take.
    """
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise BadInput(f"seed {seed!r} cannot be used: give an integer from 0 to 4294967295")
    return int(seed)


def check_bound(bound: float) -> float:
    """The noise bound itself, if it is one.

    Raises:
        BadInput: it is negative, infinite or not a number.
    """
    if not (isinstance(bound, Real) and math.isfinite(bound) and bound >= 0):
        raise BadInput(f"noise bound {bound!r} cannot be used: give a finite number >= 0")
    return float(bound)
