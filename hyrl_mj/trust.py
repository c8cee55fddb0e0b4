"""The code of the user's that this machine has run: only such code is loaded without being named again.

A run directory names the file of its task. Opening a directory from a stranger must not run that file, and
opening a run of one's own should not ask for it each time. So whenever the user names a file, its path and
SHA-256 are recorded outside all run directories.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hyrl_mj.artifacts import digest, replacing
from hyrl_mj.errors import BadInput


@contextmanager
def current_folder() -> Iterator[None]:
    """Lets modules in the current folder be imported in the block, which a command does not do by itself."""
    sys.path.insert(0, "")
    try:
        yield
    finally:
        sys.path.remove("")


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
    """Records that the user has named this file of code; without a place for records, nothing is kept."""
    file, records = store(), _records()
    entry = {str(path.resolve()): digest(path)}
    if file is None or records | entry == records:
        return
    with suppress(BadInput), replacing(file) as temporary:
        temporary.write_text(json.dumps(records | entry, indent=2) + "\n", encoding="utf-8")


def is_known(path: Path) -> bool:
    """Returns whether this machine has run the file, as it is now, because the user named it."""
    # A file without a record is not even read: it may have no end.
    known = _records().get(str(path.resolve()))
    return known is not None and path.is_file() and known == digest(path)


def _records() -> dict[str, str]:
    """Returns the hashes of the files by path; none where the records are missing or damaged."""
    file = store()
    try:
        content = json.loads(file.read_text(encoding="utf-8")) if file else {}
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
