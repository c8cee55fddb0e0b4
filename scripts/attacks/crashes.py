"""Crashes before and after every rename: what is on disk is copied there, and each copy is resumed."""

import os
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from attacks import Trial, child, command, differences
from attacks.material import RUN, TASK, Material
from hyrl_mj import artifacts

HORIZON = ("--horizon", "0.3")
# Names of the copies, as "017_before_policy.json".
COPIES = "{count:03}_{when}_{name}"


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns a trial for each crash of three commands, or some of them."""
    # The trials run side by side: what they compare with is made before.
    material.finished()
    material.finished(*HORIZON)
    examined(material)
    every = [
        *_of_command(material, "a run", RUN, start=False, expected=_usual),
        *_of_command(
            material, "a new horizon", ("extended-sets", TASK, *HORIZON), True, _of_its_horizon
        ),
        *_of_command(
            material, "another examination", ("robustness", TASK, "--eps", "0.3"), True, _examined
        ),
        Trial("a replay that fails after the sets changed", partial(_no_old_video, material)),
    ]
    return every if count >= len(every) else draw.sample(every, count)


Expected = Callable[[Material, Path], Iterator[Path]]


def _of_command(
    material: Material, what: str, words: tuple[str, ...], start: bool, expected: Expected
) -> list[Trial]:
    """Returns the trials of the crashes of one command, on nothing or (`start`) on a finished run."""
    folder = material.folder / what.replace(" ", "_")
    folder.mkdir()
    if start:
        material.copy(folder)
    answer = child(lambda: _recorded(words, folder), folder, seconds=300)
    if broke := answer.broke(ended=(0, 1)):
        raise SystemExit(f"hyrl-mj {' '.join(words)}: {broke}")
    copies = sorted((folder / "copies").iterdir())
    return [
        Trial(f"{what}, crashed at {copy.name}", partial(_resumed, material, copy, expected))
        for copy in copies
    ]


def _recorded(words: tuple[str, ...], folder: Path) -> None:
    """Gives a command, and copies the run directory before and after each rename and removal."""
    count = 0

    def copied(when: str, path: Path) -> None:
        nonlocal count
        if (folder / TASK).is_dir():
            name = COPIES.format(count=count, when=when, name=path.name)
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


def _resumed(material: Material, copy: Path, expected: Expected, folder: Path) -> str:
    """Resumes a run where it crashed, and compares it with those that it may become."""
    path = Path(shutil.copytree(copy / TASK, folder / TASK))
    horizon = _horizon(path)
    answer = child(command(*RUN, *horizon), folder)
    if broke := answer.broke(ended=(0, 1)):
        return broke
    wrong = [differences(path, other) for other in expected(material, path)]
    return "" if "" in wrong else f"not as an uninterrupted run: {min(wrong, key=len)}"


def _horizon(path: Path) -> tuple[str, ...]:
    """Returns the options that config.json calls for."""
    config = path / "config.json"
    return HORIZON if config.exists() and '"horizon": 0.3' in config.read_text() else ()


def _usual(material: Material, path: Path) -> Iterator[Path]:
    yield material.finished()


def _of_its_horizon(material: Material, path: Path) -> Iterator[Path]:
    yield material.finished(*_horizon(path))


def _examined(material: Material, path: Path) -> Iterator[Path]:
    """Yields the runs with the usual examination, and with the other one."""
    yield material.finished()
    yield examined(material)


def examined(material: Material) -> Path:
    """Returns a finished run that was examined at another bound, and resumed."""
    folder = material.folder / "material_examined"
    if not folder.exists():
        material.copy(folder)
        material.do(folder, [("robustness", TASK, "--eps", "0.3"), RUN])
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
