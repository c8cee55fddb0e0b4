"""Zips, read within limits: what their directories say of sizes may be wrong."""

from __future__ import annotations

import io
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np

from hyrl_mj.errors import BadArtifact


def open_zip(content: bytes) -> ZipFile:
    """Opens a zip, whose directory `ZipFile` reads at once.

    Raises:
        BadArtifact: its directory names far too many members.
    """
    if content.count(b"PK\x01\x02") > 10_000:  # with this mark each member begins in the directory
        raise BadArtifact("it has more than 10,000 members, which no such file has")
    return ZipFile(io.BytesIO(content))


def read_member(file: ZipFile, name: str, limit: int) -> bytes:
    """Returns the content of a member of a zip, if it is no longer than the limit [bytes]."""
    # Python unpacks others, as LZMA, without a limit.
    if file.getinfo(name).compress_type not in (ZIP_STORED, ZIP_DEFLATED):
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
