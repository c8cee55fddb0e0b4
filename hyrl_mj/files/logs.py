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

from hyrl_mj.errors import BadInput, brief, has_controls
from hyrl_mj.files import artifacts

LARGEST = 2**26  # [bytes]: a million rows of six columns
NEEDED = "give a CSV file with a line of names and a row for each sample"
SHOWN = 40  # characters of a cell or a name in a message


def names_of(path: str | Path) -> list[str]:
    """Returns the names of the columns of a CSV file; raises `BadInput` as `read_log`."""
    return _begun(path)[0]


def read_log(path: str | Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Returns columns of a CSV file by their names, each (rows,); NaN where a cell is empty.

    Raises:
        BadInput: the file cannot be read, or something in it cannot be used.
    """
    header, rows = _begun(path)
    places = [header.index(name) for name in names]
    values = [array("d") for _ in names]
    for number, row in rows:
        if not row:
            continue
        if len(row) != len(header):
            raise BadInput(
                f"{path}, line {number} has {len(row)} cells under {len(header)} names: give each row as many"
            )
        for place, column in zip(places, values, strict=True):
            column.append(_number(row[place], f"{path}, line {number}", header[place]))
    return {name: np.array(column) for name, column in zip(names, values, strict=True)}


def _begun(path: str | Path) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Returns the names of the columns, and the rows after them with the numbers of their lines."""
    if not isinstance(path, str | Path):
        raise BadInput(f"{path!r:.60} is no path of a file: {NEEDED}")
    rows = _rows(path)
    header = [name.strip() for name in next(rows, (0, []))[1]]
    _check(path, header)
    return header, rows


def _rows(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO(_text(Path(path))), strict=True, skipinitialspace=True)
    try:
        for row in reader:
            yield reader.line_num, row
    except csv.Error as error:
        raise BadInput(f"{path} is no CSV file ({brief(error)}): {NEEDED}") from None


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
    if math.isinf(value):
        raise BadInput(
            f"{where}: {name[:SHOWN]} is {cell[:SHOWN]!r}, which is no finite number: give one, or leave the "
            "cell empty"
        )
    return value
