"""Commands that are killed at a random moment, and given again."""

import signal
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random

from attacks import Trial, child, command, crafted_agents, differences
from attacks.material import RUN, TASK, Material

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
COMMANDS = {"run": RUN, "diagnose": ("diagnose", *AGENT), "robustify": ("robustify", *AGENT)}


@dataclass(frozen=True)
class Whole:
    """A command that nothing disturbed: what it made, and how long it took [s]."""

    path: Path
    seconds: float


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns trials at moments that are spread over the time that each command takes."""
    found, chosen = [], [*COMMANDS][:count]
    for place, name in enumerate(chosen):
        whole, several = _whole(material, name), len(range(place, count, len(chosen)))
        for number in range(several):
            moment = whole.seconds * (number + draw.random()) / several
            sent = SIGNALS[number % len(SIGNALS)]
            what = f"{name}, {sent.name} after {moment:.2f} s"
            found.append(Trial(what, partial(_killed, name, whole.path, (moment, int(sent)))))
    return found


def _whole(material: Material, name: str) -> Whole:
    folder = material.folder / f"whole_{name}"
    folder.mkdir()
    crafted_agents.write_zip(folder)
    (answer,) = material.do(folder, [COMMANDS[name]])
    return Whole(folder / TASK, answer.seconds[0])


def _killed(name: str, whole: Path, sent: tuple[float, int], folder: Path) -> str:
    """Kills a command, gives it again, and compares what it made with what one made that was not killed."""
    crafted_agents.write_zip(folder)
    work = command(*COMMANDS[name])
    killed = child(work, folder, sent=sent)
    ended = (0, 1, 130, -signal.SIGKILL, -signal.SIGTERM)
    if broke := killed.broke(ended) or child(work, folder).broke(ended=(0, 1)):
        return broke
    wrong = differences(folder / TASK, whole)
    return f"not as an uninterrupted {name}: {wrong}" if wrong else ""
