"""Commands that are killed at a random moment, and given again while the clock goes back."""

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from random import Random

from attacks import Trial, child, command, crafted_agents, differences, small
from attacks.honest import FIELD
from attacks.material import RUN, SECONDS, TASK, Material

SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
AGENT = (
    TASK,
    "--policy",
    "agent.zip",
    "--vecnormalize",
    "none",
    "--preset",
    "smoke",
    "--out",
    TASK,
)
# Where a process has the folder of its trial in its environment, and how long it may outlive a command [s].
TRIAL, ENDED = "ATTACK_TRIAL", 10.0
DAY = 86_400.0  # [s]
PICTURE = "drive.png"
# Ray's processes make no smaller runs than these.
FEW = [f"{name}={value}" for name, value in small.FEW.items()]
SWEEP = ("sweep", TASK, "--preset", "smoke", "--cores", "1", "--set", *FEW, "--out", "sweep")
COMMANDS = {
    "diagnose": ("diagnose", *AGENT),
    "run": RUN,
    "robustify": ("robustify", *AGENT),
    "drive": ("drive", "field", "--field", "field.json", "--out", PICTURE),
    "sweep": SWEEP,
}
# Of so many kills those of each command: of those that take long fewer.
SHARES = {"run": 4, "diagnose": 14, "robustify": 4, "drive": 26, "sweep": 2}


@dataclass(frozen=True)
class Whole:
    """A command that nothing disturbed: what it made, and how long it took [s]."""

    path: Path
    seconds: float


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns trials at moments that are spread over the time that each command takes."""
    found = []
    for name in [*COMMANDS][:count]:
        made = whole(material, name)
        several = max(count * SHARES[name] // sum(SHARES.values()), 1)
        for number in range(several):
            moment = made.seconds * (number + draw.random()) / several
            sent = SIGNALS[number % len(SIGNALS)]
            what = f"{name}, {sent.name} after {moment:.2f} s"
            attempt = partial(_killed, material, name, made.path, (moment, int(sent)))
            found.append(Trial(what, attempt))
    return found


@cache
def whole(material: Material, name: str) -> Whole:
    """Gives a command that nothing disturbs."""
    if name == "run":
        path = material.finished()
        return Whole(path, float((path.parent / SECONDS).read_text(encoding="utf-8")))
    folder = material.folder / f"whole_{name}"
    folder.mkdir()
    prepare(material, name, folder)
    (answer,) = material.do(folder, [COMMANDS[name]])
    assert (folder / made_by(name)).exists(), name
    return Whole(folder / made_by(name), answer.seconds[0])


def made_by(name: str) -> str:
    """Returns what is compared of what a command makes."""
    return {"drive": PICTURE, "sweep": f"sweep/{TASK}-0.1-0"}.get(name, TASK)


def differing(made: Path, other: Path) -> str:
    """Returns in what the same command has made something else, "" if it has not."""
    if made.is_dir():
        return differences(made, other)
    return "" if made.read_bytes() == other.read_bytes() else f"another {made.name}"


def prepare(material: Material, name: str, folder: Path) -> None:
    """Puts what a command reads into a folder."""
    crafted_agents.write_zip(folder)
    (folder / "field.json").write_text(json.dumps(FIELD), encoding="utf-8")
    if name == "drive":
        shutil.copytree(material.field(), folder / "field")


def _killed(
    material: Material, name: str, other: Path, sent: tuple[float, int], folder: Path
) -> str:
    """Kills a command, gives it again, and compares what it made with what one made that was not killed."""
    prepare(material, name, folder)
    work, made = command(*COMMANDS[name]), folder / made_by(name)
    killed = child(partial(_marked, work, folder), folder, sent=sent)
    ended = (0, 1, 130, -signal.SIGKILL, -signal.SIGTERM)
    if broke := killed.broke(ended):
        return broke
    if left := _left_by(folder):
        return f"killed, {name} leaves processes: {left}"
    if made.is_file() and differing(made, other):
        return f"killed, {name} has written another {made.name}"
    if broke := child(partial(_set_back, work, folder), folder).broke(ended=(0, 1)):
        return broke
    wrong = differing(made, other)
    return f"not as an uninterrupted {name}: {wrong}" if wrong else ""


def _set_back(work: Callable[[], None], folder: Path) -> None:
    """Does some work among files of the future, while the clock is set back by a day."""
    began, now = time.time(), time.time
    for path in folder.rglob("*"):
        os.utime(path, (began + DAY, began + DAY))

    def read() -> float:
        return now() - DAY * (now() > began + 1)

    time.time, time.time_ns = read, lambda: int(1e9 * read())
    work()


def _marked(work: Callable[[], None], folder: Path) -> None:
    """Does some work, whose processes all have the folder in their environment."""
    os.environ[TRIAL] = str(folder)
    work()


def _left_by(folder: Path) -> str:
    """Returns the commands of processes that are left by a command, after some time to end."""
    until, mark = time.monotonic() + ENDED, f"{TRIAL}={folder}".encode()
    while left := [
        path.parent for path in Path("/proc").glob("[0-9]*/environ") if _has(path, mark)
    ]:
        if time.monotonic() > until:
            commands = [(path / "cmdline").read_bytes().split(b"\0") for path in left]
            return ", ".join(os.fsdecode(b" ".join(words[:3])) for words in commands)
        time.sleep(0.2)
    return ""


def _has(path: Path, mark: bytes) -> bool:
    with suppress(OSError):  # it has just ended
        return mark in path.read_bytes().split(b"\0")
    return False
