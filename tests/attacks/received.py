"""Files of a stranger: payloads, links, bombs, absurd shapes, in agents and in run directories."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random

from attacks import (
    MARKER,
    Trial,
    child,
    command,
    crafted_agents,
    crafted_models,
    crafted_runs,
    limited,
)
from attacks.damage import open_everything
from attacks.material import RUN, TASK, Material

SECONDS, MEMORY = 10.0, 200.0  # [s], [MB] above that of an honest file
LIMIT = 2_000  # [MB] that a process may ask for
# What must neither change nor be shown: it lies beside what was received.
VICTIM, SECRET = "victim", "this is the user's own text, and nobody else's"
Work = Callable[[], object]


@dataclass(frozen=True)
class Most:
    """The memory that honest files take [MB], by what is done with them."""

    agent: float
    run: float


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each crafted file, or some of them."""
    most = _most(material)
    agents = crafted_agents.FILES | crafted_models.FILES
    every = [
        Trial(f"agent: {name}", partial(_agent, build, most.agent))
        for name, build in agents.items()
    ]
    every += [
        Trial(f"run directory: {name}", partial(_run, material, build, most.run))
        for name, build in crafted_runs.DIRECTORIES.items()
    ]
    return every if count >= len(every) else draw.sample(every, count)


def _most(material: Material) -> Most:
    """Returns the memory that honest files take, after which nothing honest is refused, either."""
    folder = material.folder / "honest"
    folder.mkdir()
    highest = []
    for name in crafted_agents.honest(folder):
        answer = child(_diagnose(name), folder)
        if answer.status:
            raise SystemExit(f"the honest {name} is refused: {answer.err}")
        highest.append(answer.memory)
    path = material.copy(folder)
    answers = [child(work, folder) for work in _works(path)]
    return Most(max(highest), max(answer.memory for answer in answers))


def _diagnose(name: str) -> Work:
    return command("diagnose", TASK, "--policy", name, "--preset", "smoke", "--out", f"of_{name}")


def _works(path: Path) -> list[Work]:
    """Returns what is done with a run directory: it is opened, reported, continued and changed."""
    return [
        partial(open_everything, path),
        command("report", TASK, "--out", "page.html"),
        command("export", TASK, "--to", "numpy", "--out", "controller"),
        command("simulate", TASK),
        command(*RUN),
    ]


def _agent(build: Callable[[Path], str], most: float, folder: Path) -> str:
    """Examines a crafted agent, which must be refused."""
    _hide(folder)
    name = build(folder)
    broke = _broke(_diagnose(name), folder, most, ended=(2,))
    return broke or _touched(folder)


def _run(material: Material, build: Callable[[Path, Path], None], most: float, folder: Path) -> str:
    """Opens a crafted run directory in every way, none of which may do harm."""
    _hide(folder)
    path = material.copy(folder)
    build(folder, path)
    for work in _works(path):
        if broke := _broke(work, folder, most) or _touched(folder):
            return broke
    return ""


def _broke(work: Work, folder: Path, most: float, ended: tuple[int, ...] = (0, 1, 2)) -> str:
    """Returns what is wrong with an answer to a crafted file."""
    answer = child(limited(work, LIMIT), folder, seconds=3 * SECONDS)
    if broke := answer.broke(ended):
        return broke
    if answer.memory > most + MEMORY:
        return f"takes {answer.memory - most:.0f} MB more than an honest file"
    # An accepted file is worked with, which takes as long as it takes.
    if answer.status == 2 and answer.seconds[1] > SECONDS:
        return f"takes {answer.seconds[1]:.0f} s to be refused"
    return ""


def _hide(folder: Path) -> None:
    """Puts files of the user's beside what was received."""
    (folder / VICTIM).mkdir()
    for name in ("secret.txt", "start0_policy.npz", "overview.png", "policy.json", "evil.txt"):
        (folder / VICTIM / name).write_text(SECRET, encoding="utf-8")


def _touched(folder: Path) -> str:
    """Returns whether code of the file ran, and what became of the user's files."""
    if any(folder.rglob(MARKER)):
        return "code of the file was executed"
    victims = sorted((folder / VICTIM).iterdir())
    if len(victims) != 5 or any(v.read_text(encoding="utf-8") != SECRET for v in victims):
        return "files of the user's were changed, removed or added"
    pages = [*folder.glob("*.html"), folder / TASK / "report.html"]
    for page in pages:
        if page.is_file() and page.stat().st_nlink > 1:
            continue  # a second name of the user's file, until a report takes its place
        text = page.read_text(encoding="utf-8") if page.is_file() else ""
        if SECRET in text or crafted_runs.ENCODED in text:
            return f"{page.name} shows a file of the user's"
        if crafted_runs.SCRIPT in text:
            return f"{page.name} holds a script of the file's"
    return ""
