"""The results of a comparison with what people would do instead: a row for each alternative and seed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.files.manifest import may_hold
from hyrl_mj.runs.improvement import Mean, mean

NAME = "compare.json"


@dataclass(frozen=True)
class Row:
    """What became of one alternative with one seed.

    Attributes:
        name, title: of the alternative.
        seed: the seed.
        state: "open", "done", or "unfit" for the task.
        sentence: which setting was taken, or why it is unfit.
        tried: by setting, the share of starts by which it was chosen.
        samples: of the environment, that its training took.
        seconds: that making and choosing it took [s].
        figures: the results by name.
        code: a digest of all code that made it; another one makes it anew.
    """

    name: str
    title: str
    seed: int
    state: Literal["open", "done", "unfit"] = "open"
    sentence: str = ""
    tried: dict[str, float] = field(default_factory=dict)
    samples: int = 0
    seconds: float = 0.0
    figures: dict[str, float] = field(default_factory=dict)
    code: str = ""


@dataclass(frozen=True)
class Compared:
    """A comparison, as `compare.json` holds it.

    Attributes:
        task: the name of the task, or the file that defines it.
        eps: bound of the noise, in the units of the chart.
        preset, set: of HyRL's runs, and the settings that differ from it.
        lasting: whether episodes end at the arrival, so that some can be late.
        rows: the results.
    """

    task: str
    eps: float
    preset: str
    set: dict[str, Any]
    lasting: bool
    rows: tuple[Row, ...] = ()

    def __repr__(self) -> str:
        done = sum(row.state == "done" for row in self.rows)
        return f"Compared({self.task}, eps {self.eps:g}: {done} of {len(self.rows)} rows are done)"

    def row(self, name: str, seed: int) -> Row | None:
        """Returns the row of an alternative and a seed, None if there is none."""
        return next((row for row in self.rows if (row.name, row.seed) == (name, seed)), None)

    def with_row(self, row: Row) -> Compared:
        """Returns the comparison with another row in the place of that of the same name and seed."""
        others = [one for one in self.rows if (one.name, one.seed) != (row.name, row.seed)]
        return replace(self, rows=(*others, row))

    def of(self, name: str) -> list[Row]:
        """Returns the rows of an alternative that are done, by seed."""
        rows = (row for row in self.rows if row.name == name and row.state == "done")
        return sorted(rows, key=lambda row: row.seed)

    def values(self, name: str, figure: str) -> list[float]:
        """Returns a figure of an alternative by seed, without the seeds that lack it."""
        return [row.figures[figure] for row in self.of(name) if figure in row.figures]

    def difference(self, name: str, figure: str) -> Mean:
        """Returns by how much more of a figure HyRL has than an alternative, in the seeds that both have."""
        other, hyrl = ({r.seed: r.figures.get(figure) for r in self.of(n)} for n in (name, "hyrl"))
        pairs = [(other[seed], hyrl[seed], 0.0) for seed in other.keys() & hyrl.keys()]
        return mean([np.array([pair for pair in pairs if None not in pair])], np.array((-1, 1)))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the alternatives that have rows, in the order in which they came."""
        return tuple(dict.fromkeys(row.name for row in self.rows))

    def save(self, folder: Path) -> None:
        """Writes `compare.json`."""
        artifacts.write_json(folder / NAME, self, kind="comparison")

    @staticmethod
    def load(folder: Path) -> Compared:
        """Reads `compare.json` in a folder; raises `BadArtifact` if there is none, or it is damaged."""
        remedy = "give the folder of a comparison, or make one with hyrl-mj compare TASK --out DIR"
        return artifacts.read_record(folder / NAME, "comparison", Compared, remedy)


def opened(folder: Path, fresh: Compared) -> Compared:
    """Returns the comparison in a folder, or a new one.

    Raises:
        BadInput: the folder holds something else, or a comparison with other settings.
    """
    if not (folder / NAME).exists():
        if folder.exists() and not may_hold(folder, NAME):
            raise BadInput(
                f"{folder} exists and is not the folder of a comparison: choose another --out"
            )
        return fresh
    there = replace(Compared.load(folder), lasting=fresh.lasting)
    if replace(there, rows=()) != fresh:
        raise BadInput(
            f"{folder} holds a comparison of {there.task} with eps {there.eps:g}, preset {there.preset} and "
            f"{there.set or 'no'} changed settings: choose another --out, or give the same"
        )
    return there
