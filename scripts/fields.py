"""Fields put to the test: prints what becomes of the runs of the controllers of a run of `field`.

    hyrl-mj run field --seed 0 --out runs/field-0
    python scripts/fields.py published runs/field-0 fields.json
    python scripts/fields.py random runs/field-0 --fields 99 --starts 4
    python scripts/fields.py random runs/field-0 --fields 200 --starts 3 --posts 9 --moving
    python scripts/fields.py many runs/field-0

`published` takes layouts in the format of the published work (HybridSystemsLab/MultiHyRL), and `many` times
1,000 fields of 12 posts.

`random` draws fields, and asks what does the work: a controller has the memory of focus and side or not, the
guard or not, and in its modes what was trained, a law that drives along the way, or random inputs. Half of
its starts are on M*. Time and way are those of runs that arrive; late is what takes more than twice the time
of the same controller without noise.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj.fields import Bounds, Driving, FocusController, controllers, decoded
from hyrl_mj.fields.controller import TangentLaw, WithoutMemory
from hyrl_mj.fields.guard import Guard
from hyrl_mj.judging import Budget, attack
from hyrl_mj.judging.game import LATE
from hyrl_mj.policies import Controller, PolicyController
from hyrl_mj.simulation import AnyNoise, LoopSettings, Noise, Recorded, closed_loop
from hyrl_mj.tasks import LEFT, RIGHT, Layouts, Outcome

# Random fields: half the side of the square of the posts [m], radii [m], least gap [m], speed [m/s], the
# time between two positions of a moving post [s], and the room around a start [m].
HALF, RADII, GAP, SPEED, INTERVAL, ROOM = 5.0, (0.3, 0.9), 0.8, 0.4, 2.0, 0.3
TIME, LONG = 15.0, 30.0
BATCH = 2_000


# ---- what becomes of runs


@dataclass
class Row:
    """What became of the runs of one controller.

    Attributes:
        outcomes: a label for each run.
        times, ways, quiet: how long [s] and how far [m] they go, and how long without noise [s].
        changes, passed: numbers of changes of (q, lambda), and of posts passed; none without a memory.
        lost: whether the attack makes a start be lost that is won without noise.
        guard: the samples that the guard has seen, and those that it has changed.
    """

    outcomes: list[str] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    ways: list[float] = field(default_factory=list)
    quiet: list[float] = field(default_factory=list)
    changes: list[int] = field(default_factory=list)
    passed: list[int] = field(default_factory=list)
    lost: list[bool] = field(default_factory=list)
    guard: Counter[str] = field(default_factory=Counter)

    def cells(self) -> list[str]:
        arrived = np.array(self.outcomes) == "reached"
        times, ways, quiet, changes = map(
            np.array, (self.times, self.ways, self.quiet, self.changes)
        )
        spread = [
            np.percentile(x[arrived], (50, 99)) if arrived.any() else (np.nan, np.nan)
            for x in (times, ways)
        ]
        beyond = changes - np.array(self.passed) - 1
        counts = len(arrived), *map(self.outcomes.count, ("reached", "crashed"))
        return [
            *(f"{n:,}" for n in counts), f"{(arrived & (times > LATE * quiet)).sum()}",
            *("{:.1f}, {:.1f}".format(*pair) for pair in spread),
            f"{self.guard['changed'] / self.guard['seen']:.0%}" if self.guard else "",
            f"{np.median(changes):.0f}, {np.percentile(changes, 99):.0f}" if len(changes) else "",
            f"{np.median(beyond):.0f}, {(beyond > 0).mean():.0%}" if len(changes) else "",
            f"{sum(self.lost):,} of {len(self.lost):,}" if self.lost else "",
        ]  # fmt: skip


HEADINGS = (
    "runs", "arrives", "crashes", "late", "time, s: median, 99%", "way, m: median, 99%",
    "changed by the guard", "changes: median, 99%", "beyond posts passed + 1: median, share",
    "attack: lost",
)  # fmt: skip


def drive(
    task: Driving, loop: Controller, z0: np.ndarray, noise: AnyNoise, row: Row, seed: int = 0
) -> None:
    """Runs a controller from starts, without noise and with it, and counts."""
    settings = LoopSettings(record=True, quiet=True)
    parts = np.split(z0, range(BATCH, len(z0), BATCH))
    for part in parts:
        run = closed_loop(task, loop, part, None, seed=seed, settings=settings)
        row.quiet += (run.length * task.dt).tolist()
    if isinstance(loop, Parts):
        loop.guard.count.clear()
    for part in parts:
        run = closed_loop(task, loop, part, noise, seed=seed, settings=settings)
        row.outcomes += [Outcome(value).label for value in run.outcome]
        row.times += (run.length * task.dt).tolist()
        moves = np.linalg.norm(np.diff(run.path[..., :2], axis=0), axis=2)
        during = np.arange(len(moves))[:, None] < run.length
        row.ways += (moves * during).sum(axis=0).tolist()
        if len(loop.modes) > 1:
            count_changes(task, part, run, row)
    if isinstance(loop, Parts):
        row.guard += loop.guard.count


def drive_attacked(
    task: Driving, loops: Mapping[str, Controller], z0: np.ndarray, given: argparse.Namespace, rows
) -> None:
    """Searches for noise that makes controllers lose, and counts in their rows by name."""
    budget = Budget(rounds=given.rounds)
    for name, found in attack(task, loops, z0, 0.1, budget, seed=given.seed).items():
        rows[name].lost += (found.ends.lost & ~found.quiet.lost).tolist()


def count_changes(task: Driving, z0: np.ndarray, run, row: Row) -> None:
    """Counts changes of focus and side, and the posts that were in focus when they were passed."""
    q, length = np.array(run.q), run.length
    focus, side, _ = decoded(q)
    pair = 2 * focus + side
    later = np.arange(1, len(q))[:, None] < length
    row.changes += ((np.diff(pair, axis=0) != 0) & later).sum(axis=0).tolist()
    number = z0[:, 3].astype(int) if z0.shape[1] > 3 else np.zeros(len(z0), dtype=int)
    # A post is passed where the robot came closer than 1 m to its surface.
    last = len(run.path)
    places = run.path[..., :2]
    centres = np.stack(
        [task.layouts.positions(number, np.full(len(z0), k * task.dt)) for k in range(last)]
    )
    room = np.linalg.norm(centres - places[:, :, None], axis=3) - task.layouts.radii[number]
    during = np.arange(last)[:, None, None] <= length[:, None]
    near = np.where(during, room, np.inf).min(axis=0) < 1.0
    row.passed += near.sum(axis=1).tolist()


# ---- fields and starts


def published(path: Path) -> Iterator[tuple[str, Layouts, np.ndarray]]:
    """Yields name, layout and starts (n, 3) of each layout of a file in the published format."""
    content = json.loads(path.read_text())
    goal = np.array([content["goal"]], dtype=float)
    for name, layout in {**content["static"], **content["moving"]}.items():
        tracks, radii = [], []
        t = np.arange(0.0, TIME + 1.0, 0.25)
        for post in layout["obstacles"]:
            if isinstance(post, dict):
                x, y = post["centre"]
                angle = 2 * np.pi * t / post["period_s"] + np.pi * post["phase_over_pi"]
                tracks.append(np.stack([np.full_like(t, x), y + post["R"] * np.sin(angle)], axis=1))
                radii.append(post["radius_m"])
            else:
                tracks.append(np.tile(post[:2], (len(t), 1)))
                radii.append(post[2])
        starts = layout["starts"]
        if "angles_over_pi" in starts:
            angles = np.pi * np.array(starts["angles_over_pi"])
        else:
            span = starts["angle_over_pi"]
            angles = np.pi * np.linspace(
                span["from"], span["to"], starts["count"], endpoint=span["endpoint"]
            )
        away = starts["radius_m"] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        heading = np.arctan2(-away[:, 1], -away[:, 0])
        layouts = Layouts(np.stack(tracks, axis=1)[None], np.array([radii]), goal, 0.25)
        yield name, layouts, np.column_stack([goal + away, heading])


def published_noise(task: Driving, n: int, place: float, heading: float) -> Recorded:
    """Returns the alternating noise of the published work: (e, -e) on the position, e_h on the heading."""
    values = np.zeros(task.measurement_columns)
    values[:3] = place, -place, heading
    signs = np.where(np.arange(task.max_steps) % 2 == 0, 1.0, -1.0)
    signal = np.broadcast_to((signs[:, None] * values)[:, None], (len(signs), n, len(values)))
    return Recorded(signal, max(place, heading), "alternating")


def drawn(rng: np.random.Generator, posts: int, fields: int, moving: bool) -> Layouts:
    """Returns random fields: posts in a square around the origin, and a goal that they leave free."""
    segments = int(LONG / INTERVAL) + 1 if moving else 0
    tracks = np.empty((fields, segments + 1, posts, 2))
    radii, goals = np.empty((fields, posts)), np.empty((fields, 2))
    for i in range(fields):
        count = 0
        while count < posts:
            place, radius = rng.uniform(-HALF, HALF, 2), rng.uniform(*RADII)
            away = np.linalg.norm(place - tracks[i, 0, :count], axis=1) - radii[i, :count]
            if (away >= radius + GAP).all():
                tracks[i, :, count], radii[i, count] = place, radius
                count += 1
        while True:
            goals[i] = rng.uniform(-HALF - 1, HALF + 1, 2)
            if (np.linalg.norm(tracks[i, 0] - goals[i], axis=1) - radii[i]).min() >= 0.5:
                break
        for k in range(segments):
            going = np.arange(posts) % 2 == 0
            course, speed = rng.uniform(-np.pi, np.pi, posts), rng.uniform(0, SPEED, posts)
            course = np.stack([np.cos(course), np.sin(course)], axis=1)
            tracks[i, k + 1] = tracks[i, k] + INTERVAL * (speed * going)[:, None] * course
    return Layouts(tracks, radii, goals, INTERVAL)


def starts(
    layouts: Layouts, each: int, rng: np.random.Generator, points: np.ndarray | None = None
) -> np.ndarray:
    """Returns starts (n, 4), so many in each field, with room around them, away from the goal.

    They lie anywhere, or on the `points` (k, 3) of M*, as these lie around a post of the field.
    """
    z = []
    for i in range(len(layouts)):
        while len(z) < (i + 1) * each:
            if points is None:
                place = rng.uniform(-HALF - 1, HALF + 1, 2)
            else:
                post = layouts.tracks[i, 0, rng.integers(layouts.posts)]
                along, across, heading = points[rng.integers(len(points))]
                axis = layouts.goals[i] - post
                angle = np.arctan2(axis[1], axis[0])
                cos, sin = np.cos(angle), np.sin(angle)
                place = post + np.array([along * cos - across * sin, along * sin + across * cos])
            away = np.linalg.norm(layouts.tracks[i, 0] - place, axis=1) - layouts.radii[i]
            if away.min() < ROOM or np.linalg.norm(place - layouts.goals[i]) < 1.0:
                continue
            if points is None:
                turned = rng.uniform(-np.pi, np.pi)
            else:
                turned = np.angle(np.exp(1j * (heading + angle)))
            z.append([*place, turned, i])
    return np.array(z)


# ---- the controllers of the rows


class Random:
    """Gives inputs at random, but the same for the same observation, as controllers have to."""

    def __init__(self, seed: int):
        self._weights = np.random.default_rng(seed).uniform(-1e4, 1e4, (17, 2))

    def inputs(self, observed: np.ndarray) -> np.ndarray:
        """Returns inputs (n, 2) for observations (n, 17)."""
        # A sum of products that does not depend on how many observations there are.
        return np.sin((observed[:, :, None] * self._weights).sum(axis=1))


@dataclass(frozen=True)
class Counting(Guard):
    """A guard that counts the samples that it sees and changes; it changes nothing if it is not `acting`."""

    acting: bool = True
    count: Counter[str] = field(default_factory=Counter)

    def inputs(self, seen, u, turn, sense):
        guarded = super().inputs(seen, u, turn, sense)
        changed = int((np.abs(guarded - u) > 1e-6).any(axis=1).sum())
        self.count.update(seen=len(u), changed=changed)
        return guarded if self.acting else u


@dataclass(frozen=True)
class Parts(FocusController):
    """The controller of fields with its memory, its guard, or without one of them."""

    remembers: bool = True
    guarded: bool = True

    @cached_property
    def guard(self) -> Counting:
        return Counting(**vars(super().guard), acting=self.guarded)

    def answer(
        self, q: np.ndarray, measured: np.ndarray, looks: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        return super().answer(q if self.remembers else np.full_like(q, -1), measured, looks)


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


# ---- the commands


def loops_of(run: hyrl_mj.Run, task: Driving) -> dict[str, Controller]:
    return controllers(task, run.policy, run.mode_policies, run.settings.eps)


def try_published(run: hyrl_mj.Run, given: argparse.Namespace) -> Table:
    table = Table("field", "noise", "controller", *HEADINGS)
    for name, layouts, z0 in published(given.file):
        for pair in json.loads(given.file.read_text())["noise"]:
            task = Driving(run.task, layouts, Bounds(), 0.1 + pair[0], TIME, z0)
            noise = published_noise(task, len(z0), *pair)
            for who, loop in loops_of(run, task).items():
                row = Row()
                for begun in (loop, *(loop.on_side(q) for q in (0, 1) if who != "policy")):
                    drive(task, begun, z0, noise, row)
                    if given.rounds:
                        wide = Driving(run.task, layouts, Bounds(), 0.2, TIME, z0)
                        drive_attacked(wide, {who: begun}, z0, given, {who: row})
                table.add_row(name, "{:g}, {:g}".format(*pair), who, *row.cells())
    return table


def try_random(run: hyrl_mj.Run, given: argparse.Namespace) -> Table:
    rows: dict[str, Row] = defaultdict(Row)
    bounds = Bounds(speeds=0.5 * given.moving)
    for posts in given.posts:
        rng = np.random.default_rng([given.seed, posts])
        layouts = drawn(rng, posts, max(given.fields // len(given.posts), 2), given.moving)
        task = Driving(run.task, layouts, bounds, 0.2, LONG)
        near = given.starts // 2
        z0 = starts(layouts, given.starts - near, rng)
        if near:
            z0 = np.vstack([starts(layouts, near, rng, run.critical_set.points), z0])
        loops = rows_of(run, task, given.seed)
        for name, loop in loops.items():
            drive(task, loop, z0, Noise(given.noise, 0.1), rows[name], given.seed)
        if given.rounds:
            tried = {name: loop for name, loop in loops.items() if not name.startswith("random")}
            drive_attacked(task, tried, z0[:: given.starts], given, rows)
    table = Table("controller", *HEADINGS)
    for name, row in rows.items():
        table.add_row(name, *row.cells())
    return table


def try_many(run: hyrl_mj.Run, given: argparse.Namespace) -> str:
    rng = np.random.default_rng(0)
    layouts = drawn(rng, 12, 1_000, False)
    z0 = starts(layouts, 1, rng)
    task = Driving(run.task, layouts, Bounds(), 0.2, LONG)
    began = time.monotonic()
    loop, settings = loops_of(run, task)["hyrl"], LoopSettings(quiet=True)
    closed_loop(task, loop, z0, Noise("alternating", 0.1), settings=settings)
    return f"1,000 fields of 12 posts: {time.monotonic() - began:.1f} s"


TRIALS = {"published": try_published, "random": try_random, "many": try_many}


def main() -> None:
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("what", choices=TRIALS)
    parser.add_argument("run", type=Path)
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--fields", type=int, default=100)
    parser.add_argument("--starts", type=int, default=10, help="of each field")
    parser.add_argument("--moving", action="store_true", help="half of the posts move")
    about = "rounds of the attack; of a random field one start in STARTS is attacked"
    parser.add_argument("--rounds", type=int, default=0, help=about)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--posts", type=int, nargs="+", default=(4, 8, 12), help="of random fields")
    parser.add_argument("--noise", default="alternating", help="of random fields")
    given = parser.parse_args()
    Console(width=170).print(TRIALS[given.what](hyrl_mj.load_run(given.run), given))


if __name__ == "__main__":
    main()
