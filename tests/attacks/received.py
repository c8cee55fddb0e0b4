"""Files of a stranger: payloads, links, bombs, absurd shapes, in agents and in run directories."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

from attacks import Trial, crafted_agents, crafted_models, crafted_runs, resisted
from attacks.honest import agent, most, opened_in_every_way
from attacks.material import TASK, Material

# What must neither change nor be shown: it lies beside what was received.
VICTIM, SECRET = "victim", "this is the user's own text, and nobody else's"


def agents(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each crafted agent, or some of them."""
    built = crafted_agents.FILES | crafted_models.FILES
    return [
        Trial(name, partial(_agent, built[name], most(material, "agent")))
        for name in draw.sample([*built], min(count, len(built)))
    ]


def runs(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each crafted run directory, or some of them; each is used in two more ways."""
    built = crafted_runs.DIRECTORIES
    return [
        Trial(
            name,
            partial(
                _run, material, built[name], draw.sample(range(1, 5), 2), most(material, "run")
            ),
        )
        for name in draw.sample([*built], min(count, len(built)))
    ]


def _agent(build: Callable[[Path], str], memory: float, folder: Path) -> str:
    """Reads a crafted agent, which must be refused."""
    _hide(folder)
    name = build(folder)
    return resisted(agent(name), folder, memory, ended=(2,)) or _touched(folder)


def _run(
    material: Material,
    build: Callable[[Path, Path], None],
    ways: list[int],
    memory: float,
    folder: Path,
) -> str:
    """Opens a crafted run directory, and uses it in some ways, none of which may do harm."""
    _hide(folder)
    path = material.copy(folder)
    build(folder, path)
    every = opened_in_every_way(path)
    for work in every[:1] + [every[way] for way in sorted(ways)]:
        if broke := resisted(work, folder, memory) or _touched(folder):
            return broke
    return ""


def _hide(folder: Path) -> None:
    """Puts files of the user's beside what was received."""
    (folder / VICTIM).mkdir()
    for name in ("secret.txt", "start0_policy.npz", "overview.png", "policy.json", "evil.txt"):
        (folder / VICTIM / name).write_text(SECRET, encoding="utf-8")


def _touched(folder: Path) -> str:
    """Returns what became of the user's files."""
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
