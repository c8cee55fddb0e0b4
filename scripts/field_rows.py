"""What does the work in fields: memory, guard or learning? Prints a row for each controller.

    hyrl-mj run field --seed 0 --out runs/field-0
    python scripts/field_rows.py runs/field-0 --fields 100
    python scripts/field_rows.py runs/field-0 --fields 200 --posts 9 --moving

A controller has the memory of focus and side or not, the guard or not, and in its modes what was trained, a
law that drives along the way, or random inputs. The time and the length of the way are those of runs that
arrive; late is what takes more than twice the time of the same controller without noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from fields import LONG, Tally, count_changes, drawn, starts_anywhere, starts_on_critical
from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj.fields import Bounds, Driving, FocusController
from hyrl_mj.fields.controller import TangentLaw, WithoutMemory
from hyrl_mj.fields.guard import Guard
from hyrl_mj.judging import Budget, attack
from hyrl_mj.judging.game import LATE
from hyrl_mj.policies import Controller, PolicyController
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop
from hyrl_mj.tasks import LEFT, RIGHT, Outcome


class Random:
    """Gives inputs at random, but the same for the same observation, as controllers have to."""

    def __init__(self, seed: int):
        self._weights = np.random.default_rng(seed).uniform(-1e4, 1e4, (17, 2))

    def inputs(self, observed: np.ndarray) -> np.ndarray:
        """Returns inputs (n, 2) for observations (n, 17)."""
        # A sum of products that does not depend on how many observations there are.
        return np.sin((observed[:, :, None] * self._weights).sum(axis=1))


class Count:
    """How many samples a guard has seen, and how many of them it has changed."""

    seen = changed = 0


@dataclass(frozen=True)
class Counting(Guard):
    """A guard that counts, and changes nothing if it is not `acting`."""

    acting: bool = True
    count: Count = field(default_factory=Count)

    def inputs(self, seen, u, turn, sense):
        guarded = super().inputs(seen, u, turn, sense)
        self.count.seen += len(u)
        self.count.changed += int((np.abs(guarded - u) > 1e-6).any(axis=1).sum())
        return guarded if self.acting else u


@dataclass(frozen=True)
class Parts(FocusController):
    """The controller of fields with its memory, its guard, or without one of them."""

    remembers: bool = True
    guarded: bool = True
    count: Count = field(default_factory=Count)

    @cached_property
    def guard(self) -> Guard:
        whole = super().guard
        return Counting(**vars(whole), acting=self.guarded, count=self.count)

    def answer(self, q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return super().answer(q if self.remembers else np.full_like(q, -1), measured)


def rows_of(run: hyrl_mj.Run, task: Driving, seed: int) -> dict[str, Controller]:
    """Returns the controllers by what they are made of."""
    eps, trained = run.settings.eps, run.mode_policies
    law: Mapping = {side: TangentLaw(task.local, side) for side in (LEFT, RIGHT)}
    drawing: Mapping = dict.fromkeys((LEFT, RIGHT), Random(seed))

    def parts(policies: Mapping, memory: bool, guarded: bool) -> Parts:
        return Parts(task, policies, eps, remembers=memory, guarded=guarded)

    return {
        "policy of stage 1 alone": PolicyController(WithoutMemory(task, run.policy)),
        "learned, neither": parts(trained, False, False),
        "learned, memory": parts(trained, True, False),
        "learned, guard": parts(trained, False, True),
        "learned, both (HyRL)": parts(trained, True, True),
        "law, both": parts(law, True, True),
        "random, guard": parts(drawing, False, True),
    }


@dataclass
class Row:
    """What became of the runs of one controller: outcomes, times [s], ways [m], times without noise."""

    outcome: list[np.ndarray] = field(default_factory=list)
    time: list[np.ndarray] = field(default_factory=list)
    way: list[np.ndarray] = field(default_factory=list)
    quiet: list[np.ndarray] = field(default_factory=list)
    lost: list[np.ndarray] = field(default_factory=list)
    tally: Tally = field(default_factory=Tally)
    seen: int = 0
    changed: int = 0


def played(task: Driving, loop: Controller, z0: np.ndarray, kind: str, seed: int):
    """Returns outcomes (n,), times (n,), ways (n,) and the run from starts under a kind of noise."""
    settings = LoopSettings(record=True, quiet=True)
    run = closed_loop(task, loop, z0, Noise(kind, 0.1), seed=seed, settings=settings)
    moves = np.linalg.norm(np.diff(run.path[..., :2], axis=0), axis=2)
    during = np.arange(len(moves))[:, None] < run.length
    return run.outcome, run.length * task.dt, (moves * during).sum(axis=0), run


def add(row: Row, task: Driving, loop: Controller, z0: np.ndarray, kind: str, given) -> None:
    """Plays a controller from starts, and adds what became of it."""
    _, quiet, _, _ = played(task, loop, z0, "none", given.seed)
    if isinstance(loop, Parts):
        loop.count.seen = loop.count.changed = 0
    outcome, time, way, run = played(task, loop, z0, kind, given.seed)
    row.outcome.append(outcome)
    row.time.append(time)
    row.way.append(way)
    row.quiet.append(quiet)
    if isinstance(loop, Parts):
        row.seen, row.changed = row.seen + loop.count.seen, row.changed + loop.count.changed
        count_changes(task, z0, run, row.tally)


def told(name: str, row: Row) -> list[str]:
    """Returns the cells of a controller."""
    outcome, time, way, quiet = map(np.concatenate, (row.outcome, row.time, row.way, row.quiet))
    arrived = outcome == Outcome.REACHED
    late = int((arrived & (time > LATE * quiet)).sum())
    spread = [
        np.percentile(x[arrived], (50, 99)) if arrived.any() else (np.nan, np.nan)
        for x in (time, way)
    ]
    changes, passed = np.array(row.tally.changes), np.array(row.tally.passed)
    return [
        name, f"{len(outcome):,}", f"{arrived.sum():,}", f"{(outcome == Outcome.CRASHED).sum():,}", str(late),
        *("{:.1f}, {:.1f}".format(*pair) for pair in spread),
        f"{row.changed / row.seen:.0%}" if row.seen else "",
        f"{np.median(changes):.0f}, {np.percentile(changes, 99):.0f}" if len(changes) else "",
        f"{np.median(changes - passed - 1):.0f}, {(changes > passed + 1).mean():.0%}" if len(changes) else "",
        f"{np.concatenate(row.lost).sum():,} of {sum(map(len, row.lost)):,}" if row.lost else "",
    ]  # fmt: skip


def main() -> None:
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("run", type=Path)
    parser.add_argument("--fields", type=int, default=100)
    parser.add_argument("--posts", type=int, nargs="+", default=(4, 8, 12), help="of a field")
    parser.add_argument("--starts", type=int, default=4, help="of each field, half of them on M*")
    parser.add_argument(
        "--moving", action="store_true", help="half of the posts move, at up to 0.4 m/s"
    )
    parser.add_argument("--noise", default="alternating")
    parser.add_argument(
        "--rounds", type=int, default=0, help="of an attack from one start of a field"
    )
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    run = hyrl_mj.load_run(given.run)
    rows: dict[str, Row] = {}
    bounds = Bounds(speeds=0.5) if given.moving else Bounds()
    for posts in given.posts:
        rng = np.random.default_rng([given.seed, posts])
        layouts = drawn(rng, posts, max(given.fields // len(given.posts), 2), given.moving)
        task = Driving(run.task, layouts, bounds, 0.2, LONG)
        near = given.starts // 2
        z0 = starts_anywhere(layouts, given.starts - near, rng)
        if near:
            z0 = np.vstack([starts_on_critical(layouts, run.critical_set.points, near, rng), z0])
        loops = rows_of(run, task, given.seed)
        for name, loop in loops.items():
            row = rows.setdefault(name, Row())
            add(row, task, loop, z0, given.noise, given)
        if given.rounds:
            tried = {name: loop for name, loop in loops.items() if not name.startswith("random")}
            found = attack(
                task, tried, z0[:: given.starts], 0.1, Budget(rounds=given.rounds), seed=given.seed
            )
            for name, result in found.items():
                rows[name].lost.append(result.ends.lost & ~result.quiet.lost)
    table = Table(
        "controller", "runs", "arrives", "crashes", "late", "time, s: median, 99%", "way, m: median, 99%",
        "changed by the guard", "changes: median, 99%", "beyond posts passed + 1: median, share",
        "attack: lost",
    )  # fmt: skip
    for name, row in rows.items():
        table.add_row(*told(name, row))
    Console(width=170).print(table)


if __name__ == "__main__":
    main()
