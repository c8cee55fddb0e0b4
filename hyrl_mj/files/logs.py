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

# Bytes of a file, and rows and numbers that are read of it.
LARGEST, MOST_ROWS, MOST_NUMBERS = 2**26, 1_000_000, 8_000_000
NEEDED = "give a CSV file with a line of names and a row for each sample"
FEWER = "give fewer rows, or only the columns that are needed"
SHOWN = 40  # characters of a cell or a name in a message


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
        self.path, content = path, artifacts.read_given(Path(path), NEEDED, LARGEST, FEWER)
        if b"\0" in content:
            raise BadInput(f"{path} is no text: {NEEDED}")
        text = io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline="")
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
        most = min(MOST_ROWS, MOST_NUMBERS // max(len(columns), 1))
        for number, row in enumerate(filter(None, self._rows())):
            if len(row) != len(self.names) or number == most:
                where, count = f"{self.path}, line {self._reader.line_num}", len(self.names)
                if number == most:
                    raise BadInput(
                        f"{where} is beyond the {most:,} rows of {len(columns)} columns that can be looked "
                        f"at: {FEWER}"
                    )
                raise BadInput(
                    f"{where} has {len(row)} cells under {count} names: give each row as many"
                )
            for place, name, column in columns:
                column.append(self._number(row[place], name))
        return {name: np.frombuffer(column) for name, column in values.items()}

    def _number(self, cell: str, name: str) -> float:
        """Returns the number in a cell, NaN for an empty one, or raises `BadInput`."""
        try:
            value = float(cell)
        except ValueError:
            value = math.inf if cell.strip() else math.nan
        if abs(value) > LARGEST_NUMBER:
            raise BadInput(
                f"{self.path}, line {self._reader.line_num}: {name[:SHOWN]} is {cell.strip()[:SHOWN]!r}, "
                f"which is no finite number up to {LARGEST_NUMBER:g}: give one, or leave the cell empty"
            )
        return value

    def _rows(self) -> Iterator[list[str]]:
        try:
            yield from self._reader
        except csv.Error as error:
            raise BadInput(f"{self.path} is no CSV file ({brief(error)}): {NEEDED}") from None
        except UnicodeDecodeError:
            raise BadInput(f"{self.path} is no text: {NEEDED}") from None


def _check(path: str | Path, header: Sequence[str]) -> None:
    """Raises `BadInput` unless the first line of a file names its columns."""
    if not any(header):
        raise BadInput(f"{path} is empty or begins with an empty line: {NEEDED}")
    names, longest = 10_000, 200  # no log of a robot has more, and messages quote them
    if len(header) > names or max(map(len, header)) > longest:
        raise BadInput(
            f"{path} has {len(header):,} names of up to {max(map(len, header)):,} characters: give at most "
            f"{names:,} of at most {longest}"
        )
    if len(header) == 1 and (other := [sign for sign in "\t;|" if sign in header[0]]):
        raise BadInput(
            f"{path} has {other[0]!r} between its names: give commas between cells, and points in numbers"
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
