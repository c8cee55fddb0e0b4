"""Commands that are killed at a random moment, and given again."""

import json
import shutil
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
FIELD = {
    "goal_m": [4.0, 0.0],
    "posts": [{"radius_m": 0.3, "positions_m": [[2.0, 0.1]]}],
    "starts": [{"position_m": [0.0, 0.0], "heading_rad": 0.0}],
    "time_s": 1.0,
}
PICTURE = "drive.png"
SWEEP = ("sweep", TASK, "--preset", "smoke", "--seeds", "0", "--cores", "1", "--out", "sweep")
COMMANDS = {
    "run": RUN,
    "diagnose": ("diagnose", *AGENT),
    "robustify": ("robustify", *AGENT),
    "drive": ("drive", "field", "--field", "field.json", "--out", PICTURE),
    "sweep": SWEEP,
}
# What is compared of what a command makes.
MADE = {"drive": PICTURE, "sweep": f"sweep/{TASK}-0.1-0"}
# A sweep takes half a minute, of which Ray takes most: it is killed once where others are several times.
OFTEN = {"sweep": 1 / 5}


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
        several = max(round(several * OFTEN.get(name, 1)), 1)
        for number in range(several):
            moment = whole.seconds * (number + draw.random()) / several
            sent = SIGNALS[number % len(SIGNALS)]
            what = f"{name}, {sent.name} after {moment:.2f} s"
            attempt = partial(_killed, material, name, whole.path, (moment, int(sent)))
            found.append(Trial(what, attempt))
    return found


def _whole(material: Material, name: str) -> Whole:
    folder = material.folder / f"whole_{name}"
    folder.mkdir()
    _prepare(material, name, folder)
    (answer,) = material.do(folder, [COMMANDS[name]])
    made = folder / MADE.get(name, TASK)
    assert made.exists(), name
    return Whole(made, answer.seconds[0])


def _prepare(material: Material, name: str, folder: Path) -> None:
    """Puts what a command reads into a folder."""
    crafted_agents.write_zip(folder)
    (folder / "field.json").write_text(json.dumps(FIELD), encoding="utf-8")
    if name == "drive":
        shutil.copytree(material.field(), folder / "field")


def _killed(
    material: Material, name: str, whole: Path, sent: tuple[float, int], folder: Path
) -> str:
    """Kills a command, gives it again, and compares what it made with what one made that was not killed."""
    _prepare(material, name, folder)
    work, made = command(*COMMANDS[name]), folder / MADE.get(name, TASK)
    killed = child(work, folder, sent=sent)
    ended = (0, 1, 130, -signal.SIGKILL, -signal.SIGTERM)
    if broke := killed.broke(ended):
        return broke
    if made.is_file() and made.read_bytes() != whole.read_bytes():
        return f"an uninterrupted {name} writes another {made.name}"
    if broke := child(work, folder).broke(ended=(0, 1)):
        return broke
    if made.is_file():
        same = made.read_bytes() == whole.read_bytes()
        return "" if same else f"not the {made.name} of an uninterrupted {name}"
    wrong = differences(made, whole)
    return f"not as an uninterrupted {name}: {wrong}" if wrong else ""
