"""The files of a run directory: versioned, without pickles, and written whole or not at all."""

from __future__ import annotations

import json
import os
import re
import secrets
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cache
from hashlib import file_digest, sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, get_args, get_type_hints

import numpy as np
from safetensors.numpy import load, save

from hyrl_mj.errors import BadArtifact, BadInput, brief, has_controls
from hyrl_mj.files import archives

if TYPE_CHECKING:
    from pydantic import TypeAdapter

Record = TypeVar("Record")
# The version of the files; a file of another version is refused.
VERSION = 2
# The remedy for a file that cannot be read.
REMEDY = "run the stage that writes it again"


# Limits on what is read [bytes], so that a crafted file cannot fill the memory.
LARGEST_JSON, LARGEST = 2**22, 2**27
# Lists and objects of a JSON file, each of which takes 200 bytes or so.
MOST_PARTS = 10_000
# Rows of an array that stands for a tuple, of which there is one for each mode.
MOST_ROWS = 1_000
# The names of temporary files, which only a process that was killed leaves behind.
TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.partial(\.\w+)?")
# Called with each path, and its temporary file, before `replacing` writes it; returns whether it is new.
before_writing: ContextVar[Callable[[Path, Path], bool]] = ContextVar(
    "before_writing", default=lambda path, temporary: False
)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a new temporary file beside `path`, and renames it to `path` if the block ends without error.

    Each writer has a temporary file of its own, and no link is followed. What others put in the place of a
    file that is new, by `before_writing`, stays.

    Raises:
        BadInput: the path cannot be written.
    """
    if not path.name:
        raise BadInput(f"{path} is no name of a file: give one")
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(6)}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        yield temporary
        if not (before_writing.get()(path, temporary) and _linked(temporary, path)):
            temporary.replace(path)
    except BrokenPipeError:  # the program that writes the file has died
        raise
    except OSError as error:
        raise not_writable(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _linked(temporary: Path, path: Path) -> bool:
    """Returns whether a file has the name of `path`, too, by now; some file systems have no links.

    Raises:
        FileExistsError: another file has it.
    """
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:
        return False
    return True


def not_writable(path: Path, error: OSError) -> BadInput:
    """Returns the error for a file or a folder that cannot be written."""
    why = error.strerror or error
    return BadInput(
        f"{path} cannot be written ({why}): give a place that can be written and has room"
    )


@contextmanager
def reading(path: Path, remedy: str = REMEDY) -> Iterator[None]:
    """Raises `BadArtifact`, with the remedy, if a file is missing or the block that reads it fails."""
    if not path.is_file():
        first = "run the stage that writes it first" if remedy == REMEDY else remedy
        raise BadArtifact(f"there is no file {path}: {first}")
    try:
        yield
    except BadArtifact as error:
        raise BadArtifact(f"{path}: {error}") from error
    except Exception as error:  # a damaged file may raise any error in its reader
        raise BadArtifact(
            f"{path} cannot be read ({brief(error)}): it is truncated or not what its name says; {remedy}"
        ) from error


def check_version(version: Any, kind: Any, wanted: str) -> None:
    """Raises `BadArtifact` unless a file is of the wanted kind and version."""
    if kind != wanted:
        raise BadArtifact(f"it holds {kind!r}, not {wanted!r}")
    if version != VERSION:
        raise BadArtifact(f"it is of version {version}, hyrl_mj reads version {VERSION}: {REMEDY}")


def read_limited(path: Path, limit: int = LARGEST) -> bytes:
    """Returns the content of a file, if it is no longer than the limit [bytes]."""
    with path.open("rb") as file:
        content = file.read(limit + 1)
    check_size(len(content), limit)
    return content


def read_given(
    path: Path, remedy: str, limit: int = LARGEST_JSON, smaller: str | None = None
) -> bytes:
    """Returns the content of a file that the user has named, if it is no longer than the limit [bytes].

    Raises:
        BadInput: it cannot be read; the message ends with the remedy, or says how to make it smaller.
    """
    if path.exists() and not path.is_file():
        raise BadInput(f"{path} is no file: {remedy}")
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise BadInput(f"{path} cannot be read ({why}): {remedy}") from None
    if len(content) > limit:
        raise BadInput(f"{path} is larger than {limit / 2**20:g} MiB: {smaller or remedy}")
    return content


def check_size(size: int, limit: int = LARGEST) -> None:
    """Raises `BadArtifact` if a file is larger than the limit [bytes]."""
    if size > limit:
        raise BadArtifact(f"it is larger than {limit / 2**20:g} MiB, which no such file is")


def digest(path: Path) -> str:
    """Returns the SHA-256 of the content of a file."""
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def write_json(path: Path, content: Any, kind: str) -> None:
    """Writes a mapping or a dataclass as a JSON object, with its kind, its version and its own SHA-256."""
    if is_dataclass(content) and not isinstance(content, type):
        content = asdict(content)
    if (odd := next(_unprintable(content), None)) is not None:
        raise BadInput(
            f"{path} cannot hold {odd!r}, which has control characters: give another name"
        )
    with replacing(path) as temporary:
        temporary.write_text(_json({"kind": kind, "version": VERSION, **content}), encoding="utf-8")


def _json(content: dict[str, Any]) -> str:
    """Returns the text of a JSON object, which ends with the SHA-256 of the rest."""
    own = sha256(json.dumps(content).encode()).hexdigest()
    return json.dumps(content | {"sha256": own}, indent=2) + "\n"


def read_json(
    path: Path, kind: str, parse: Callable[[dict[str, Any]], Record], remedy: str = REMEDY
) -> Record:
    """Returns what `parse` makes of the nested dictionaries and lists that `write_json` wrote.

    Raises:
        BadArtifact: the file is missing or damaged, or `parse` refuses its content.
    """
    with reading(path, remedy):
        return parsed_json(read_limited(path, LARGEST_JSON).decode(), kind, parse, remedy)


def parsed_json(
    text: str, kind: str, parse: Callable[[dict[str, Any]], Record], remedy: str = REMEDY
) -> Record:
    """Returns what `read_json` does, of the text of a file."""
    check_parts(text)
    whole = json.loads(text)
    if not isinstance(whole, dict):
        raise BadArtifact("it holds no JSON object")
    if (odd := next(_unprintable(whole), None)) is not None:
        raise BadArtifact(f"it holds control characters, in {odd!r}")
    content = {name: whole[name] for name in whole if name not in ("kind", "version", "sha256")}
    check_version(whole.get("version"), whole.get("kind"), kind)
    value = parse(content)  # before its SHA-256 is compared: the message names the field
    whole.pop("sha256", None)
    if text != _json(whole):
        raise BadArtifact(
            f"it was changed after it was written (its sha256 does not fit): {remedy}"
        )
    return value


def check_parts(text: str) -> None:
    """Raises `BadArtifact` if the text of a JSON file has more than `MOST_PARTS` lists and objects."""
    if text.count("[") + text.count("{") > MOST_PARTS:
        raise BadArtifact(f"it has more than {MOST_PARTS:,} parts, which no such file has")


def _unprintable(content: Any) -> Iterator[str]:
    """Yields each string with control characters in nested dictionaries and lists."""
    if isinstance(content, str) and has_controls(content):
        yield content
    elif isinstance(content, dict):
        yield from _unprintable([*content, *content.values()])
    elif isinstance(content, list):
        for value in content:
            yield from _unprintable(value)


def read_record(path: Path, kind: str, record: type[Record], remedy: str = REMEDY) -> Record:
    """Returns the dataclass that `write_json` wrote.

    Raises:
        BadArtifact: the file is missing or damaged, or a field does not fit; the message names the field.
    """
    return read_json(path, kind, lambda content: parsed(content, record, remedy), remedy)


class SavedAsJson:
    """Base of the frozen dataclasses that are saved as a JSON file."""

    KIND: ClassVar[str]

    def save(self, path: Path) -> None:
        """Writes the JSON file."""
        write_json(path, self, self.KIND)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Reads what `save` wrote; raises `BadArtifact` if it is missing, damaged, or of another version."""
        return read_record(path, cls.KIND, cls)


def parsed(content: Mapping[str, Any], record: type[Record], remedy: str = REMEDY) -> Record:
    """Returns the dataclass that nested dictionaries and lists describe.

    Raises:
        BadArtifact: a field is missing, unknown or of another type.
    """
    from pydantic import ValidationError  # slow to import

    try:
        value = _adapter(record).validate_json(json.dumps([content]))[0]  # type: ignore[arg-type]
    except ValidationError as error:
        problems = error.errors(include_url=False, include_input=False)
    else:
        # Files are written with every field: a default would hide that one is missing.
        if lacks := next(_missing(asdict(value), content), None):
            raise BadArtifact(
                f"it has no {lacks}, so it is damaged or of another version: {remedy}"
            )
        return value
    # For a union, pydantic lists the problems of every type: report those of the closest type.
    counts = Counter(problem["loc"][:-1] for problem in problems)
    problem = min(problems, key=lambda problem: counts[problem["loc"][:-1]])
    field = ".".join(map(str, problem["loc"][1:]))  # the first step is the tuple's index
    text = {
        "missing": f"it has no {field}",
        "unexpected_keyword_argument": f"it has an unknown {field}",
    }.get(
        problem["type"],
        f"its {field} cannot be used ({problem['msg'].removeprefix('Value error, ')})",
    )
    raise BadArtifact(f"{text}, so it is damaged or of another version: {remedy}")


def _missing(whole: Any, content: Any, field: str = "") -> Iterator[str]:
    """Yields the fields of nested dictionaries and lists that others do not have."""
    if isinstance(whole, dict):
        for name, value in whole.items():
            inner = f"{field}.{name}".lstrip(".")
            if name in content:
                yield from _missing(value, content[name], inner)
            elif name != "places":  # which files of version 1.0.0 do not have
                yield inner
    elif isinstance(whole, list | tuple):
        for i, (value, part) in enumerate(zip(whole, content, strict=True)):
            yield from _missing(value, part, f"{field}.{i}")


@cache
def _adapter(record: type) -> TypeAdapter[Any]:
    """Returns the JSON reader of a tuple of one record; pydantic takes no config for a dataclass alone."""
    from pydantic import ConfigDict, TypeAdapter  # slow to import

    return TypeAdapter(tuple[record], config=ConfigDict(extra="forbid", strict=True))  # type: ignore[valid-type]


@dataclass(frozen=True)
class Saved:
    """Base of the frozen dataclasses that are saved as an npz file, with an array for each field.

    Numbers and strings become arrays without dimensions, a tuple becomes one array, and a dictionary of
    arrays becomes an array `<field>_<key>` for each entry. Types with `pack` and `unpack` convert tuples of
    themselves.
    """

    KIND: ClassVar[str]

    def save(self, path: Path) -> None:
        """Writes the npz file."""
        arrays: dict[str, np.ndarray] = {}
        for field in fields(self):
            arrays |= _packed(field.name, getattr(self, field.name))
        write_arrays(path, arrays, self.KIND)

    @classmethod
    def load(cls, path: Path, context: Any = None, limit: int = LARGEST) -> Self:
        """Reads an npz file of `save`, whose arrays take no more than the limit [bytes].

        Sets in a task's chart need the task as `context`.

        Raises:
            BadArtifact: the file is missing, damaged, or of another kind.
        """
        arrays, types = read_arrays(path, cls.KIND, limit), get_type_hints(cls)
        values = {}
        with reading(path):
            for field in fields(cls):
                try:
                    values[field.name] = _unpacked(field.name, types[field.name], arrays, context)
                except KeyError as error:
                    raise BadArtifact(f"it has no array {error}: {REMEDY}") from error
                except (TypeError, ValueError) as error:
                    raise BadArtifact(f"its {field.name} cannot be used: {error}") from error
            return cls(**values)


def _packed(name: str, value: Any) -> dict[str, np.ndarray]:
    """Returns the arrays that hold one field."""
    if isinstance(value, dict):
        return {f"{name}_{key}": np.asarray(array) for key, array in value.items()}
    if isinstance(value, tuple) and value and hasattr(value[0], "pack"):
        return dict(value[0].pack(value))
    return {name: np.asarray(value)}


def _unpacked(name: str, declared: Any, arrays: Mapping[str, np.ndarray], context: Any) -> Any:
    """Returns the value of one field, of its declared type."""
    if declared == dict[str, np.ndarray]:
        prefix = f"{name}_"
        return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    element: Any = next(iter(get_args(declared)), None)
    if hasattr(element, "unpack"):
        return element.unpack(arrays, context)
    array = arrays[name]
    if (array.ndim == 0) != (declared in (int, float, str)):
        raise ValueError(f"an array of {array.ndim} dimensions does not fit")
    if declared in (tuple[int, ...], tuple[np.ndarray, ...]):
        if len(array) > MOST_ROWS:
            raise ValueError(f"it has {len(array):,} rows, at most {MOST_ROWS:,} make sense")
        if declared == tuple[int, ...] and array.size and array.dtype.kind not in "iu":
            raise ValueError("its numbers are no integers")
        return tuple(int(value) for value in array) if array.ndim == 1 else tuple(array)
    if declared is np.ndarray:
        return array
    value = declared(array.item())
    if isinstance(value, str) and has_controls(value):
        raise ValueError("it holds control characters")
    return value


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], kind: str) -> None:
    """Writes named arrays as npz, with their kind and version.

    Raises:
        TypeError: an array holds Python objects, which NumPy would pickle.
    """
    if objects := [name for name, array in arrays.items() if np.asarray(array).dtype.hasobject]:
        raise TypeError(f"arrays of Python objects cannot be written: {', '.join(objects)}")
    content: dict[str, Any] = {"kind": kind, "version": VERSION, **arrays}
    with replacing(path) as temporary:
        np.savez_compressed(temporary, **content)


def read_arrays(path: Path, kind: str, limit: int = LARGEST) -> dict[str, np.ndarray]:
    """Returns the arrays that `write_arrays` wrote, which take no more than the limit [bytes]."""
    with reading(path):
        check_size(path.stat().st_size)
        content = archives.read_npz(path, limit)
        for name, array in content.items():
            if array.dtype.kind not in "biufU":
                raise BadArtifact(f"its {name} holds neither real numbers nor a text: {REMEDY}")
        check_version(int(content.pop("version")), str(content.pop("kind")), kind)
        return content


def write_tensors(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """Writes named tensors as safetensors."""
    with replacing(path) as temporary:
        temporary.write_bytes(save({k: np.ascontiguousarray(v) for k, v in tensors.items()}))


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """Returns the tensors that `write_tensors` wrote."""
    with reading(path):
        names = 2**20  # the names and shapes at its beginning [bytes]
        content = read_limited(path, 2**25 + names)
        if int.from_bytes(content[:8], "little") > names:
            raise BadArtifact("its names take more than 1 MiB")
        return load(content)
