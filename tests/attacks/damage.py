"""Files of a finished run that are truncated or have one bit flipped."""

from base64 import b64encode
from collections import defaultdict
from functools import cached_property, partial
from pathlib import Path
from random import Random

import hyrl_mj
from attacks import Answer, Trial, child, command, differences, files
from attacks.material import RUN, TASK, Material
from hyrl_mj.errors import HyrlError
from hyrl_mj.runs.directory import Run

# Files whose damage no command can mend, because they say what the run is.
FOUNDATION = ("config.json",)


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns trials on files of each kind in turn; every second one truncates, the others flip a bit."""
    by_kind = defaultdict(list)
    for name, path in files(material.finished()).items():
        by_kind[path.suffix].append(name)
    kinds = sorted(by_kind)
    found = []
    for number in range(count):
        name = draw.choice(by_kind[kinds[number // 2 % len(kinds)]])
        size = (material.finished() / name).stat().st_size
        if number % 2:
            place, bit = draw.randrange(size), draw.randrange(8)
            found.append(
                Trial(
                    f"{name}, bit {bit} of byte {place} flipped",
                    partial(_attempt, material, name, place, bit),
                )
            )
        else:
            kept = draw.randrange(size)
            found.append(
                Trial(
                    f"{name}, truncated to {kept} bytes",
                    partial(_attempt, material, name, kept, None),
                )
            )
    return found


def _attempt(material: Material, name: str, place: int, bit: int | None, folder: Path) -> str:
    """Damages a file of a copy, opens everything, writes a report, and resumes the run."""
    path = material.copy(folder)
    content = bytearray((path / name).read_bytes())
    if bit is None:
        del content[place:]
    else:
        content[place] ^= 1 << bit
    (path / name).write_bytes(content)
    damaged = bytes(content)
    opened = child(partial(open_everything, path), folder)
    if broke := opened.broke():
        return f"opened: {broke}"
    reported = child(command("report", TASK, "--out", "page.html"), folder)
    if broke := reported.broke(ended=(0, 2)):
        return f"reported: {broke}"
    if broke := _believed(name, damaged, opened, reported, folder):
        return broke
    resumed = child(command(*RUN), folder)
    if broke := resumed.broke(ended=(0, 1, 2)):
        return f"resumed: {broke}"
    if resumed.status == 2:
        return "" if name in resumed.err else f"the sentence does not name {name}: {resumed.err!r}"
    wrong = differences(path, material.finished())
    return f"resumed, and not as before: {wrong}" if wrong else ""


def _believed(name: str, damaged: bytes, opened: Answer, reported: Answer, folder: Path) -> str:
    """Returns how a damaged file was used without a word, "" if it was not."""
    page = folder / "page.html"
    shown = page.read_text(encoding="utf-8") if page.exists() else ""
    if name.endswith((".png", ".mp4")):
        return "the report shows it" if b64encode(damaged).decode() in shown else ""
    if name.endswith((".html", ".pdf")) or name == "robustness.npz":
        return ""  # nothing reads them: `run` makes them again
    if name not in opened.err:
        return f"opening everything does not name it: {opened.err!r}"
    return ""


def open_everything(path: Path) -> None:
    """Opens a run directory and each of its results; a result that cannot be opened prints its sentence."""
    import sys

    run = None
    found = [n for n, v in vars(Run).items() if isinstance(v, property | cached_property)]
    results = [name for name in found if not name.startswith("_")]
    try:
        run = hyrl_mj.load_run(path)
        arcs = run.arc_paths()
    except HyrlError as error:
        print(f"hyrl-mj: {error}", file=sys.stderr)
        arcs = {}
    if run is None:
        return
    for result in results:
        try:
            getattr(run, result)
        except HyrlError as error:
            print(f"hyrl-mj: {error}", file=sys.stderr)
    for file in [*arcs.values(), *sorted((path / "arcs").glob("latest_*"))]:
        try:
            run.arc(file)
        except HyrlError as error:
            print(f"hyrl-mj: {error}", file=sys.stderr)
