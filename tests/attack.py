"""Attacks hyrl_mj: crashes, kills, damaged and crafted files, wrong settings and tasks, rivals, bad machines.

    python tests/attack.py                        # all of it
    python tests/attack.py --short                # a sample of each attack
    python tests/attack.py --only agents --match zip --seed 3

Prints for each attack how many trials were made, survived and broke, and a line about each trial that broke;
the exit status is 1 if any did.
"""

import os

# Before anything is imported: forked processes take one thread each, and draw without a screen.
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import multiprocessing
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random

from attacks import (
    Trial,
    configurations,
    crashes,
    damage,
    disks,
    doors,
    kills,
    received,
    small,
    surroundings,
    tasks,
    writers,
)
from attacks.material import Material
from rich.console import Console
from rich.table import Table

# Twice as many as a small machine has cores: half of their time trials wait for what never comes. With six
# the same trials take more time of the processor, and no less in all.
PROCESSES = 4


@dataclass(frozen=True)
class Attack:
    """An attack: its trials, and how many of them are made.

    Attributes:
        what: is done, in the table.
        trials: (material, random numbers, count) -> the trials; those that follow from a run may be fewer.
        count, short: number of trials, and with `--short`.
    """

    what: str
    trials: Callable[[Material, Random, int], list[Trial]]
    count: int
    short: int


ATTACKS = {
    "crashes": Attack("crashed before and after a rename, then resumed", crashes.trials, 10, 1),
    "kills": Attack(
        "killed at a random moment, resumed while the clock is set back", kills.trials, 50, 1
    ),
    "disks": Attack("a disk that is full, and then has room", disks.trials, 6, 1),
    "artifacts": Attack("truncated, or one bit flipped", damage.trials, 20, 2),
    "agents": Attack("crafted agents of a stranger", received.agents, 100, 2),
    "received": Attack("crafted run directories of a stranger", received.runs, 25, 1),
    "doors": Attack("generated descriptions of a stranger", doors.trials, 575, 8),
    "configurations": Attack(
        "one setting changed, through every stage", configurations.trials, 200, 4
    ),
    "tasks": Attack("task file or MJCF with one mistake", tasks.trials, 100, 2),
    "writers": Attack("two and four writers, and a reader", writers.trials, 4, 1),
    "surroundings": Attack("pairs of bad surroundings", surroundings.trials, 4, 1),
}

# An attack, a trial of it, what broke, how long it took and was busy [s].
Result = tuple[str, str, str, float, float]
# The trials that are under way, for the forked processes that make them.
UNDER_WAY: list[tuple[str, Trial]] = []


def attempt(index: int) -> Result:
    """Makes a trial, and returns its attack, its name, what broke, and how long it took and was busy [s]."""
    attack, trial = UNDER_WAY[index]
    began, busy = time.monotonic(), spent()
    with scratch() as folder:
        try:
            broke = trial.attempt(folder)
        except Exception:  # a mistake of the attack's own must not end the others
            broke = f"the attack itself failed: {traceback.format_exc()}"
    return attack, trial.name, broke, time.monotonic() - began, spent() - busy


def spent() -> float:
    """Returns for how long this process and those of its own that have ended were busy [s]."""
    return sum(os.times()[:4])


@contextmanager
def scratch() -> Iterator[Path]:
    """Makes an empty folder, which everybody may read, and removes it after the block."""
    folder = Path(tempfile.mkdtemp(prefix="attack_"))
    folder.chmod(0o755)
    try:
        yield folder
    finally:
        # Python's own removal gives up in a thousand folders, each in the one before.
        subprocess.run(["rm", "-rf", folder], check=True)


def table(results: list[Result]) -> Table:
    """Returns the numbers of trials by attack."""
    printed = Table()
    for heading in ("attack", "what", "tried", "survived", "broke", "seconds", "busy"):
        printed.add_column(heading)
    for name in dict.fromkeys(result[0] for result in results):
        own = [result for result in results if result[0] == name]
        broke = sum(bool(result[2]) for result in own)
        counts = (len(own), len(own) - broke, broke)
        seconds = (f"{sum(result[i] for result in own):.0f}" for i in (3, 4))
        printed.add_row(name, ATTACKS[name].what, *map(str, counts), *seconds)
    return printed


def main() -> int:
    """Makes the trials, and returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help=f"some of {','.join(ATTACKS)}")
    parser.add_argument("--match", default="", help="only trials whose name this expression is in")
    parser.add_argument("--short", action="store_true", help="a sample of each attack")
    parser.add_argument("--count", type=int, help="trials of each attack, before --match")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random numbers")
    parser.add_argument("--verbose", action="store_true", help="name each trial on standard error")
    options = parser.parse_args()
    chosen = options.only.split(",") if options.only else list(ATTACKS)
    if unknown := set(chosen) - ATTACKS.keys():
        parser.error(f"unknown attack {', '.join(unknown)}: choose some of {', '.join(ATTACKS)}")
    small.import_late()
    small.shorten()
    results = []
    with scratch() as folder:
        os.environ |= {"TMPDIR": f"{folder}", "XDG_STATE_HOME": f"{folder}/state"}
        os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])  # of new processes
        tempfile.tempdir = str(folder)
        material = Material(folder)

        def prepared(name: str) -> list[tuple[str, Trial]]:
            attack = ATTACKS[name]
            count = options.count or (attack.short if options.short else attack.count)
            trials = attack.trials(material, Random(f"{options.seed} {name}"), count)
            matching = [trial for trial in trials if re.search(options.match, trial.name)]
            for trial in matching:
                trial.prepare()
            return [(name, trial) for trial in matching]

        # Not in threads: a forked process inherits the locks that others hold at that time, of which Python
        # 3.11 has one for each cached property, and waits for ever.
        for name in chosen:
            UNDER_WAY.extend(prepared(name))
        # Not the processes of a `Pool`: those of a daemon have no children that are waited for.
        with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("fork")) as pool:
            for future in as_completed([pool.submit(attempt, i) for i in range(len(UNDER_WAY))]):
                results.append(result := future.result())
                if options.verbose or result[2]:
                    how = result[2] or f"survived in {result[3]:.1f} s, busy for {result[4]:.1f} s"
                    print(f"{result[0]}: {result[1]}: {how}", file=sys.stderr)
    results.sort(key=lambda result: chosen.index(result[0]))
    Console(width=None if sys.stdout.isatty() else 120).print(table(results))
    for name, trial, broke, *_ in results:
        if broke:
            print(f"{name}: {trial}: {broke}")
    return int(any(result[2] for result in results))


if __name__ == "__main__":
    sys.exit(main())
