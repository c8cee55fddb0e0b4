"""Logs of measurements: CSV files of strangers, read within limits."""

from __future__ import annotations

import csv
import io
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hyrl_mj.errors import LARGEST_NUMBER, BadInput, brief, has_controls
from hyrl_mj.files import artifacts

LARGEST = 2**26  # [bytes]: a million rows of six columns
NEEDED = "give a CSV file with a line of names and a row for each sample"
SHOWN = 40  # characters of a cell or a name in a message
LONGEST, MOST = 200, 10_000  # characters of a name, and names


class Log:
    """A log whose columns have names.

    Attributes:
        path: the file.
        names: of its columns.

    Raises:
        BadInput: the file cannot be read, or its first line does not name its columns.
    """

    def __init__(self, path: str | Path):
        if not isinstance(path, str | Path):
            raise BadInput(f"{path!r:.60} is no path of a file: {NEEDED}")
        self.path, text = path, io.StringIO(_text(Path(path)))
        self._reader = csv.reader(text, strict=True, skipinitialspace=True)
        self.names = [name.strip() for name in next(self._rows(), [])]
        _check(path, self.names)

    def read(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Returns columns by their names, each (rows,), once; NaN where a cell is empty.

        Raises:
            BadInput: something in the file cannot be used.
        """
        values = {name: array("d") for name in names}
        columns = [(self.names.index(name), name, values[name]) for name in names]
        for row in filter(None, self._rows()):
            where = f"{self.path}, line {self._reader.line_num}"
            if len(row) != len(self.names):
                raise BadInput(
                    f"{where} has {len(row)} cells under {len(self.names)} names: give each row as many"
                )
            for place, name, column in columns:
                column.append(_number(row[place], where, name))
        return {name: np.array(column) for name, column in values.items()}

    def _rows(self) -> Iterator[list[str]]:
        try:
            yield from self._reader
        except csv.Error as error:
            raise BadInput(f"{self.path} is no CSV file ({brief(error)}): {NEEDED}") from None


def _text(path: Path) -> str:
    fewer = "give fewer rows, or only the columns that are needed"
    try:
        text = artifacts.read_given(path, NEEDED, LARGEST, fewer).decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise BadInput(f"{path} is no text: {NEEDED}")
    return text


def _check(path: str | Path, header: Sequence[str]) -> None:
    """Raises `BadInput` unless the first line of a file names its columns."""
    if not any(header):
        raise BadInput(f"{path} is empty or begins with an empty line: {NEEDED}")
    if len(header) > MOST or max(map(len, header)) > LONGEST:
        raise BadInput(
            f"{path} has {len(header):,} names of up to {max(map(len, header)):,} characters: give at most "
            f"{MOST:,} of at most {LONGEST}"
        )
    twice = [name for name, count in Counter(header).items() if count > 1]
    for name in header:
        if has_controls(name):
            raise BadInput(
                f"{path} has the name {name[:SHOWN]!r}, with control characters: {NEEDED}"
            )
        try:
            float(name)
        except ValueError:
            continue
        raise BadInput(f"{path} begins with the number {name[:SHOWN]}, not with names: {NEEDED}")
    if twice:
        raise BadInput(f"{path} names the column {twice[0][:SHOWN]!r} twice: give it once")


def _number(cell: str, where: str, name: str) -> float:
    """Returns the number in a cell, NaN for an empty one, or raises `BadInput`."""
    cell = cell.strip()
    try:
        value = float(cell) if cell else math.nan
    except ValueError:
        value = math.inf
    if abs(value) > LARGEST_NUMBER:
        raise BadInput(
            f"{where}: {name[:SHOWN]} is {cell[:SHOWN]!r}, which is no finite number up to "
            f"{LARGEST_NUMBER:g}: give one, or leave the cell empty"
        )
    return value
