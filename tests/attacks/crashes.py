"""Crashes before and after every rename: what is on disk is copied there, and each copy is resumed."""

import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from attacks import Trial, child, command, differences
from attacks.material import RUN, TASK, Material
from hyrl_mj.files import artifacts

HORIZON = ("--horizon", "0.3")
# The commands that crash, by what they make; all but the first change a finished run.
COMMANDS: dict[str, tuple[str, ...]] = {
    "a run": RUN,
    "a new horizon": ("extended-sets", TASK, *HORIZON),
    "another examination": ("robustness", TASK, "--eps", "0.3"),
}
# Fewer trials than this are made with one of the commands.
FEW = 20


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each crash, or some of them."""
    commands = [*COMMANDS] if count >= FEW else draw.sample([*COMMANDS], 1)
    every = [Trial("a replay that fails after the sets changed", partial(_no_old_video, material))]
    for what in commands:
        # The trials run side by side: what they compare with is made before.
        finished = {(): [material.finished()]}
        if what == "a new horizon":
            finished[HORIZON] = [material.finished(*HORIZON)]
        elif what == "another examination":
            finished[()].append(_examined(material))
        every += [
            Trial(f"{what}, crashed at {copy.name}", partial(_resumed, copy, finished))
            for copy in _copies(material, what)
        ]
    return every if count >= len(every) else draw.sample(every, count)


def _copies(material: Material, what: str) -> list[Path]:
    """Gives a command, and returns copies of what is on disk before and after every rename."""
    folder = material.folder / what.replace(" ", "_")
    folder.mkdir()
    if COMMANDS[what] != RUN:
        material.copy(folder)
    answer = child(lambda: _recorded(COMMANDS[what], folder), folder, seconds=300)
    if broke := answer.broke(ended=(0, 1)):
        raise SystemExit(f"hyrl-mj {' '.join(COMMANDS[what])}: {broke}")
    return sorted((folder / "copies").iterdir())


def _recorded(words: tuple[str, ...], folder: Path) -> None:
    """Gives a command, and copies the run directory before and after each rename and removal."""
    count = 0

    def copied(when: str, path: Path) -> None:
        nonlocal count
        if (folder / TASK).is_dir():
            name = f"{count:03}_{when}_{path.name}"
            logs = shutil.ignore_patterns("logs")
            shutil.copytree(folder / TASK, folder / "copies" / name / TASK, ignore=logs)
            count += 1

    def around(done: Callable[..., Any], named: Callable[..., Path]) -> Callable[..., Any]:
        def recorded(*arguments: Any, **more: Any) -> Any:
            path = named(*arguments)
            temporary = artifacts.TEMPORARY.fullmatch(path.name)
            if temporary or not path.is_relative_to(Path(TASK)) or "logs" in path.parts:
                return done(*arguments, **more)
            copied("before", path)
            result = done(*arguments, **more)
            copied("after", path)
            return result

        return recorded

    Path.replace = around(Path.replace, lambda source, target: Path(target))  # type: ignore[method-assign]
    Path.unlink = around(Path.unlink, lambda path: path)  # type: ignore[method-assign]
    os.makedirs("copies")
    command(*words)()


def _resumed(copy: Path, finished: dict[tuple[str, ...], list[Path]], folder: Path) -> str:
    """Resumes a run where it crashed, and compares it with those that it may become, by its options."""
    path = Path(shutil.copytree(copy / TASK, folder / TASK))
    config = path / "config.json"
    options = HORIZON if config.exists() and '"horizon": 0.3' in config.read_text() else ()
    answer = child(command(*RUN, *options), folder)
    if broke := answer.broke(ended=(0, 1)):
        return broke
    wrong = [differences(path, other) for other in finished[options]]
    return "" if "" in wrong else f"not as an uninterrupted run: {min(wrong, key=len)}"


def _examined(material: Material) -> Path:
    """Returns a finished run that was examined at another bound, and resumed."""
    folder = material.folder / "material_examined"
    folder.mkdir()
    material.copy(folder)
    material.do(folder, [COMMANDS["another examination"], RUN])
    return folder / TASK


def _no_old_video(material: Material, folder: Path) -> str:
    """Renders nothing after the sets have changed: the report must not show the old video."""
    from hyrl_mj import NoRenderer
    from hyrl_mj.viz import replay

    def fail(*arguments: Any, **more: Any) -> None:
        raise NoRenderer("no GL library here")

    def work() -> None:
        replay.render_replay = fail
        command(*RUN, *HORIZON)()

    path = material.copy(folder)
    material.do(folder, [("extended-sets", TASK, *HORIZON)])
    answer = child(work, folder)
    if broke := answer.broke(ended=(0, 1)):
        return broke
    page = (path / "report.html").read_text(encoding="utf-8")
    return "the report embeds the old video" if "data:video" in page else ""
