"""Standard output and standard error that cannot stop a command.

A run takes minutes, and what it writes to disk does not depend on who reads what it says. A closed stream, a
pipe whose reader has gone, a full disk behind a redirection, or a character that the terminal does not know
must not end it. What could not be shown is said once, at the end. Python's own streams raise an error at the
next `print`, wherever that is.
"""

from __future__ import annotations

import errno
import io
import os
import re
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from hyrl_mj.errors import BadInput, HyrlError, brief, printable

INTERRUPTED = "interrupted; finished work is kept, run again to resume"


# What may be written beside printable characters: breaks, and on a terminal sequences that libraries write:
# colours, movements of the cursor, lines that are cleared.
_BREAKS = re.compile("([\\n\\r\\t])")
_SEQUENCES = re.compile("([\\n\\r\\t]|\\x1b\\[(?:[0-9;]*[mABCDGK]|\\?25[hl]))")


class _Raw(io.FileIO):
    """A stream that swallows everything after the first write that fails, whose error it keeps."""

    problem: OSError | None = None

    def write(self, data: Any) -> int | None:  # type: ignore[override]
        if self.problem is None:
            try:
                return super().write(data)
            except OSError as error:
                self.problem = error
        return len(memoryview(data))


class _Escaping(io.TextIOWrapper):
    """A text stream on which names from files cannot control the terminal: it shows them as escapes.

    Colours and movements of the cursor are kept where it is a terminal: they come from libraries, since texts
    of errors, charts and models are checked where they enter.
    """

    def write(self, text: str) -> int:
        if not text.isprintable():
            kept = _SEQUENCES if self.isatty() else _BREAKS
            parts = kept.split(text)  # what is kept stands at the odd places
            text = "".join(p if i % 2 else printable(p) for i, p in enumerate(parts))
        return super().write(text)


class Streams:
    """The standard streams of a command, made lasting.

    Streams that are closed are opened on the null device, so that no file that is opened later takes their
    place, and gets what libraries print.
    """

    def __init__(self) -> None:
        self._closed = [stream is None for stream in (sys.stdin, sys.stdout, sys.stderr)]
        for number in range(3):
            try:
                os.fstat(number)
            except OSError:
                os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one
        # A narrower terminal breaks the lines itself: libraries that lay out text cannot.
        if shutil.get_terminal_size().columns < 60:
            os.environ["COLUMNS"] = "60"
        self._raw: dict[int, _Raw] = {}
        self._has_complained = False
        sys.stdout, sys.stderr = self._lasting(sys.stdout, 1), self._lasting(sys.stderr, 2)

    def _lasting(self, stream: TextIO | None, number: int) -> TextIO:
        """Returns the stream in place of one that Python has opened."""
        if stream is None:
            return open(os.devnull, "w", encoding="utf-8")
        try:
            if stream.fileno() != number:
                return stream
        except (OSError, ValueError, AttributeError):  # a test has put another object in its place
            return stream
        self._raw[number] = raw = _Raw(number, "wb", closefd=False)
        return _Escaping(
            io.BufferedWriter(raw),
            encoding=stream.encoding,
            errors="backslashreplace",
            line_buffering=True,
        )

    @property
    def has_room_for_bars(self) -> bool:
        """Whether standard error is a terminal that is wide enough for progress bars."""
        if not sys.stderr.isatty():
            return False
        width = os.get_terminal_size(sys.stderr.fileno()).columns
        # On a narrower terminal a bar is a column of its pieces; 0 is one that does not know its width.
        return width == 0 or width >= 30

    def run(self, command: Callable[[], None]) -> int:
        """Runs a command, says what went wrong, and returns the exit status."""
        with self._interruptible():
            status = self._status(command)
        with suppress(OSError):
            sys.stdout.flush()
        if self._closed[1]:
            self._complain("standard output is closed, so that nothing could be shown")
        elif (problem := self._problem(1)) and problem.errno == errno.EPIPE:
            self._complain("the reader of standard output has gone: the rest was not shown")
        elif problem:
            why = problem.strerror or problem
            self._complain(f"standard output cannot be written ({why}): the rest was not shown")
            status = status or 1
        return status

    def _status(self, command: Callable[[], None]) -> int:
        """Runs a command, says what went wrong, and returns its own exit status."""
        try:
            check_working_directory()
            command()
        except HyrlError as error:
            self._complain(str(error))
            return error.exit_status
        except KeyboardInterrupt:
            self._complain(INTERRUPTED)
            return 128 + signal.SIGINT
        except SystemExit as error:
            return error.code if isinstance(error.code, int) else int(error.code is not None)
        except Exception as error:
            if (said := _of_system(error)) is not None:
                self._complain(str(said))
                return said.exit_status
            if self._is_deaf:  # the traceback would not be seen
                self._complain(brief(error))
            raise
        return 0

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Lets an interrupt end the process within five seconds, in the block and after it."""
        usual = signal.getsignal(signal.SIGINT)
        if (
            usual is not signal.default_int_handler
            or not hasattr(signal, "setitimer")
            or threading.current_thread() is not threading.main_thread()
        ):
            yield
            return
        hook = sys.unraisablehook

        def without_interrupts(ignored: Any) -> None:
            # One that strikes where Python ignores errors is lost, but for `_give_up`.
            if not issubclass(ignored.exc_type, KeyboardInterrupt):
                hook(ignored)

        sys.unraisablehook = without_interrupts
        signal.signal(signal.SIGINT, self._interrupted)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, usual)
            sys.unraisablehook = hook

    def _interrupted(self, *_: object) -> None:
        signal.signal(signal.SIGALRM, self._give_up)
        # It can strike while one of Python's locks is taken, which is then waited for without end.
        signal.setitimer(signal.ITIMER_REAL, 5.0)  # [s] after which the process ends by itself
        raise KeyboardInterrupt

    def _give_up(self, *_: object) -> None:
        if not self._has_complained:
            with suppress(OSError):
                os.write(2, f"hyrl-mj: {INTERRUPTED}\n".encode())
        os._exit(128 + signal.SIGINT)

    @property
    def _is_deaf(self) -> bool:
        """Whether nobody reads standard error."""
        sys.stderr.flush()
        return self._closed[2] or self._problem(2) is not None

    def _complain(self, text: str) -> None:
        """Says what went wrong on standard error, or on standard output if nobody reads the other."""
        self._has_complained = True
        print(f"hyrl-mj: {text}", file=sys.stderr)
        if self._is_deaf:
            print(f"hyrl-mj: {text}", flush=True)

    def _problem(self, number: int) -> OSError | None:
        return self._raw[number].problem if number in self._raw else None


def _of_system(error: Exception) -> HyrlError | None:
    """Returns the sentence for an error of the system, None for a mistake in the code."""
    if isinstance(error, MemoryError):
        return HyrlError(
            "there is not enough memory: let other programs end, or give it less to do"
        )
    if isinstance(error, RuntimeError) and str(error).startswith(
        "Symlink loop"
    ):  # before Python 3.13
        return BadInput(f"{error}: give another path")
    if not isinstance(error, OSError):
        return None
    where = "" if error.filename is None else f": {os.fsdecode(error.filename)}"
    # Those that a path brings about which somebody gives.
    of_paths = "ENAMETOOLONG", "EACCES", "EPERM", "ELOOP", "ENOTDIR", "EISDIR"
    kind = BadInput if error.errno in (getattr(errno, name) for name in of_paths) else HyrlError
    return kind(f"{error.strerror or brief(error)}{where}")


def check_working_directory() -> None:
    """Raises `BadInput` if the working directory is gone."""
    try:
        os.getcwd()
    except OSError as error:
        raise BadInput(
            f"the working directory cannot be found ({error.strerror}): change to another, as with cd"
        ) from error
