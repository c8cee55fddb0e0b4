"""Runs that are killed at a random moment, once or twice, and resumed."""

import signal
from functools import partial
from pathlib import Path
from random import Random

from attacks import Trial, child, command, differences
from attacks.material import RUN, TASK, Material

SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns trials at moments that are spread over the time that a run takes."""
    material.finished()
    folder = material.folder / "timed"
    folder.mkdir()
    (whole,) = material.do(folder, [RUN])
    found = []
    for number in range(count):
        moment = whole.seconds[0] * (number + draw.random()) / count
        sent = SIGNALS[number % len(SIGNALS)]
        name = f"{sent.name} after {moment:.2f} s"
        found.append(Trial(name, partial(_killed, material, (moment, int(sent)))))
    return found


def _killed(material: Material, sent: tuple[float, int], folder: Path) -> str:
    """Kills a run, resumes it, and compares it with one that was not killed."""
    killed = child(command(*RUN), folder, sent=sent)
    ended = (0, 1, 130, -signal.SIGKILL, -signal.SIGTERM)
    if broke := killed.broke(ended) or child(command(*RUN), folder).broke(ended=(0, 1)):
        return broke
    wrong = differences(folder / TASK, material.finished())
    return f"not as an uninterrupted run: {wrong}" if wrong else ""
