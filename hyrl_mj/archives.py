"""Zips, read within limits: what their directories say of sizes may be wrong."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np

from hyrl_mj.errors import BadArtifact

# Limit on the directory of a zip [bytes], of which every member takes fifty or more.
LARGEST_DIRECTORY = 2**20

# How members are packed: Python unpacks others, as LZMA, without a limit.
PACKED = (ZIP_STORED, ZIP_DEFLATED)


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


class _Limited(io.RawIOBase):
    """A member of a zip of which no more is read than a limit, whatever its directory says."""

    def __init__(self, file: ZipFile, name: str, limit: int):
        self._name, self._limit = name, limit
        if file.getinfo(name).compress_type not in PACKED:
            raise BadArtifact(f"its {name} is packed in a way that such files never are")
        self._file, self.left = file.open(name), limit

    def read(self, size: int | None = -1) -> bytes:
        most = self.left + 1 if size is None or size < 0 else min(size, self.left + 1)
        content = self._file.read(min(most, 2**16))
        self.left -= len(content)
        if self.left < 0:
            limit = f"{self._limit / 2**20:g} MiB"
            raise BadArtifact(f"its {self._name} unpacks to more than {limit}")
        return content

    def close(self) -> None:
        self._file.close()
        super().close()


def read_member(file: ZipFile, name: str, limit: int) -> bytes:
    """Returns the content of a member of a zip, if it is no longer than the limit [bytes]."""
    content = bytearray()
    with _Limited(file, name, limit) as member:
        while part := member.read():
            content += part
    return bytes(content)


def read_npz(path: Path, limit: int) -> dict[str, np.ndarray]:
    """Returns the arrays of an npz file, if they are no longer than the limit [bytes]."""
    content = {}
    with open_zip(path.open("rb")) as file:
        for name in file.namelist():
            with _Limited(file, name, limit) as member:
                content[name.removesuffix(".npy")] = np.lib.format.read_array(member)
                limit = member.left
    return content
