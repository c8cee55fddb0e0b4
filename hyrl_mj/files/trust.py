"""Where a text comes from, the code and texts of the user's that were used here, and what was written here.

A run directory names the file or the environment of its task. Opening a directory from a stranger must not
run code that it names, and opening a run of one's own should not ask for it each time. So what a file says is
read in a block `received`; and whenever the user names a file or describes an environment, its SHA-256 is
recorded outside all run directories.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from hashlib import sha256
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from hyrl_mj.errors import BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.files.artifacts import digest, replacing
from hyrl_mj.files.sources import compile_each_time, digest_of

# The records hold hashes of files by path, and of texts and written files by these keys: of each as many.
TEXTS, WRITTEN, MOST = "texts", "written", 1_000
_received: ContextVar[bool] = ContextVar("received", default=False)


@contextmanager
def received() -> Iterator[None]:
    """What is made in the block is described by a file, not by the user: of code, only what is known runs.

    Tasks and environments ask `is_received` before they run code or open a file that has been named.
    """
    token = _received.set(True)
    try:
        yield
    finally:
        _received.reset(token)


def is_received() -> bool:
    """Returns whether what is made now is described by a file."""
    return _received.get()


@contextmanager
def current_folder(name: str) -> Iterator[None]:
    """Lets a module that the user names, as "package.module:Name", be imported from the current folder.

    What is installed comes first: where the module is, the current folder is not searched at all. That stays
    the current folder, whose paths are meant elsewhere, also where the module changes to another one.
    """
    here, searched = os.getcwd(), _installed(name) is None
    if searched:
        if (file := module_file(name)) is not None:
            compile_each_time(file)
        sys.path.append("")
    try:
        yield
    finally:
        os.chdir(here)
        if searched:
            last = max(i for i, folder in enumerate(sys.path) if folder == "")
            del sys.path[last]  # not one of the user's own


@contextmanager
def only_installed() -> Iterator[None]:
    """Lets nothing be found in the current folder, which a Python session and `python -m` search first."""
    before = [*sys.path]
    sys.path[:] = [f for i, f in enumerate(before) if f and (i or f != os.getcwd())]
    try:
        yield
    finally:
        sys.path[:] = [*before, *(folder for folder in sys.path if folder not in before)]


def module_file(name: str) -> Path | None:
    """Returns the file of the top-level module of "package.module:Name"; nothing is imported to find it."""
    spec = _installed(name) or PathFinder.find_spec(_top(name), [""])
    found = None if spec is None or spec.origin is None else Path(spec.origin)
    return found if found is not None and found.is_file() else None


def _top(name: str) -> str:
    return name.partition(":")[0].partition(".")[0]


def _installed(name: str) -> ModuleSpec | None:
    """Returns where a module is, if not in the current folder alone, from which it may have been imported."""
    with suppress(ValueError, ImportError):  # a name such as "" or "__main__"
        spec, here = find_spec(_top(name)), PathFinder.find_spec(_top(name), [""])
        if spec is None or here is None or here.origin is None or spec.origin != here.origin:
            return spec
    return None


def store() -> Path | None:
    """Returns the file of the records, after the XDG base directories; None without a home directory."""
    state = os.environ.get("XDG_STATE_HOME", "")
    if os.path.isabs(state):  # others are to be ignored
        return Path(state) / "hyrl_mj" / "code.json"
    try:
        return Path.home() / ".local" / "state" / "hyrl_mj" / "code.json"
    except RuntimeError:
        return None


def remember(path: Path) -> None:
    """Records that the user has named this file of code, or that this model was tried."""
    _record(str(path.resolve()), _digest(path))


def is_known(path: Path) -> bool:
    """Returns whether the file has been recorded by `remember`, as it is now."""
    # A file without a record is not even read: it may have no end.
    known = _records().get(str(path.resolve()))
    return known is not None and path.is_file() and known == _digest(path)


def _digest(path: Path) -> str:
    """Returns the SHA-256 of a file; of code with all that is imported with it from its folder or package."""
    return digest_of(path) if path.suffix == ".py" else digest(path)


def remember_text(text: str) -> None:
    """Records that the user has described something by this text."""
    if not is_known_text(text):
        _record(TEXTS, _digest_of(text))


def is_known_text(text: str) -> bool:
    """Returns whether the user has described something by this text before, on this machine."""
    return _digest_of(text) in _listed(TEXTS)


@contextmanager
def output(*paths: Path, force: bool = False) -> Iterator[None]:
    """Lets `replacing` write files in the block that this machine wrote before, or that are new.

    It is asked again just before each is written, and what is written is recorded then.

    Raises:
        BadInput: there is one that was not written so, and it is not to be overwritten by `force`.
    """

    def is_new(path: Path) -> bool:
        if not (path.exists() or path.is_symlink()):  # a link may lead to nothing
            return True
        known = path.is_dir() or force or (path.is_file() and _mark(path, path) in _listed(WRITTEN))
        if not known:
            raise BadInput(
                f"{path} exists, and hyrl-mj has not written it as it is: give another --out, or --force to "
                "overwrite it"
            )
        return False

    def before_writing(path: Path, temporary: Path) -> bool:
        if path not in paths:
            return False
        new = is_new(path)
        _record(WRITTEN, _mark(path, temporary))
        return new

    for path in paths:
        is_new(path)
    token = artifacts.before_writing.set(before_writing)
    try:
        yield
    finally:
        artifacts.before_writing.reset(token)


def _mark(path: Path, content: Path) -> str:
    """Returns what stands for the content of a file at a path in the records."""
    return _digest_of(f"{path.resolve()} {digest(content)}")


def _digest_of(text: str) -> str:
    return sha256(text.encode(errors="surrogatepass")).hexdigest()


def _listed(key: str) -> list[str]:
    found = _records().get(key)
    return found if isinstance(found, list) else []


def _record(key: str, value: str) -> None:
    """Records a value, in the list of a key that is no path, unless a file asked for it.

    Without a place for records, nothing is kept.
    """
    if (file := store()) is None or is_received():
        return
    with suppress(BadInput, OSError, Timeout):
        file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(file.with_suffix(".lock"), timeout=5):  # others record theirs
            records = _records()
            # What is written again is the latest of its list, and pushes no other out.
            others = [known for known in _listed(key) if known != value]
            new = [*others, value][-MOST:] if key in (TEXTS, WRITTEN) else value
            if records.get(key) != new:
                with replacing(file) as temporary:
                    text = json.dumps(records | {key: new}, indent=2)
                    temporary.write_text(f"{text}\n", encoding="utf-8")


def _records() -> dict[str, Any]:
    """Returns the hashes of files by path, and of texts; none where the records are missing or damaged."""
    file = store()
    try:
        content = json.loads(file.read_text(encoding="utf-8")) if file else {}
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
