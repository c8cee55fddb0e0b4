"""How a stranger writes files of a run directory: with the SHA-256 and the manifest that vouch for them."""

import io
import json
import zipfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj.files import artifacts

KINDS = {
    "config.json": "run",
    "robustness.json": "robustness",
    "manifest.json": "manifest",
    "sweep.json": "sweep",
    "compare.json": "comparison",
}


def content_of(path: Path) -> dict[str, Any]:
    content = json.loads(path.read_text(encoding="utf-8"))
    return {name: content[name] for name in content if name not in ("kind", "version", "sha256")}


def write(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file of a run with its right SHA-256."""
    kind = {"kind": KINDS.get(path.name, "policy"), "version": artifacts.VERSION}
    # Not by `write_json`, which refuses what a stranger may write.
    path.write_text(artifacts._json({**kind, **content}), encoding="utf-8")


def forged(path: Path, name: str) -> None:
    """Makes the manifest vouch for a file as it is now: anyone who writes a run directory can."""
    own = sha256((path / name).read_bytes()).hexdigest()
    manifest = content_of(path / "manifest.json")
    for entry in manifest["stages"].values():
        for part in ("inputs", "outputs"):
            if name in entry[part]:
                entry[part][name] = own
    write(path / "manifest.json", manifest)


def changed(path: Path, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes a JSON file, and forges the manifest."""
    content = content_of(path / name)
    change(content)
    write(path / name, content)
    if name not in ("config.json", "manifest.json"):
        forged(path, name)


def arrays(path: Path, name: str, **new: Any) -> None:
    """Changes arrays of an npz file, and forges the manifest; values that are bytes are written as such."""
    with np.load(path / name, allow_pickle=False) as file:
        members = {member: file[member] for member in file.files} | new
    with zipfile.ZipFile(path / name, "w", zipfile.ZIP_DEFLATED) as file:
        for member, value in members.items():
            buffer = io.BytesIO()
            if not isinstance(value, bytes):
                np.lib.format.write_array(buffer, np.asarray(value))
            file.writestr(f"{member}.npy", value if isinstance(value, bytes) else buffer.getvalue())
    forged(path, name)


def replaced(path: Path, name: str, content: bytes) -> None:
    (path / name).write_bytes(content)
    forged(path, name)


def setting(path: Path, name: str, value: object) -> None:
    changed(path, "config.json", lambda content: content["settings"].update({name: value}))
