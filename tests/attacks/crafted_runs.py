"""Run directories of a stranger: payloads, links, bombs, lies. None may do harm, whatever is done with it."""

import os
import struct
import zipfile
import zlib
from base64 import b64encode
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from attacks import MARKER
from attacks.crafted_agents import ESCAPE, header, overlapping, zeros
from attacks.forgery import arrays, changed, forged, replaced, setting

SCRIPT = "<script>alert('executed')</script>"
SECRET = b"this is the user's own text, and nobody else's"
ENCODED = b64encode(SECRET).decode()


# ---- code


def evil(folder: Path, name: str = "evil.py") -> Path:
    """Writes a file of code that leaves the marker behind."""
    path = folder / name
    path.write_text(f"open({str(folder / MARKER)!r}, 'w').close()\nclass X: pass\n")
    return path


def config_names_code(folder: Path, path: Path, task: str) -> None:
    evil(folder)
    evil(path)
    setting(path, "task", task.format(folder=folder, path=path))


def names_endless_code(folder: Path, path: Path, text: str) -> None:
    """A file of code of 4 GB, or one that Python's parser cannot read: it must not even be read."""
    with evil(path).open("w") as file:
        file.write(text)
        if not text:
            file.truncate(2**32)
    setting(path, "task", str(path / "evil.py"))


def names_module(folder: Path, path: Path, stage: str) -> None:
    evil(folder, "evilmod.py")
    evil(path, "evilmod.py")
    changed(path, "config.json", lambda c: c["settings"][stage].update(algorithm="evilmod:X"))


def calls_in_header(folder: Path, path: Path) -> None:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': (open({MARKER!r}, 'w').fileno(),)}}"
    raw = text.encode().ljust(118) + b"\n"
    magic = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(raw)) + raw
    arrays(path, "critical_set.npz", points=magic + bytes(8))


# ---- shapes and sizes


def npy(shape: str, descr: str = "<f8", rest: bytes = b"") -> bytes:
    """Returns an npy member with a header of one's own."""
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}}}"
    raw = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(raw)) + raw + rest


def overlapping_arrays(folder: Path, path: Path) -> None:
    """A thousand arrays of 16 MB that share their bytes."""
    content = npy("(16777216,)", "|u1", bytes(2**24))
    names = [f"{number}.npy" for number in range(1_000)]
    replaced(path, "partition.npz", overlapping(names, content))


def array_bomb(folder: Path, path: Path) -> None:
    with zipfile.ZipFile(path / "partition.npz", "w", zipfile.ZIP_DEFLATED) as file:
        zeros(file, "succeeds.npy")
    forged(path, "partition.npz")


def sparse(folder: Path, path: Path, name: str) -> None:
    with (path / name).open("wb") as file:
        file.truncate(2**32)


def picture_bomb(folder: Path, path: Path) -> None:
    """A picture of 60,000 x 60,000 pixels in a few bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">L", len(data)) + kind + data + struct.pack(">L", zlib.crc32(kind + data))
        )

    size = struct.pack(">LLBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    data = zlib.compress(bytes(60_001 * 100))
    whole = chunk(b"IHDR", size) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    replaced(path, "figures/extended_sets.png", b"\x89PNG\r\n\x1a\n" + whole)


def many_files(folder: Path, path: Path) -> None:
    for number in range(20_000):
        (path / "arcs" / f"start{number + 100}_policy.npz").touch()


def deep_folders(folder: Path, path: Path) -> None:
    here = os.open(path, os.O_RDONLY)
    for _ in range(1500):
        os.mkdir("d", dir_fd=here)
        below = os.open("d", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
    os.close(here)


# ---- links, and what is no file


def linked(folder: Path, path: Path, name: str, target: str) -> None:
    """Puts a link in the place of a file or a folder."""
    place = path / name
    if place.is_dir():
        place.rename(folder / "aside")
    else:
        place.unlink(missing_ok=True)
    place.symlink_to(target.format(folder=folder, victim=folder / "victim"))


def hard_linked(folder: Path, path: Path, name: str) -> None:
    (path / name).unlink(missing_ok=True)
    (path / name).parent.mkdir(exist_ok=True, parents=True)
    os.link(folder / "victim" / "secret.txt", path / name)


def piped(folder: Path, path: Path, name: str) -> None:
    (path / name).unlink(missing_ok=True)
    os.mkfifo(path / name)


def folder_for_file(folder: Path, path: Path, name: str) -> None:
    (path / name).unlink(missing_ok=True)
    (path / name / "inside").mkdir(parents=True)


def file_for_folder(folder: Path, path: Path, name: str) -> None:
    (path / name).rename(folder / "aside")
    (path / name).write_text("no folder")


# ---- manifests


def manifest(folder: Path, path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    changed(path, "manifest.json", lambda content: change(content["stages"]))


def claims(stages: dict[str, Any], *names: str) -> None:
    for name in names:
        stages["simulate"]["outputs"][name] = "0" * 64


def text(folder: Path, path: Path, name: str, content: str) -> None:
    (path / name).write_text(content, encoding="utf-8", errors="surrogatepass")


def robustness_says(folder: Path, path: Path, what: str) -> None:
    """Strings that the report shows."""

    def change(content: dict[str, Any]) -> None:
        count = {
            "noise": what, "eps": 0.1, "everywhere": False, "controller": "hyrl", "region": what,
            "episodes": 4, "outcomes": {what: 4}, "reached": 0.5, "interval": [0.1, 0.9],
        }  # fmt: skip
        content["episodes"] = [count, {**count, "controller": "policy"}]

    changed(path, "robustness.json", change)


def versions_say(folder: Path, path: Path, what: str) -> None:
    changed(path, "config.json", lambda content: content["versions"].update({what: what}))


DIRECTORIES: dict[str, Callable[[Path, Path], None]] = {
    "config.json names a file of code in itself": partial(config_names_code, task="{path}/evil.py"),
    "config.json names a file of code near by": partial(config_names_code, task="evil.py"),
    "config.json names a file of code of 4 GB": partial(names_endless_code, text=""),
    "config.json names a file of code that is nested": partial(
        names_endless_code, text="-" * 200_000 + "1"
    ),
    "config.json names a module for stage 1": partial(names_module, stage="stage1"),
    "config.json names a module for stage 6": partial(names_module, stage="stage6"),
    "a call in the header of an array": calls_in_header,
    "an npz bomb": array_bomb,
    "an npz whose arrays overlap": overlapping_arrays,
    "an array of 2**31 numbers": lambda folder, path: arrays(
        path, "partition.npz", succeeds=npy("(2147483648,)", "|b1")
    ),
    "an array of records of 2 GB": lambda folder, path: arrays(
        path, "partition.npz", succeeds=npy("(1,)", "|V2147483647")
    ),
    "a hundred thousand modes": lambda folder, path: arrays(
        path, "extended_sets.npz", modes=np.arange(100_000)
    ),
    "modes that are NaN": lambda folder, path: arrays(
        path, "extended_sets.npz", modes=np.array([np.nan, np.inf])
    ),
    "an empty M* in three dimensions": lambda folder, path: arrays(
        path, "critical_set.npz", points=np.zeros((4, 3)), component=np.zeros(4, int)
    ),
    "an arc that colours the terminal": lambda folder, path: arrays(
        path, "arcs/start0_policy.npz", outcome=np.array(ESCAPE), noise=np.array(ESCAPE)
    ),
    "weights that are NaN": lambda folder, path: replaced(
        path, "mode_0.safetensors",
        (path / "mode_0.safetensors").read_bytes()[:-4] + struct.pack("<f", np.nan),
    ),
    "weights of 2**62 numbers": lambda folder, path: replaced(
        path, "mode_0.safetensors", header({"a": {
            "dtype": "F32", "shape": [2**31, 2**31], "data_offsets": [0, 64]}}, rest=bytes(64)),
    ),
    "a picture of 60,000 x 60,000 pixels": picture_bomb,
    "20,000 files": many_files,
    "1,500 folders, each in the one before": deep_folders,
    **{
        f"4 GB of nothing for {name}": partial(sparse, name=name)
        for name in ("config.json", "manifest.json", "replay.mp4", "policy.safetensors", ".lock")
    },
    **{
        f"{name} is a link to {target.format(victim='VICTIM', folder='HERE')}": partial(
            linked, name=name, target=target
        )
        for name, target in (
            ("arcs", "{victim}"), ("figures", "{victim}"), ("replay.mp4", "{victim}/secret.txt"),
            ("figures/extended_sets.png", "{victim}/secret.txt"), (".lock", "{victim}/secret.txt"),
            ("manifest.json", "{victim}/secret.txt"), ("config.json", "{victim}/secret.txt"),
            ("logs", "{victim}"), (".report.partial.html", "{victim}/secret.txt"),
            ("report.html", "{victim}/new.html"), ("loop", "loop"), ("arcs/start0_policy.npz", "/etc/passwd"),
        )
    },
    **{
        f"{name} is a second name of a file of the user's": partial(hard_linked, name=name)
        for name in (".lock", "report.html", "replay.mp4", "logs/stage1/progress.csv")
    },
    **{
        f"{name} is a pipe": partial(piped, name=name)
        for name in (".lock", "config.json", "manifest.json", "policy.json", "replay.mp4")
    },
    **{
        f"{name} is a folder": partial(folder_for_file, name=name)
        for name in (".lock", "manifest.json", "mode_0.json", "replay.mp4", "report.html",
                     ".policy.0123456789ab.partial.json")
    },
    "arcs is a file": partial(file_for_folder, name="arcs"),
    "figures is a file": partial(file_for_folder, name="figures"),
    "the manifest claims a name in two lines": partial(
        manifest, change=lambda stages: claims(stages, "arcs/start1_policy.npz\n")
    ),
    "the manifest claims 100,000 files": partial(
        manifest,
        change=lambda stages: claims(stages, *(f"arcs/start{n}_policy.npz" for n in range(100_000))),
    ),
    "the manifest has a stage that nobody knows": partial(
        manifest, change=lambda stages: stages.update({ESCAPE: stages["train"]})
    ),
    "a deep config.json": partial(text, name="config.json", content="[" * 10**5 + "]" * 10**5),
    "a config.json with half a character": partial(
        text, name="config.json", content='{"kind": "run", "version": 2, "a": "\\ud800"}'
    ),
    "a deep manifest": partial(text, name="manifest.json", content='{"a":' * 10**5),
    "a version that colours the terminal": partial(versions_say, what=ESCAPE),
    "a version that is a script": partial(versions_say, what=SCRIPT),
    "episodes that are a script": partial(robustness_says, what=SCRIPT),
    "episodes that colour the terminal": partial(robustness_says, what=ESCAPE),
    "a task that is a script": lambda folder, path: setting(path, "task", SCRIPT),
    "a preset that is a script": lambda folder, path: setting(path, "preset", SCRIPT),
}  # fmt: skip
