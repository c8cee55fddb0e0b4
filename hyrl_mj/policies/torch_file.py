"""Reads the tensors in a file that `torch.save` wrote, without torch and without unpickling anything.

The file is a zip: a pickle in it describes the tensors, and each storage is a member that is not compressed.
`pickled` says why torch itself does not read it.
"""

from __future__ import annotations

import math
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import numpy as np

from hyrl_mj.errors import BadArtifact
from hyrl_mj.files import archives
from hyrl_mj.policies import pickled
from hyrl_mj.policies.pickled import Call

# Limit on the file, and on the tensors as float32 [bytes]: the largest MLP policies take a few megabytes.
LARGEST = 2**25
NO_TENSORS = (
    "its policy.pth is damaged or holds more than tensors, which an agent's never does (or torch before 1.6 "
    "saved it): nothing in it was executed; get the file again, or save it again with a newer torch"
)


def read_tensors(content: bytes) -> dict[str, np.ndarray]:
    """Returns the tensors of a `policy.pth` by name: float32, or their own type if they hold no fractions.

    Raises:
        BadArtifact: it holds anything else, or more than an MLP policy.
    """
    try:
        with archives.open_zip(content) as file:
            if any(info.compress_type != ZIP_STORED for info in file.infolist()):
                raise BadArtifact("its policy.pth is compressed, which torch never does")
            return _tensors(file)
    except BadArtifact:
        raise
    except Exception as error:  # a damaged file may raise any error
        raise BadArtifact(NO_TENSORS) from error


def _tensors(file: ZipFile) -> dict[str, np.ndarray]:
    """Returns the tensors by name."""
    (description,) = (name for name in file.namelist() if name.endswith("data.pkl"))
    folder = description.removesuffix("data.pkl")
    found = pickled.read(archives.read_member(file, description, pickled.LARGEST))
    if not isinstance(found, Call) or found.function not in pickled.DICTS:
        raise BadArtifact(NO_TENSORS)
    order = f"{folder}byteorder"
    is_big = order in file.namelist() and archives.read_member(file, order, 16) == b"big"
    storages: dict[str, bytes] = {}
    tensors, room, left = {}, LARGEST, LARGEST
    for name, tensor in found.items:
        if not isinstance(name, str) or not _is_tensor(tensor):
            raise BadArtifact(NO_TENSORS)
        (_, kind, key, _, _), size = tensor.arguments[0].arguments, tensor.arguments[2]
        room -= 4 * math.prod(size)
        if room < 0:  # strides let a small file hold tensors of any size
            raise BadArtifact("its policy.pth is too large for an MLP policy")
        if key not in storages:
            storages[key] = archives.read_member(file, f"{folder}data/{key}", left)
            left -= len(storages[key])
        tensors[name] = _tensor(tensor, storages[key], kind, ">" if is_big else "<")
    return tensors


def _tensor(tensor: Call, storage: bytes, kind: str, order: Any) -> np.ndarray:
    """Returns a tensor in a storage, whose numbers are of a kind such as "torch.FloatStorage"."""
    types = {
        "Float": "f4", "Double": "f8", "Half": "f2", "BFloat16": "u2", "Long": "i8", "Int": "i4",
        "Short": "i2", "Char": "i1", "Byte": "u1", "Bool": "?",
    }  # fmt: skip
    _, offset, size, stride, *_ = tensor.arguments
    name = kind.removeprefix("torch.").removesuffix("Storage")
    numbers = np.frombuffer(storage, np.dtype(types[name]).newbyteorder(order))
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if math.prod(size) and last >= len(numbers):
        raise ValueError("a tensor is larger than its storage")
    steps = [step * numbers.itemsize for step in stride]
    view = np.lib.stride_tricks.as_strided(numbers[offset:], size, steps, writeable=False)
    if name == "BFloat16":  # the first half of a float32
        return np.asarray(view.astype(np.uint32) << 16).view(np.float32)
    with np.errstate(over="ignore"):  # weights that are not finite are refused by name
        return view.astype(np.float32) if view.dtype.kind == "f" else view.copy()


def _is_tensor(value: Any) -> bool:
    """Returns whether a value of the pickle is a plain tensor, whose parts have the expected types."""
    match value:
        case Call(
            "torch._utils._rebuild_tensor_v2",
            (
                Call("persistent", ("storage", str(), str(), _, _)),
                offset,
                tuple() as size,
                tuple() as stride,
                *_,
            ),
        ):
            numbers = (offset, *size, *stride)
            plain = all(isinstance(n, int) and 0 <= n < 2**40 for n in numbers)
            return plain and len(size) <= 8
    return False
