"""Files of a run directory: no pickles, versioned, and written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save

from hyrl_mj.errors import BadArtifact, BadInput, brief

# Raised whenever a file of an older version can no longer be read.
VERSION = 1


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` when the block ends well.

    Raises:
        BadInput: it cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        yield temporary
        temporary.replace(path)
    except BrokenPipeError:  # a program that writes it has died
        raise
    except OSError as error:
        raise BadInput(
            f"{path} cannot be written ({error.strerror or error}): give a place that can be written "
            "and has room"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def reading(path: Path, remedy: str = "") -> Iterator[None]:
    """Turn whatever a damaged file makes its reader raise into one clear sentence.

    Args:
        path: the file.
        remedy: what to do about it; by default to run the stage that writes it.
    """
    if not path.is_file():
        raise BadArtifact(
            f"there is no file {path}: {remedy or 'run the stage that writes it first'}"
        )
    try:
        yield
    except BadArtifact as error:
        raise BadArtifact(f"{path}: {error}") from error
    # The readers of damaged files raise whatever the damage leads them to.
    except Exception as error:
        raise BadArtifact(
            f"{path} cannot be read ({brief(error)}): it is truncated or not what its name says; "
            f"{remedy or 'run the stage that writes it again'}"
        ) from error


def check_version(found: Any, kind: str, wanted: str) -> None:
    """Raise `BadArtifact` unless the file says that it is `wanted` of this version."""
    if kind != wanted:
        raise BadArtifact(f"it holds {kind!r}, not {wanted!r}")
    if found != VERSION:
        raise BadArtifact(
            f"it is of version {found}, this hyrl_mj reads version {VERSION}: "
            "run the stage that writes it again"
        )


def write_json(path: Path, content: Mapping[str, Any], kind: str) -> None:
    """Write a JSON object with its kind and version."""
    with replacing(path) as temporary:
        text = json.dumps({"kind": kind, "version": VERSION, **content}, indent=2)
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: Path, kind: str) -> dict[str, Any]:
    """Read what `write_json` wrote."""
    with reading(path):
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise BadArtifact("it holds no JSON object")
        check_version(content.pop("version"), content.pop("kind"), kind)
        return content


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], kind: str) -> None:
    """Write named arrays as npz with their kind and version.

    Raises:
        TypeError: an array of Python objects, which NumPy would pickle.
    """
    objects = [name for name, values in arrays.items() if np.asarray(values).dtype.hasobject]
    if objects:
        raise TypeError(f"arrays of Python objects cannot be written: {', '.join(objects)}")
    with replacing(path) as temporary:
        content: dict[str, Any] = {"kind": kind, "version": VERSION, **arrays}
        np.savez_compressed(temporary, **content)


def read_arrays(path: Path, kind: str) -> dict[str, np.ndarray]:
    """Read what `write_arrays` wrote."""
    with reading(path), np.load(path, allow_pickle=False) as file:
        content = {name: file[name] for name in file.files}
        check_version(int(content.pop("version")), str(content.pop("kind")), kind)
        return content


def write_tensors(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """Write named tensors as safetensors."""
    with replacing(path) as temporary:
        temporary.write_bytes(save({k: np.ascontiguousarray(v) for k, v in tensors.items()}))


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """Read what `write_tensors` wrote."""
    with reading(path):
        return load_file(path)
