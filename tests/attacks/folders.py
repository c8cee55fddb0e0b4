"""Folders of a stranger, with odd names, odd texts and modules that nobody asked for, and used by threads."""

import csv
import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from html import unescape
from itertools import chain
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import hyrl_mj
from attacks import child, command, resisted
from attacks.crafted_runs import evil
from attacks.forgery import setting, write
from attacks.honest import ARGUMENTS
from attacks.material import RUN, TASK, Material
from attacks.small import become_nobody
from hyrl_mj.pipeline.comparing import _code

SECRET = "this is the user's own"
ESCAPE = "\x1b]0;owned\x07"
# Modules that an installed one might import, and modules of a stranger's: all lie in the current folder.
MODULES = (
    "imageio",
    "glfw",
    "yaml",
    "click",
    "mujoco",
    "evil",
    "gymnasium_robotics",
    "ogbench",
    "shimmy",
    "sitecustomize",
    "multiprocessing",
    "pickle",
)
# The command line in a new process.
PROGRAM = "import sys; from hyrl_mj.cli import main; sys.argv[0] = 'hyrl-mj'; main()"
# Names of run directories that a shell, a format or a parser could take for something else.
PATHS = (
    " a b ", "it's", 'q"q', "-dash", "--out", "x" * 200, "über", "$(touch executed)", "`touch executed`",
    "a;touch executed", "%s%n", "{0}", "back\\slash", "#", "~", "a&b<c>", "*", "\u202egnp", "new\nline",
    "byte \udcff",
)  # fmt: skip
# What programs could take for more than a text.
TEXTS = (
    "=cmd|'calc'!A0", "@SUM(1)", "| a |", "<img src=x onerror=alert(1)>", ESCAPE, "evil.py",
    "[x](javascript:alert(1))", "env:{}", "../..", f"env:{json.dumps({'env': 'evil:X-v0'})}",
)  # fmt: skip


def plant_modules(folder: Path) -> None:
    """Puts modules into the current folder that leave the marker behind."""
    for name in MODULES:
        evil(folder, f"{name}.py")


def modules(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """Modules in the current folder of a new process, which has imported nothing yet."""
    plant_modules(folder)
    explain = ("diagnose", "--explain", "--env", "Reacher-v5", "--env-args", "arguments.json")
    (folder / "arguments.json").write_text(json.dumps(ARGUMENTS), encoding="utf-8")
    words = draw.choice((("doctor",), ("list",), ("report", "."), explain, explain))

    def work() -> None:
        command = [sys.executable, "-P", "-c", PROGRAM, *words]
        sys.exit(subprocess.run(command, check=False).returncode)

    return resisted(work, folder, memory, seconds=60)


def path(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A run directory, a folder of a task, and a file to write that somebody may have: all with odd names."""
    run, out = draw.choice(PATHS), draw.choice(PATHS)
    material.copy(folder).rename(folder / run)
    if broke := child(command("new-task", "robot", "--folder", f"./{run}"), folder).broke(
        ended=(0,)
    ):
        return broke
    words, made = draw.choice(
        (
            (("report", run, "--out", f"{out}.html"), f"{out}.html"),
            (("export", run, "--to", "numpy", "--out", out), f"{out}/controller.py"),
            (("export", run, "--to", "onnx", "--out", f"{out}.onnx"), f"{out}.onnx"),
            (("replay", run, "--out", f"{out}.png"), f"{out}.png"),
            (("simulate", run), f"{out}.png"),
            (("run", f"{run}/robot.py", "--preset", "smoke", "--out", out), f"{out}/config.json"),
        )
    )
    theirs = folder / made
    if has := draw.random() < 0.5 and not theirs.exists():
        theirs.parent.mkdir(exist_ok=True)
        theirs.write_text(SECRET, encoding="utf-8")
    broke = resisted(command(*words), folder, memory)
    if not broke and has and theirs.read_text(encoding="utf-8", errors="replace") != SECRET:
        return f"overwrites {made!r}, which it has not written"
    return broke


def user(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A run of another user, of which some parts cannot be read, and others cannot be written."""
    run = material.copy(folder)
    folder.chmod(0o777)
    for part in draw.sample([run, *run.rglob("*")], 4):
        part.chmod(draw.choice((0o555, 0o111, 0) if part.is_dir() else (0o444, 0)))
    words = draw.choice(
        (
            ("report", TASK),
            ("report", TASK, "--out", "page.html"),
            ("export", TASK, "--to", "numpy", "--out", "controller"),
            ("simulate", TASK),
            ("extended-sets", TASK),
            RUN,
        )
    )

    def work() -> None:
        become_nobody()
        command(*words)()

    return resisted(work, folder, memory)


def threads(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A run that several threads open and use at once."""
    run_directory = material.copy(folder)

    def work() -> None:
        def used(number: int) -> bytes:
            run = hyrl_mj.load_run(run_directory)
            q, measured = np.zeros(8, dtype=int), np.full((8, 1), 0.5 + number % 2)
            return b"".join(np.asarray(part).tobytes() for part in run.controller.step(q, measured))

        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(used, range(16)))
        assert len({*found[::2]}) == 1
        assert len({*found[1::2]}) == 1

    return resisted(work, folder, memory)


def sweep(material: Material, memory: float, draw: Random, folder: Path) -> str:
    """A received folder of a sweep, whose texts are formulas, links, escapes and elements."""
    plant_modules(folder)
    (folder / "sweep").mkdir()
    setting(material.copy(folder / "sweep"), "task", draw.choice(TEXTS))
    row: dict[str, Any] = {
        "setting": {"task": draw.choice(TEXTS), "algorithm": draw.choice(TEXTS), "eps": 0.1},
        "seed": 0, "state": draw.choice(("done", "stopped")), "verdict": draw.choice(TEXTS),
        "sentence": draw.choice(TEXTS), "seconds": 1.0, "figures": {draw.choice(TEXTS): 1.0},
    }  # fmt: skip
    common = {"preset": "fast", "horizon": None, "set": {}, "everywhere": False}
    write(folder / "sweep" / "sweep.json", {"common": common, "rows": [row]})
    broke = resisted(command("sweep", "--report", "sweep"), folder, memory)
    return broke or _formulas(folder / "sweep") or _spoken(folder / "sweep" / "sweep.html")


def comparison(memory: float, draw: Random, folder: Path) -> str:
    """A received folder of a comparison, whose rows are done."""
    (folder / "compare").mkdir()
    numbers = (0.5, float("nan"), float("inf"), 1e300, int("9" * 400))

    def row(name: str, **more: Any) -> dict[str, Any]:
        figures = {"worst": 0.5, "won": 0.5, "late": 0.0}
        usual = {
            "title": name,
            "seed": 0,
            "state": "done",
            "sentence": "",
            "tried": {},
            "samples": 1,
        }
        # By their code, which a stranger knows, too, the rows are not made anew.
        code = _code(hyrl_mj.get_task(TASK), name)
        return {"name": name, **usual, "seconds": 1.0, "figures": figures, "code": code} | more

    other = row(draw.choice(TEXTS), **draw.choice((
        {"title": draw.choice((*TEXTS, "$x^$", "a" * 100_000)), "sentence": draw.choice(TEXTS)},
        {"tried": dict.fromkeys(TEXTS, 0.5), "sentence": "a" * 100_000},
        {"figures": {"worst": draw.choice(numbers), draw.choice(TEXTS): draw.choice(numbers)}},
        {"figures": draw.choice(({}, {"won": 0.5}, {"worst": 0.5, "attacked": -1e-30}))},
        {"samples": draw.choice(numbers), "seed": draw.choice(numbers)},
        {"state": "unfit", "sentence": draw.choice(TEXTS)},
    )))  # fmt: skip
    others = [other | {"name": f"{i}"} for i in range(draw.choice((1, 1, 1, 60, 5_000)))]
    content = {
        "task": "unit_circle", "eps": 0.1, "preset": "smoke", "lasting": True,
        "set": draw.choice(({}, {}, {"a": [[] for _ in range(100_000)]})),
        "rows": [row("policy"), row("hyrl"), *others],
    }  # fmt: skip
    write(folder / "compare" / "compare.json", content)
    words = ("compare", "unit_circle", "--preset", "smoke", "--only", "policy", "--out", "compare")
    broke = resisted(command(*words), folder, memory)
    return broke or _spoken(folder / "compare" / "compare.html")


def _formulas(folder: Path) -> str:
    """Returns which cell of `sweep.csv` a spreadsheet would take for a formula."""
    if not (folder / "sweep.csv").exists():
        return ""
    with (folder / "sweep.csv").open(encoding="utf-8", newline="") as file:
        for cell in chain(*csv.reader(file)):
            if cell.startswith(("=", "+", "-", "@")):
                return f"sweep.csv has the formula {cell!r}"
    return ""


def _spoken(file: Path) -> str:
    """Returns which text in the tables of a page a program would take for more than a text."""
    page = file.read_text(encoding="utf-8") if file.exists() else ""
    if "<img src=x" in page or re.search("(?i)(href|src)=.javascript:", page):
        return f"{file.name} holds an element of the stranger's"
    table = unescape(page.partition("<pre><code>")[2].partition("</code></pre>")[0])
    if re.search(r"(?<!\\)[<[]", table):
        return f"the table to paste as Markdown holds an element or a link: {table!r}"
    columns = {len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}
    return f"a text makes columns in Markdown: {table!r}" if len(columns) > 1 else ""
