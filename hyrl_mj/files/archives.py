"""Zips, read within limits: what their directories say of sizes may be wrong."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import IO
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np

from hyrl_mj.errors import BadArtifact

# With which each member begins in the directory of a zip.
MEMBER = b"PK\x01\x02"


def open_zip(source: bytes | Path) -> ZipFile:
    """Opens a zip, its content or its file, whose directory `ZipFile` reads at once.

    Raises:
        BadArtifact: its directory names far too many members.
    """
    members, before = 0, b""
    with io.BytesIO(source) if isinstance(source, bytes) else source.open("rb") as stream:
        while part := stream.read(2**20):
            members += (before + part).count(MEMBER)
            before = part[-len(MEMBER) + 1 :]
    if members > 10_000:
        raise BadArtifact("it has more than 10,000 members, which no such file has")
    return ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source)


def _member(file: ZipFile, name: str) -> IO[bytes]:
    """Opens a member of a zip."""
    # Python unpacks others, as LZMA, without a limit.
    if file.getinfo(name).compress_type not in (ZIP_STORED, ZIP_DEFLATED):
        raise BadArtifact(f"its {name} is packed in a way that such files never are")
    return file.open(name)


def read_member(file: ZipFile, name: str, limit: int) -> bytes:
    """Returns the content of a member of a zip, if it is no longer than the limit [bytes]."""
    with _member(file, name) as member:
        content = member.read(limit + 1)  # unpacks no more than that
    if len(content) > limit:
        raise BadArtifact(f"its {name} unpacks to more than {limit / 2**20:g} MiB")
    return content


def read_npz(source: bytes | Path, limit: int) -> dict[str, np.ndarray]:
    """Returns the arrays of an npz file, if they are no longer than the limit [bytes].

    Beside the arrays nothing of their size is in memory.
    """
    arrays = {}
    with open_zip(source) as file:
        for name in file.namelist():
            with _member(file, name) as member:
                if np.lib.format.read_magic(member) != (1, 0):
                    raise BadArtifact(f"its {name} is no array of the usual format")
                shape, _, dtype = np.lib.format.read_array_header_1_0(member)
            # Also rows and numbers without a byte take their share where they are reckoned with.
            sides = [max(side, 1) for side in (*shape, dtype.itemsize)]
            if (size := math.prod(sides)) > limit:
                raise BadArtifact(f"its {name} unpacks to more than {limit / 2**20:g} MiB")
            limit -= size
            with _member(file, name) as member:
                arrays[name.removesuffix(".npy")] = np.lib.format.read_array(member)
    return arrays
