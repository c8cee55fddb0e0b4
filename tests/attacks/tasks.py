"""Task files and MJCFs with one mistake each, made from those that `hyrl-mj new-task` writes."""

from functools import partial
from pathlib import Path
from random import Random

from attacks import Trial, child, command
from attacks.material import Material
from attacks.mistaken_models import MODELS
from attacks.mistaken_tasks import TASKS

NAME = "puck"
# Limits on what a mistaken task may take: it is refused, or its training fails.
SECONDS = 60.0


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each mistake, or some of them."""
    every = [
        Trial(f"{kind}: {name}", partial(_attempt, suffix, old, new))
        for kind, suffix, mistakes in (("task file", ".py", TASKS), ("MJCF", ".xml", MODELS))
        for name, (old, new) in mistakes.items()
    ]
    return every if count >= len(every) else draw.sample(every, count)


def _attempt(suffix: str, old: str, new: str, folder: Path) -> str:
    """Makes a mistake in a new task, and runs it: no report may come of it."""
    written = child(command("new-task", NAME), folder)
    if broke := written.broke(ended=(0,)):
        return broke
    path = folder / f"{NAME}{suffix}"
    text = path.read_text(encoding="utf-8")
    if old not in text:
        return f"the attack itself failed: {old!r} is not in {path.name}"
    path.write_text(new if old == text else text.replace(old, new), encoding="utf-8")
    before = {file.name for file in folder.iterdir()}
    answer = child(
        command("run", f"{NAME}.py", "--preset", "smoke", "--out", "out"), folder, seconds=SECONDS
    )
    if broke := answer.broke(ended=(1, 2)):
        finished = (folder / "out" / "report.html").exists()
        return f"{'a finished report; ' if finished else ''}{broke}"
    if answer.status == 1 and (folder / "out" / "report.html").exists():
        return ""  # said to have failed, with everything on disk
    left = {file.name for file in folder.iterdir()} - before - {"out", "__pycache__"}
    return f"leaves {', '.join(left)} in the working directory" if left else ""
