"""The finished runs that are attacked, made when they are first asked for."""

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from attacks import Answer, child, command
from attacks.small import shorten  # noqa: F401

TASK = "unit_circle"
SMOKE = ("--preset", "smoke", "--out")
RUN = ("run", TASK, *SMOKE, TASK)


@dataclass(frozen=True)
class Material:
    """Runs of preset smoke, which nothing disturbed.

    Attributes:
        folder: where they are.
    """

    folder: Path

    def finished(self, *options: str, of: str = TASK) -> Path:
        """Returns the run directory of `hyrl-mj run` of a task with these options."""
        path = self.folder / "_".join(("material", of, *options)).replace("-", "")
        if not path.exists():
            path.mkdir()
            self.do(path, [("run", of, *SMOKE, of, *options)])
        return path / of

    def do(self, folder: Path, commands: Iterable[tuple[str, ...]]) -> list[Answer]:
        """Gives commands in a folder, which must succeed."""
        answers = []
        for words in commands:
            answer = child(command(*words), folder, seconds=300)
            # A run of preset smoke may fail to control the robot; its files are made none the less.
            if broke := answer.broke(ended=(0, 1)):
                raise SystemExit(f"hyrl-mj {' '.join(words)}: {broke}")
            answers.append(answer)
        return answers

    def copy(self, folder: Path, *options: str) -> Path:
        """Returns a copy of a finished run in a folder; nothing is shared with it."""
        return Path(shutil.copytree(self.finished(*options), folder / TASK))
