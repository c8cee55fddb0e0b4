"""Two and four processes that work on one run directory at a time, and one that reads all along."""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import hyrl_mj
from attacks import Answer, Process, Trial, child, command, differences
from attacks.kills import SWEEP, made_by, whole
from attacks.material import RUN, TASK, Material
from hyrl_mj import BadArtifact

# What several may do at once in one folder: each set of commands is one kind of round.
AGAIN = [("figures", TASK), ("simulate", TASK), ("extended-sets", TASK), ("report", TASK)]
PAGES = [("report", TASK, "--out", "shared.html")]
# What a reader may be told while others write.
HONEST = (
    "is missing",
    "did not finish",
    "older than what",
    "there is no file",
    "not a run directory",
)


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns rounds: whole runs, stages of a finished run, pages and sweeps, by two and by four."""
    material.finished()
    kinds: list[tuple[str, list[tuple[str, ...]], bool]] = [
        ("stages of a finished run", AGAIN, True),
        ("whole runs", [RUN], False),
        ("reports to one page", PAGES, True),
        ("sweeps", [SWEEP], False),
    ]
    if count >= len(kinds):
        whole(material, "sweep")
    rounds = []
    for number in range(count):
        writers = 4 if number % 2 else 2
        what, commands, finished = kinds[number % len(kinds)]
        chosen = [draw.choice(commands) for _ in range(writers)]
        name = f"round {number}: {writers} x {what}"
        rounds.append(Trial(name, partial(_round, material, chosen, finished)))
    return rounds


def _round(
    material: Material, commands: list[tuple[str, ...]], finished: bool, folder: Path
) -> str:
    """Lets writers work at the same time while one reads, and resumes the run."""
    if finished:
        material.copy(folder)
    work = [command(*words) for words in commands]
    answers = _together([*work, partial(_read, folder)], folder)
    reader = answers.pop()
    if reader.status:
        return f"a damaged read: {reader.err.strip()[-400:]}"
    for words, answer in zip(commands, answers, strict=True):
        if broke := answer.broke(ended=(0, 1, 2)):
            return f"{' '.join(words)}: {broke}"
        if answer.status == 2 and not any(word in answer.err for word in ("another", *HONEST)):
            return f"{' '.join(words)}: a sentence about something else: {answer.err!r}"
    if not any(answer.status in (0, 1) for answer in answers):
        return "nobody won"
    swept = SWEEP in commands
    resumed = child(command(*(SWEEP if swept else RUN)), folder)
    if broke := resumed.broke(ended=(0, 1)):
        return broke
    made, sound = TASK, material.finished()
    if swept:
        made, sound = made_by("sweep"), whole(material, "sweep").path
    wrong = differences(folder / made, sound)
    return f"in the end not as one writer alone: {wrong}" if wrong else ""


def _together(work: list[Callable[[], object]], folder: Path) -> list[Answer]:
    """Does several pieces of work at a time; the last, the reader, ends with the others."""
    processes = [Process(one, folder) for one in work]
    answers: dict[Process, Answer] = {}
    while len(answers) < len(processes):
        for process in processes:
            if process not in answers and (answer := process.answer()):
                answers[process] = answer
        if len(answers) >= len(processes) - 1:
            (folder / "end").touch()
        time.sleep(0.005)
    return [answers[process] for process in processes]


def _read(folder: Path) -> None:
    """Reads the run directory and the page again and again, and fails at the first damaged read."""
    end, reads = Path("end"), 0
    page = Path("shared.html")
    pages = set()
    while not end.exists():
        try:
            run = hyrl_mj.load_run(TASK)
            for result in ("policy", "critical_set", "partition", "extended_sets", "controller"):
                getattr(run, result)
            run.arcs()
            reads += 1
        except BadArtifact as error:
            if not any(word in str(error) for word in HONEST):
                sys.exit(f"after {reads} reads: {error}")
        if page.exists():
            pages.add(page.read_bytes())
        time.sleep(0.01)
    if len(pages) > 1:
        sys.exit(f"{len(pages)} different pages")
