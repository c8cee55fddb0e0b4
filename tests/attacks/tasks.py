"""Task files and MJCFs with one mistake each, made from those that `hyrl-mj new-task` writes."""

from functools import partial
from pathlib import Path
from random import Random

from attacks import Answer, Trial, child, command
from attacks.material import Material
from attacks.mistaken_models import MODELS
from attacks.mistaken_tasks import TASKS

NAME = "puck"
# What is no mistake after all: the task is the same, or another one, and may run.
HARMLESS = {
    "no state()", "mode_names=()", "mode_names=None", "an entity that grows", 'servo kv="1e9"',
    'keyframe qpos="0"', 'keyframe ctrl="1"',
}  # fmt: skip


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each mistake, or some of them."""
    every = [
        Trial(f"{kind}: {name}", partial(_run if name in HARMLESS else _refused, suffix, old, new))
        for kind, suffix, mistakes in (("task file", ".py", TASKS), ("MJCF", ".xml", MODELS))
        for name, (old, new) in mistakes.items()
    ]
    return every if count >= len(every) else draw.sample(every, count)


def _refused(suffix: str, old: str, new: str, folder: Path) -> str:
    """Runs a task with a mistake: one sentence refuses it before anything is written."""
    answer, before = _answer(suffix, old, new, folder)
    left = {file.name for file in folder.iterdir()} - before - {"__pycache__"}
    return answer.broke(ended=(2,)) or (left and f"writes {', '.join(sorted(left))}") or ""


def _run(suffix: str, old: str, new: str, folder: Path) -> str:
    """Runs a task that was changed without harm: after so little training it may fail, with its report."""
    answer, _ = _answer(suffix, old, new, folder)
    report = folder / "out" / "report.html"
    return answer.broke(ended=(0, 1)) or ("" if report.exists() else "leaves no report")


def _answer(suffix: str, old: str, new: str, folder: Path) -> tuple[Answer, set[str]]:
    """Changes a new task and runs it; returns the answer, and the names of the files before."""
    written = child(command("new-task", NAME), folder)
    assert not written.broke(ended=(0,)), written
    path = folder / f"{NAME}{suffix}"
    text = path.read_text(encoding="utf-8")
    assert old in text, f"{old!r} is not in {path.name}"
    path.write_text(new if old == text else text.replace(old, new), encoding="utf-8")
    before = {file.name for file in folder.iterdir()}
    return child(command("run", f"{NAME}.py", "--preset", "smoke", "--out", "out"), folder), before
