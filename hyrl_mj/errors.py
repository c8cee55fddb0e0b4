"""What can go wrong, in sentences for people: what was given, what is allowed, how to mend it."""

from collections.abc import Iterable
from difflib import get_close_matches


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
