"""The manifest of a run directory: which stage wrote each file and from what; and one writer at a time.

A stage is recorded after all of its files are written. A file is believed only if its stage is recorded with
the present settings, its SHA-256 is the recorded one, and what the stage read has not changed since.
Modification times mean nothing.
"""

from __future__ import annotations

import os
import re
import shlex
import stat
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

from filelock import FileLock, Timeout

from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.files.artifacts import digest

NAME, LOCK = "manifest.json", ".lock"
LARGEST = 2**20  # [bytes]; a manifest is read many times
REMEDY = "remove it, and all stages run again"
# The names of the files that each stage may write: no other file is ever believed.
FILES = {
    "train": r"policy\.(safetensors|json|onnx)|vecnormalize\.npz|arrivals\.json|figures/arrivals\.(png|pdf)",
    "critical-set": r"critical_set\.npz",
    "partition": r"partition\.npz",
    "diagnose": r"diagnosis\.html|diagnosis/(robustness\.json|worst\.(npz|mp4)|\w+\.(png|pdf))",
    "extended-sets": r"(extended_sets|split)\.npz",
    "retrain": r"mode_\d+(\.safetensors|(_part)?\.json|_table\.npz)|retraining\.json",
    "robustness": r"robustness\.(json|npz)|arcs/attack_\w+\.npz|figures/robustness_\w+\.(png|pdf)",
    "simulate": r"arcs/(start\d+|critical)_(policy|hyrl_q\d+)\.npz",
    "simulate --start": r"arcs/latest_\w+\.npz",
    "figures": r"figures/(?!robustness_|arrivals\.)\w+\.(png|pdf)",
    "replay": r"replay\.(mp4|png)",
    "report": r"report\.html",
}


class Busy(BadInput):
    """Another process or thread works on the run directory."""


@dataclass(frozen=True)
class Entry:
    """What is recorded of a finished stage.

    Attributes:
        settings: SHA-256 of the settings that it was made with.
        code: SHA-256 of the files that define the user's task; "" for a task of an installed package.
        inputs: SHA-256 of each file that it read; "" for a file that it did without.
        outputs: SHA-256 of each file that it wrote.
        version: the version of this package that made it.
    """

    settings: str
    code: str
    inputs: dict[str, str]
    outputs: dict[str, str]
    version: str


@dataclass(frozen=True)
class _Stages:
    stages: dict[str, Entry]


# What the stage at work has read, as `Entry.inputs`.
_read: ContextVar[dict[str, str] | None] = ContextVar("read", default=None)


@dataclass(frozen=True)
class Manifest:
    """The manifest of a run directory, which is read anew for each question.

    Attributes:
        folder: the run directory.
        settings: SHA-256 of the present settings, by stage.
        code: that of the task, as in `Entry`.
    """

    folder: Path
    settings: Mapping[str, str]
    code: str = ""

    @contextmanager
    def stage(self, stage: str) -> Iterator[None]:
        """Records a stage, which reads files with `checked` and writes its own in this block.

        Other files that it has recorded before are removed at the end. A block that writes nothing
        changes nothing.

        Args:
            stage: one of `FILES`.

        Raises:
            BadInput: another process works on the run directory, or it cannot be written.
        """
        with locked(self.folder):
            written: list[Path] = []
            before = self._entries().get(stage)

            def before_writing(path: Path, temporary: Path) -> bool:
                if re.fullmatch(FILES[stage], self._name(path)):
                    written.append(path)
                    entries = self._entries()
                    if entries.pop(stage, None):  # from now on its files do not belong together
                        self._write(entries)
                return False

            read: dict[str, str] = {}
            tokens = _read.set(read), artifacts.before_writing.set(before_writing)
            try:
                yield
            finally:
                _read.reset(tokens[0])
                artifacts.before_writing.reset(tokens[1])
            if not written:
                return
            outputs = {self._name(path): digest(path) for path in written}
            for name in (before.outputs.keys() if before else set()) - outputs.keys():
                (self.folder / name).unlink(missing_ok=True)
            entry = Entry(self.settings[stage], self.code, read, outputs, version("hyrl-mj"))
            self._write(self._entries() | {stage: entry})

    def is_done(self, stage: str) -> bool:
        """Returns whether a stage is finished by this version, and all of its files are to be believed.

        What another version has made can still be read.
        """
        entries = self._entries()
        entry = entries.get(stage)
        if entry is None or entry.version != version("hyrl-mj"):
            return False
        # All of its files are hashed where a run is opened, so they are no larger together [bytes].
        if sum(map(self._size, entry.outputs)) > 2**28:
            return False
        return not any(self._doubt(name, entries) for name in entry.outputs)

    def other_versions(self, stages: Collection[str]) -> list[str]:
        """Returns the other versions of this package that have made some of these stages.

        Such stages are not done, as `is_done` says.
        """
        made = {e.version for name, e in self._entries().items() if name in stages}
        return sorted(made - {version("hyrl-mj")})

    def _size(self, name: str) -> int:
        """Returns the size of a file [bytes]; 0 if it is missing."""
        path = self.folder / name
        return path.stat().st_size if path.is_file() else 0

    def checked(self, path: Path) -> Path:
        """Returns the path of a file of the run directory itself, if the file is to be believed.

        Raises:
            BadArtifact: it is missing, unfinished, damaged or outdated; the message names its stage.
        """
        name, entries = self._name(path), self._entries()
        while (doubt := self._doubt(name, entries)) and entries != (new := self._entries()):
            entries = new  # a stage has begun or ended meanwhile, which explains the doubt
        if doubt:
            stage = next((s for s, names in FILES.items() if re.fullmatch(names, name)), None)
            if stage is None:
                raise BadArtifact(f"{path} is no file that a run writes, so nothing vouches for it")
            raise BadArtifact(f"{path} {doubt}: {_remedy(stage, self.folder, entries)}")
        self._note(name, self._current(entries)[name])
        return path

    def has(self, path: Path) -> bool:
        """Returns whether a file that a stage may leave out was made, and is up to date.

        What shows a run may be removed; without what its controller is made of it would be another one.

        Raises:
            BadArtifact: it is damaged, or missing though the controller was made of it.
        """
        name = self._name(path)
        of_controller = any(re.fullmatch(FILES[s], name) for s in ("extended-sets", "retrain"))
        if name in self._current(self._entries()) and (path.is_file() or of_controller):
            return self.checked(path) == path
        self._note(name, "")
        return False

    def _doubt(self, name: str, entries: Mapping[str, Entry]) -> str:
        """Returns why a file is not to be believed after the entries of a manifest, "" if it is."""
        path = self.folder / name
        recorded = {name: sha for entry in entries.values() for name, sha in entry.outputs.items()}
        if not path.is_file():
            return "is missing"
        if name not in recorded:
            return "is of a stage that did not finish"
        try:
            if path.stat().st_size > artifacts.LARGEST:
                return (
                    f"is larger than {artifacts.LARGEST / 2**20:g} MiB, which no file of a run is"
                )
            if digest(path) != recorded[name]:
                return "was changed after it was written (its sha256 does not fit)"
        except FileNotFoundError:  # a stage has just removed it
            return "is missing"
        return "" if name in self._current(entries) else "is older than what it was made from"

    def _current(self, entries: Mapping[str, Entry]) -> dict[str, str]:
        """Returns the SHA-256 of each file whose settings, code and inputs have not changed since."""
        current: dict[str, str] = {}
        for stage in FILES:  # each reads only files of stages before it
            entry = entries.get(stage)
            if entry and (entry.settings, entry.code) == (self.settings[stage], self.code):
                inputs = entry.inputs.items()
                if all(current.get(name, "") == content for name, content in inputs):
                    current |= entry.outputs
        return current

    def _note(self, name: str, content: str) -> None:
        """Records that the stage at work has read a file."""
        if (read := _read.get()) is not None:
            read[name] = content

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix() if path.is_relative_to(self.folder) else ""

    def _entries(self) -> dict[str, Entry]:
        path = self.folder / NAME
        if not path.is_file():
            return {}
        if path.stat().st_size > LARGEST:
            raise BadArtifact(f"{path} is larger than any manifest: {REMEDY}")
        with artifacts.reading(path, REMEDY):
            return dict(_recorded(artifacts.read_limited(path, LARGEST)))

    def _write(self, entries: dict[str, Entry]) -> None:
        """Writes the manifest; in whichever order stages ran, the same results are the same bytes."""
        in_order = {stage: entries[stage] for stage in FILES if stage in entries}
        artifacts.write_json(self.folder / NAME, _Stages(in_order), kind="manifest")


@lru_cache(8)
def _recorded(text: bytes) -> dict[str, Entry]:
    """Returns the entries in a manifest. Nearly always it is as it was when it was last asked."""
    stages = artifacts.parsed_json(
        text.decode(),
        "manifest",
        lambda content: artifacts.parsed(content, _Stages, REMEDY),
        REMEDY,
    ).stages
    for stage, entry in stages.items():
        for name in entry.outputs:
            if stage not in FILES or not re.fullmatch(FILES[stage], name):
                raise BadArtifact(f"no stage {stage!r} writes {name!r}: {REMEDY}")
    return stages


def _remedy(stage: str, folder: Path, done: Collection[str]) -> str:
    """Returns how to make a file of a stage again, where the stages `done` were made."""
    if "diagnose" in done and not {stage, "extended-sets"} & {*done}:
        return "the run is a diagnosis, go on with hyrl-mj robustify and the same arguments"
    if stage == "simulate --start":
        return f"simulate it again with hyrl-mj simulate {shlex.quote(str(folder))} --start ..."
    resumed = "by giving the command again that made the run"
    if stage in ("train", "diagnose"):
        return f"run the stage {stage} again {resumed}"
    again = f"hyrl-mj {stage} {shlex.quote(str(folder))}"
    return f"run the stage that writes it again, with {again} or {resumed}"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Holds the lock of a run directory, which one thread of one process can hold, more than once.

    The directory is made if it is missing. A block that writes nothing leaves no lock and no directory that
    were not there before.

    Raises:
        Busy: another process or thread works there; the message says which and since when.
        BadInput: the directory cannot be written.
    """
    path = folder.resolve() / LOCK
    check_contents(folder)
    lock = FileLock(path, is_singleton=True)
    had_folder, had_lock = folder.exists(), path.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(blocking=False)
    except Timeout:
        holder = ""
        with suppress(OSError, ValueError):
            holder = f" ({path.read_text(encoding='utf-8').strip()})"
        raise Busy(
            f"another process is working on {folder}{holder}: wait until it ends, or choose another "
            "folder"
        ) from None
    except OSError as error:
        raise artifacts.not_writable(folder, error) from error
    try:
        if lock.lock_counter == 1:
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            with suppress(OSError):
                path.write_text(f"process {os.getpid()}, since {since}\n", encoding="utf-8")
            for left in _left_in(folder):
                left.unlink(missing_ok=True)
        yield
    finally:
        if lock.lock_counter == 1:
            with suppress(
                OSError
            ):  # somebody puts something there, or an open file cannot be removed
                path.write_text("", encoding="utf-8")  # a finished run directory is always the same
                if not had_lock and os.listdir(folder) == [LOCK]:
                    path.unlink()
                    if not had_folder:
                        folder.rmdir()
        lock.release()


def _left_in(folder: Path) -> Iterator[Path]:
    """Yields temporary files of a process that was killed, not those in folders with a lock of their own."""
    for root, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not Path(root, name, LOCK).exists()]
        for name in files:
            if artifacts.TEMPORARY.fullmatch(name):
                yield Path(root, name)


def check_may_hold(folder: Path, name: str, what: str) -> None:
    """Raises `BadInput` if a folder is there, but is not `what`, "a run directory", with a file `name`.

    It may hold nothing but what a process left that was killed at once.
    """
    if folder.is_dir():
        names = {path.name for path in folder.iterdir()}
        left = {name for name in names if name == LOCK or artifacts.TEMPORARY.fullmatch(name)}
        if name in names or names == left:
            return
    if folder.exists():
        raise BadInput(f"{folder} exists and is not {what}: choose another --out")


def check_contents(folder: Path) -> None:
    """Raises `BadArtifact` if a run directory holds what leads out of it, or what no run has.

    These are links, a lock that is a second name of another file, and folders far within each other.
    """
    for root, folders, files in os.walk(folder):
        if len(Path(root).relative_to(folder).parts) > 8:
            raise BadArtifact(
                f"{folder} holds more than 8 folders within each other: it is no run directory"
            )
        for name in (*folders, *files):
            path = Path(root, name)
            try:
                status = path.lstat()
            except FileNotFoundError:  # a temporary file of another process
                continue
            kind = stat.S_IFMT(status.st_mode)
            if kind not in (stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK):
                raise BadArtifact(
                    f"{path} is no file: a run directory holds files and folders alone"
                )
            if kind == stat.S_IFLNK or (
                name == LOCK and kind == stat.S_IFREG and status.st_nlink > 1
            ):
                raise BadArtifact(
                    f"{path} is a link, and a run directory holds none: put the file itself there"
                )
