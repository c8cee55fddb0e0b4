"""What `tests/attack.py` tries, a file for each attack, and how a trial runs in a process of its own.

Everything is imported once. Each trial forks, so that it costs no import, leaves nothing behind, and its
memory is its own.
"""

import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from hyrl_mj import cli

# What a payload leaves behind when it runs, in the folder of its trial.
MARKER = "executed"
PATIENCE = 4
# Limits on what is hostile: seconds of the processor to refuse it, memory beyond that of something honest and
# memory that it may ask for [MB], and characters of the sentence.
SECONDS, MEMORY, MOST, LONGEST = 10.0, 200.0, 2_000, 600


@dataclass(frozen=True)
class Trial:
    """One trial of an attack.

    Attributes:
        name: what is done, so that it can be done again.
        attempt: does it in the empty folder that it receives, and returns what broke, "" if nothing did.
        prepare: makes what it shares with others, before any trial is made.
    """

    name: str
    attempt: Callable[[Path], str]
    prepare: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class Answer:
    """How a process ended.

    Attributes:
        status: its exit status; the negative number of the signal that ended it.
        out, err: what it wrote.
        seconds: how long it ran, and how long it was busy.
        memory: the most memory that it had [MB].
        late: whether it ran over its time and was killed.
    """

    status: int
    out: str
    err: str
    seconds: tuple[float, float]
    memory: float
    late: bool

    @property
    def sentence(self) -> str:
        """The sentence of the command line."""
        return " ".join(line for line in self.err.splitlines() if line.startswith("hyrl-mj: "))

    def broke(self, ended: tuple[int, ...] = (0, 1, 2), sentences: int = 1) -> str:
        """Returns what is wrong with the answer of the command line, "" if nothing is.

        Args:
            ended: the exit statuses that it may have.
            sentences: what it says on standard error if the status is 2.
        """
        text = self.out + self.err
        if self.late:
            return f"hangs: still running after {self.seconds[0]:.0f} s"
        if "Traceback (most recent call last)" in text:
            return f"traceback: {self.err.strip().splitlines()[-1]}"
        if any(not c.isprintable() and c not in "\n\t" for c in text):
            return f"control characters reach the terminal: {text!r}"
        if self.status not in ended:
            return f"exit status {self.status}: {(self.err or self.out).strip()[-300:]!r}"
        # A busy machine tells first that looking at an environment takes long.
        said = [line for line in self.err.strip().splitlines() if "to look at it" not in line]
        if self.status == 2 and len(said) != sentences:
            return f"not {sentences} sentence(s), but {self.err.strip()[-600:]!r}"
        return ""


class Process:
    """A forked process that does some work.

    Args:
        work: what to do; an error that leaves it is a traceback.
        folder: its working directory.
        seconds: that it may be busy; after `PATIENCE` times as long it and its own processes are killed.
        sent: after how many seconds it is sent a signal, and which.
    """

    def __init__(
        self,
        work: Callable[[], object],
        folder: Path,
        seconds: float = 60.0,
        sent: tuple[float, int] | None = None,
    ):
        self.seconds, self.sent, self.late = seconds, sent, False
        self.texts = [tempfile.TemporaryFile() for _ in (1, 2)]  # noqa: SIM115
        self.began = time.monotonic()
        self.pid = os.fork()
        if not self.pid:
            # On a machine that others use, too, a process may take longer than it is busy.
            busy = math.ceil(seconds)
            resource.setrlimit(resource.RLIMIT_CPU, (busy, busy + 5))
            _work(work, folder, *(file.fileno() for file in self.texts))

    def answer(self) -> Answer | None:
        """Returns how it has ended, None while it runs."""
        passed = time.monotonic() - self.began
        if self.sent and passed >= self.sent[0]:
            os.kill(self.pid, self.sent[1])
            self.sent = None
        if passed > PATIENCE * self.seconds:
            self.late = True
            _end(self.pid)
        ended, status, usage = os.wait4(self.pid, os.WNOHANG)
        if not ended:
            return None
        _end(self.pid)  # processes of its own that are left
        texts = [_content(file.fileno()) for file in self.texts]
        for file in self.texts:
            file.close()
        code = os.waitstatus_to_exitcode(status)
        times = passed, usage.ru_utime + usage.ru_stime
        late = self.late or code == -signal.SIGXCPU
        return Answer(code, *texts, times, usage.ru_maxrss / 1024, late)


def child(
    work: Callable[[], object],
    folder: Path,
    seconds: float = 60.0,
    sent: tuple[float, int] | None = None,
) -> Answer:
    """Does some work in a `Process`, and returns how it ended."""
    process = Process(work, folder, seconds, sent)
    while (answer := process.answer()) is None:
        time.sleep(0.005)
    return answer


def _work(work: Callable[[], object], folder: Path, out: int, err: int) -> None:
    """The life of the forked process."""
    status = 1
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(out, 1)
        os.dup2(err, 2)
        for name, fd in (("stdout", 1), ("stderr", 2)):
            setattr(sys, name, os.fdopen(fd, "w", encoding="utf-8", closefd=False))
        os.chdir(folder)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        work()
        status = 0
        if sys.stdout:
            sys.stdout.flush()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            for stream in (sys.stdout, sys.stderr):
                if stream:
                    stream.flush()
        finally:
            os._exit(status)


def _end(pid: int) -> None:
    """Kills a process with all of its own."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def _content(fd: int) -> str:
    os.lseek(fd, 0, os.SEEK_SET)
    return os.read(fd, 2**20).decode("utf-8", "replace")


def command(*words: object) -> Callable[[], None]:
    """Returns the work of `hyrl-mj` with these words."""

    def work() -> None:
        sys.argv = ["hyrl-mj", *map(str, words)]
        cli.main()

    return work


def limited(work: Callable[[], object], more: int) -> Callable[[], None]:
    """Returns some work that may ask for so much more memory [MB]: a bomb must not end other processes."""

    def done() -> None:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        now = next(int(line.split()[1]) for line in lines if line.startswith("VmData"))
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (now * 1024 + more * 2**20, hard))
        work()

    return done


def resisted(
    work: Callable[[], object],
    folder: Path,
    most: float,
    ended: tuple[int, ...] = (0, 1, 2),
    seconds: float = SECONDS,
) -> str:
    """Returns what is wrong with the answer of the command line to something hostile, "" if nothing is.

    Args:
        most: the memory that something honest takes [MB].
        ended: the exit statuses that it may have.
        seconds: within which it must be refused; what is accepted takes as long as it takes.
    """
    answer = child(limited(work, MOST), folder, seconds=3 * seconds)
    if broke := answer.broke(ended):
        return broke
    # Python's own search gives up in a thousand folders, each in the one before.
    search = ["find", folder, "-name", MARKER]
    if subprocess.run(search, capture_output=True, check=True).stdout:
        return "code of a stranger's was executed"
    if answer.memory > most + MEMORY:
        return f"takes {answer.memory - most:.0f} MB more than something honest"
    if answer.status == 2 and len(answer.err.strip()) > LONGEST:
        return f"a sentence of {len(answer.err)} characters"
    if answer.status == 2 and answer.seconds[1] > seconds:
        return f"takes {answer.seconds[1]:.0f} s to be refused"
    return ""


def files(folder: Path) -> dict[str, Path]:
    """Returns the files of a run directory by name, without logs and the lock."""
    paths = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))}
    return {
        name: path
        for name, path in paths.items()
        if path.is_file() and name != ".lock" and not name.startswith("logs/")
    }


def differences(one: Path, other: Path) -> str:
    """Returns in which files two run directories differ, "" if they do not."""
    ours, theirs = files(one), files(other)
    wrong = [f"{name} is left over" for name in ours.keys() - theirs.keys()]
    wrong += [f"{name} is missing" for name in theirs.keys() - ours.keys()]
    wrong += [
        f"{name} has other bytes"
        for name in ours.keys() & theirs.keys()
        if ours[name].read_bytes() != theirs[name].read_bytes()
    ]
    return ", ".join(sorted(wrong))
