"""Reads the tensors in a file that `torch.save` wrote, without torch and without unpickling anything."""

from __future__ import annotations

import math
from typing import Any, Literal
from zipfile import ZIP_STORED, ZipFile

import numpy as np

from hyrl_mj import archives
from hyrl_mj.errors import BadArtifact
from hyrl_mj.policies import pickled
from hyrl_mj.policies.pickled import Call, Items, Name

# Limit on the file, and on the tensors as float32 [bytes]: the largest MLP policies take a few megabytes.
LARGEST = 2**25
DIMENSIONS = 8  # of a tensor
_TYPES = {
    "Float": "f4", "Double": "f8", "Half": "f2", "BFloat16": "u2", "Long": "i8", "Int": "i4", "Short": "i2",
    "Char": "i1", "Byte": "u1", "Bool": "?",
}  # fmt: skip
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
            return _StateDict(file).tensors()
    except BadArtifact:
        raise
    except Exception as error:  # a damaged file may raise any error
        raise BadArtifact(NO_TENSORS) from error


class _StateDict:
    """The tensors of a zip of torch.

    The pickle in it describes them; each storage is a member that is not compressed.
    """

    def __init__(self, file: ZipFile):
        if any(info.compress_type != ZIP_STORED for info in file.infolist()):
            raise BadArtifact("its policy.pth is compressed, which torch never does")
        (self._pickle,) = (name for name in file.namelist() if name.endswith("data.pkl"))
        self._folder = self._pickle.removesuffix("data.pkl")
        self._file, self._left = file, LARGEST
        self._storages: dict[str, np.ndarray] = {}
        order = f"{self._folder}byteorder"
        big = order in file.namelist() and archives.read_member(file, order, 16) == b"big"
        self._byteorder: Literal["<", ">"] = ">" if big else "<"

    def tensors(self) -> dict[str, np.ndarray]:
        """Returns the tensors by name."""
        content = pickled.read(archives.read_member(self._file, self._pickle, pickled.LARGEST))
        if isinstance(content, Call) and content.function == "collections.OrderedDict":
            content = Items(content.items)
        if isinstance(content, Call) and not _is_tensor(content):
            raise BadArtifact(NO_TENSORS)
        if not isinstance(content, Items):
            raise BadArtifact("its policy.pth holds no tensors by name")
        tensors, room = {}, LARGEST
        for name, tensor in content:
            if not isinstance(name, str) or not _is_tensor(tensor):
                raise BadArtifact(NO_TENSORS)
            _, _, size, *_ = tensor.arguments
            room -= 4 * math.prod(size)
            if room < 0:  # strides let a small file hold tensors of any size
                raise BadArtifact("its policy.pth is too large for an MLP policy")
            tensors[name] = self._tensor(tensor)
        return tensors

    def _tensor(self, tensor: Call) -> np.ndarray:
        storage, offset, size, stride, *_ = tensor.arguments
        numbers = self._storage(storage)
        if len(size) != len(stride):
            raise ValueError("the shape of a tensor is damaged")
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if math.prod(size) and last >= len(numbers):
            raise ValueError("a tensor is larger than its storage")
        steps = [step * numbers.itemsize for step in stride]
        view = np.lib.stride_tricks.as_strided(numbers[offset:], size, steps, writeable=False)
        with np.errstate(over="ignore"):  # weights that are not finite are refused by name
            return view.astype(np.float32) if view.dtype.kind == "f" else view.copy()

    def _storage(self, storage: Call) -> np.ndarray:
        """Returns all numbers of a storage."""
        kind, key, numel = (storage.arguments[i] for i in (1, 2, 4))
        if key not in self._storages:
            content = archives.read_member(self._file, f"{self._folder}data/{key}", self._left)
            self._left -= len(content)
            name = kind.text.removeprefix("torch.").removesuffix("Storage")
            numbers = np.frombuffer(content, np.dtype(_TYPES[name]).newbyteorder(self._byteorder))
            if len(numbers) != numel:
                raise ValueError("a storage has another length than the file says")
            if name == "BFloat16":  # the first half of a float32
                numbers = (numbers.astype(np.uint32) << 16).view(np.float32)
            self._storages[key] = numbers
        return self._storages[key]


def _is_tensor(value: Any) -> bool:
    """Returns whether a value of the pickle is a plain tensor, whose parts have the expected types."""
    if not isinstance(value, Call) or value.function != "torch._utils._rebuild_tensor_v2":
        return False
    if not isinstance(value.arguments, tuple) or not 4 <= len(value.arguments) <= 7:
        return False
    storage, offset, size, stride, *_ = value.arguments
    if not isinstance(storage, Call) or storage.function != "persistent":
        return False
    where = storage.arguments
    if not (isinstance(where, tuple) and len(where) == 5 and where[0] == "storage"):
        return False
    _, kind, key, _, numel = where
    if not (isinstance(kind, Name) and isinstance(key, str)):
        return False
    if not (isinstance(size, tuple) and isinstance(stride, tuple) and len(size) <= DIMENSIONS):
        return False
    numbers = (offset, numel, *size, *stride)
    return all(isinstance(n, int) and 0 <= n < 2**40 for n in numbers)
