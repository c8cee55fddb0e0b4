"""Zips, read within limits: what their directories say of sizes may be wrong."""

from __future__ import annotations

import io
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np

from hyrl_mj.errors import BadArtifact

# The most members of a zip, each of which begins with this mark in the directory.
MOST_MEMBERS, MARK = 10_000, b"PK\x01\x02"

# How members are packed: Python unpacks others, as LZMA, without a limit.
PACKED = (ZIP_STORED, ZIP_DEFLATED)


def open_zip(content: bytes) -> ZipFile:
    """Opens a zip, whose directory `ZipFile` reads at once.

    Raises:
        BadArtifact: its directory names far too many members.
    """
    if content.count(MARK) > MOST_MEMBERS:
        raise BadArtifact(f"it has more than {MOST_MEMBERS:,} members, which no such file has")
    return ZipFile(io.BytesIO(content))


def read_member(file: ZipFile, name: str, limit: int) -> bytes:
    """Returns the content of a member of a zip, if it is no longer than the limit [bytes]."""
    if file.getinfo(name).compress_type not in PACKED:
        raise BadArtifact(f"its {name} is packed in a way that such files never are")
    with file.open(name) as member:
        content = member.read(limit + 1)  # unpacks no more than that
    if len(content) > limit:
        raise BadArtifact(f"its {name} unpacks to more than {limit / 2**20:g} MiB")
    return content


def read_npz(content: bytes, limit: int) -> dict[str, np.ndarray]:
    """Returns the arrays of an npz file, if they are no longer than the limit [bytes]."""
    arrays = {}
    with open_zip(content) as file:
        for name in file.namelist():
            member = read_member(file, name, limit)
            limit -= len(member)
            arrays[name.removesuffix(".npy")] = np.lib.format.read_array(io.BytesIO(member))
    return arrays
