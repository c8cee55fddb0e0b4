"""The results of a comparison with what people would do instead: a row for each alternative and seed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import nan
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hyrl_mj.errors import LARGEST_NUMBER, LONGEST, BadArtifact, BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.files.manifest import check_may_hold
from hyrl_mj.runs.improvement import Mean, mean

NAME = "compare.json"
# Rows, alternatives, settings that one of them tried, and characters of a title.
MOST_ROWS, MOST_NAMES, MOST_TRIED, LONGEST_TITLE = 1_000, 50, 20, 100


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

    @property
    def why_not(self) -> str | None:
        """What of it, as a file has it, no comparison writes; None if nothing."""
        if len(self.tried) > MOST_TRIED:
            return f"more than {MOST_TRIED} settings of one alternative"
        if len(self.title) > LONGEST_TITLE or any(
            len(text) > 2 * LONGEST for text in (self.name, self.sentence, *self.tried)
        ):
            return "a title or a sentence that is too long"
        values = (self.seconds, *self.tried.values(), *self.figures.values())
        whole = 0 <= self.seed < 2**32 and 0 <= self.samples <= LARGEST_NUMBER
        if not whole or not all(abs(value) <= LARGEST_NUMBER for value in values):
            return "a number that cannot be right"
        return None


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

    def both(self, name: str) -> np.ndarray:
        """Returns what an alternative and HyRL win under attack, and of how many starts (0 if not known).

        These are rows (n, 3) of the seeds for which both have been attacked.
        """
        other, hyrl = ({row.seed: row.figures for row in self.of(n)} for n in (name, "hyrl"))
        pairs = [(other[s], hyrl[s]) for s in other if s in hyrl]
        both = [pair for pair in pairs if all("worst" in figures for figures in pair)]
        rows = [(a["worst"], b["worst"], b.get("attacked", 0.0)) for a, b in both]
        return np.reshape(rows, (-1, 3))

    def difference(self, name: str) -> Mean:
        """Returns by how much more HyRL wins under attack than an alternative, in the seeds of `both`.

        It is NaN if they have none in common.
        """
        both = self.both(name)
        return mean([both], np.array((-1, 1))) if len(both) else Mean(nan, None)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the alternatives that have rows, in the order in which they came."""
        return tuple(dict.fromkeys(row.name for row in self.rows))

    def save(self, folder: Path) -> None:
        """Writes `compare.json`."""
        artifacts.write_json(folder / NAME, self, kind="comparison")

    @staticmethod
    def load(folder: Path) -> Compared:
        """Reads `compare.json` in a folder; raises `BadArtifact` if there is none, or it cannot be right."""
        remedy = "give the folder of a comparison, or make one with hyrl-mj compare TASK --out DIR"
        found = artifacts.read_record(folder / NAME, "comparison", Compared, remedy)
        rows = found.rows
        if len(rows) > MOST_ROWS or len(found.names) > MOST_NAMES:
            why = f"more than {MOST_ROWS:,} rows of {MOST_NAMES} alternatives"
        elif len({(row.name, row.seed) for row in rows}) < len(rows):
            why = "an alternative twice with one seed"
        elif why_nots := [*filter(None, (row.why_not for row in rows))]:
            why = why_nots[0]
        else:
            return found
        raise BadArtifact(f"{folder / NAME} has {why}: {remedy}")


def opened(folder: Path, fresh: Compared) -> Compared:
    """Returns the comparison in a folder, or a new one.

    Raises:
        BadInput: the folder holds something else, or a comparison with other settings.
    """
    if not (folder / NAME).exists():
        check_may_hold(folder, NAME, "the folder of a comparison")
        return fresh
    there = replace(Compared.load(folder), lasting=fresh.lasting)
    if replace(there, rows=()) != fresh:
        raise BadInput(
            f"{folder} holds a comparison of {there.task} with eps {there.eps:g}, preset {there.preset} and "
            f"{there.set or 'no'} changed settings: choose another --out, or give the same"
        )
    return there
