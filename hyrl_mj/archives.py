"""Zips, read within limits: what their directories say of sizes may be wrong."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from zipfile import ZipFile

import numpy as np

from hyrl_mj.errors import BadArtifact

# Limit on the directory of a zip [bytes], of which every member takes fifty or more.
LARGEST_DIRECTORY = 2**20


class _ShortReads(io.RawIOBase):
    """A file of which no more than `LARGEST_DIRECTORY` is read at a time."""

    def __init__(self, file: IO[bytes]):
        self._file = file

    def read(self, size: int | None = -1) -> bytes:
        limit = LARGEST_DIRECTORY + 1
        content = self._file.read(limit if size is None or size < 0 else min(size, limit))
        if len(content) == limit:
            raise BadArtifact(f"its directory takes more than {LARGEST_DIRECTORY / 2**20:g} MiB")
        return content

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def close(self) -> None:
        self._file.close()
        super().close()


@contextmanager
def open_zip(file: IO[bytes]) -> Iterator[ZipFile]:
    """Opens a zip, whose directory `ZipFile` reads at once, and closes its file at the end of the block.

    Raises:
        BadArtifact: its directory names far too many members.
    """
    with _ShortReads(file) as source, ZipFile(source) as opened:
        yield opened


def read_member(file: ZipFile, name: str, limit: int) -> bytes:
    """Returns the content of a member of a zip, if it is no longer than the limit [bytes].

    The sizes in the directory of the zip may be wrong, so only a little is unpacked at a time.
    """
    parts, size = [], 0
    with file.open(name) as member:
        while part := member.read(2**16):
            parts.append(part)
            size += len(part)
            if size > limit:
                raise BadArtifact(f"its {name} unpacks to more than {limit / 2**20:g} MiB")
    return b"".join(parts)


def read_npz(path: Path, limit: int) -> dict[str, np.ndarray]:
    """Returns the arrays of an npz file, if they are no longer than the limit [bytes]."""
    content = {}
    with open_zip(path.open("rb")) as file:
        for name in file.namelist():
            member = read_member(file, name, limit)
            limit -= len(member)
            content[name.removesuffix(".npy")] = np.lib.format.read_array(io.BytesIO(member))
    return content
