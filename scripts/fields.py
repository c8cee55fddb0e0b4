"""Fields put to the test: prints how often the controllers of a run of `field` arrive and crash.

    hyrl-mj run field --seed 0 --out runs/field-0
    python scripts/fields.py published runs/field-0 fields.json
    python scripts/fields.py random runs/field-0 --fields 1000
    python scripts/fields.py random runs/field-0 --fields 300 --moving
    python scripts/fields.py many runs/field-0

`published` takes layouts in the format of the published work (HybridSystemsLab/MultiHyRL), `random` draws
fields of 3 to 12 posts, and `many` times 1,000 fields of 12 posts.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj.fields import Bounds, Driving, controllers, decoded
from hyrl_mj.judging import Budget, attack
from hyrl_mj.policies import Controller
from hyrl_mj.simulation import AnyNoise, LoopSettings, Noise, Recorded, closed_loop
from hyrl_mj.tasks import Layouts, Outcome

# Random fields: half the side of the square of the posts [m], radii [m], least gap [m], speed [m/s], and the
# time between two positions of a moving post [s].
HALF, RADII, GAP, SPEED, INTERVAL = 5.0, (0.3, 0.9), 0.8, 0.4, 2.0
TIME, LONG = 15.0, 30.0
BATCH = 2_000


@dataclass
class Tally:
    """What happened in some runs.

    Attributes:
        outcomes: of the runs, by their labels.
        changes: number of changes of (q, lambda) of each run, and number of posts passed.
    """

    outcomes: dict[str, int] = field(default_factory=dict)
    changes: list[int] = field(default_factory=list)
    passed: list[int] = field(default_factory=list)

    def add(self, outcome: np.ndarray) -> None:
        for value in outcome:
            label = Outcome(value).label
            self.outcomes[label] = self.outcomes.get(label, 0) + 1

    def row(self) -> list[str]:
        runs = sum(self.outcomes.values())
        cells = [f"{runs:,}", *(f"{self.outcomes.get(k, 0):,}" for k in ("crashed", "stalled"))]
        if not self.changes:
            return [*cells, "", ""]
        few = np.array(self.changes) <= np.array(self.passed) + 1
        twice = np.array(self.changes) <= 2 * (np.array(self.passed) + 1)
        return [*cells, f"{np.median(self.changes):.0f} ({few.mean():.1%})", f"{twice.mean():.2%}"]


def drive(
    task: Driving, loop: Controller, z0: np.ndarray, noise: AnyNoise | None, tally: Tally
) -> np.ndarray:
    """Runs a controller from starts and counts; returns the outcomes (n,)."""
    ends = []
    for first in range(0, len(z0), BATCH):
        part = z0[first : first + BATCH]
        settings = LoopSettings(record=True, quiet=True)
        run = closed_loop(task, loop, part, noise, settings=settings)
        tally.add(run.outcome)
        ends.append(run.outcome)
        if len(loop.modes) > 1:
            count_changes(task, part, run, tally)
    return np.concatenate(ends)


def drive_attacked(
    task: Driving, who: str, loop: Controller, z0: np.ndarray, rounds: int, tally: Tally
) -> None:
    """Runs a controller from starts under the worst noise that so many rounds find, and counts."""
    found = attack(task, {who: loop}, z0, 0.1, Budget(rounds=rounds))[who]
    for arc in found.arcs:
        tally.outcomes[arc.outcome] = tally.outcomes.get(arc.outcome, 0) + 1


def count_changes(task: Driving, z0: np.ndarray, run, tally: Tally) -> None:
    """Counts changes of focus and side, and the posts that were in focus when they were passed."""
    q, length = np.array(run.q), run.length
    focus, side, _ = decoded(q)
    pair = 2 * focus + side
    later = np.arange(1, len(q))[:, None] < length
    tally.changes += ((np.diff(pair, axis=0) != 0) & later).sum(axis=0).tolist()
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
    tally.passed += near.sum(axis=1).tolist()


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
        yield (
            name,
            Layouts(np.stack(tracks, axis=1)[None], np.array([radii]), goal, 0.25),
            np.column_stack([goal + away, heading]),
        )


def published_noise(task: Driving, n: int, place: float, heading: float) -> Recorded:
    """Returns the alternating noise of the published work: (e, -e) on the position, e_h on the heading."""
    values = np.zeros(task.measurement_columns)
    values[:3] = place, -place, heading
    signs = np.where(np.arange(task.max_steps) % 2 == 0, 1.0, -1.0)
    signal = np.broadcast_to(
        (signs[:, None] * values)[:, None], (task.max_steps, n, task.measurement_columns)
    )
    return Recorded(signal, max(place, heading), "alternating")


def drawn(rng: np.random.Generator, posts: int, fields: int, moving: bool) -> Layouts:
    """Returns random fields: posts in a square around the origin, and a goal that they leave free."""
    segments = int(LONG / INTERVAL) + 1 if moving else 0
    tracks = np.empty((fields, segments + 1, posts, 2))
    radii, goals = np.empty((fields, posts)), np.empty((fields, 2))
    for i in range(fields):
        places: list[np.ndarray] = []
        sizes: list[float] = []
        while len(places) < posts:
            place, radius = rng.uniform(-HALF, HALF, 2), rng.uniform(*RADII)
            if all(
                np.linalg.norm(place - p) >= radius + r + GAP
                for p, r in zip(places, sizes, strict=True)
            ):
                places.append(place)
                sizes.append(radius)
        radii[i], tracks[i] = sizes, np.array(places)
        while True:
            goals[i] = rng.uniform(-HALF - 1, HALF + 1, 2)
            room = np.linalg.norm(tracks[i, 0] - goals[i], axis=1) - radii[i]
            if room.min() >= 0.5:
                break
        for k in range(segments):
            going = np.arange(posts) % 2 == 0
            course, speed = rng.uniform(-np.pi, np.pi, posts), rng.uniform(0, SPEED, posts)
            step = (
                INTERVAL
                * (speed * going)[:, None]
                * np.stack([np.cos(course), np.sin(course)], axis=1)
            )
            tracks[i, k + 1] = tracks[i, k] + step
    return Layouts(tracks, radii, goals, INTERVAL)


def starts_anywhere(
    layouts: Layouts, each: int, rng: np.random.Generator, room: float = 0.3
) -> np.ndarray:
    """Returns starts (n, 4): so many anywhere in each field, with room around them, away from the goal."""
    z = []
    for i in range(len(layouts)):
        while len(z) < (i + 1) * each:
            place = rng.uniform(-HALF - 1, HALF + 1, 2)
            if free(layouts, i, place, room):
                z.append([*place, rng.uniform(-np.pi, np.pi), i])
    return np.array(z)


def starts_on_critical(
    layouts: Layouts, points: np.ndarray, each: int, rng: np.random.Generator, room: float = 0.3
) -> np.ndarray:
    """Returns starts (n, 4) on M*, as it lies around a post of each field."""
    z = []
    for i in range(len(layouts)):
        while len(z) < (i + 1) * each:
            post = layouts.tracks[i, 0, rng.integers(layouts.posts)]
            along, across, heading = points[rng.integers(len(points))]
            axis = layouts.goals[i] - post
            angle = np.arctan2(axis[1], axis[0])
            cos, sin = np.cos(angle), np.sin(angle)
            place = post + np.array([along * cos - across * sin, along * sin + across * cos])
            if free(layouts, i, place, room):
                z.append([*place, np.angle(np.exp(1j * (heading + angle))), i])
    return np.array(z)


def free(layouts: Layouts, i: int, place: np.ndarray, room: float) -> bool:
    """Returns whether a place in a field has room around it, and is not the goal."""
    away = np.linalg.norm(layouts.tracks[i, 0] - place, axis=1) - layouts.radii[i]
    return bool(away.min() >= room and np.linalg.norm(place - layouts.goals[i]) >= 1.0)


def loops_of(run: hyrl_mj.Run, task: Driving) -> dict[str, Controller]:
    return controllers(task, run.policy, run.mode_policies, run.settings.eps)


def try_published(run: hyrl_mj.Run, path: Path, rounds: int, table: Table) -> None:
    pairs = json.loads(path.read_text())["noise"]
    for name, layouts, starts in published(path):
        for place, heading in pairs:
            task = Driving(run.task, layouts, Bounds(), 0.1 + place, TIME, starts)
            for who, loop in loops_of(run, task).items():
                tally = Tally()
                for side in (None, 0, 1) if who != "policy" else (None,):
                    begun = loop if side is None else loop.on_side(side)
                    drive(
                        task,
                        begun,
                        starts,
                        published_noise(task, len(starts), place, heading),
                        tally,
                    )
                table.add_row(name, f"{place:g}, {heading:g}", who, *tally.row())
        if rounds:
            task = Driving(run.task, layouts, Bounds(), 0.2, TIME, starts)
            for who, loop in loops_of(run, task).items():
                tally = Tally()
                for side in (None, 0, 1) if who != "policy" else (None,):
                    begun = loop if side is None else loop.on_side(side)
                    drive_attacked(task, who, begun, starts, rounds, tally)
                table.add_row(name, "attack 0.1, 0.05", who, *tally.row())


def try_random(
    run: hyrl_mj.Run, count: int, each: int, moving: bool, rounds: int, seed: int, table: Table
) -> None:
    tallies: dict[tuple[str, str, str], Tally] = {}
    bounds = Bounds(speeds=0.5) if moving else Bounds()
    for posts in range(3, 13):
        rng = np.random.default_rng([seed, posts])
        layouts = drawn(rng, posts, max(count // 10, 2), moving)
        task = Driving(run.task, layouts, bounds, 0.2, LONG)
        points = run.critical_set.points
        from_where = {
            "M*": starts_on_critical(layouts, points, each, rng),
            "anywhere": starts_anywhere(layouts, each, rng),
        }
        for who, loop in loops_of(run, task).items():
            for where, z0 in from_where.items():
                for kind in ("none", "alternating", "uniform"):
                    tally = tallies.setdefault((where, kind, who), Tally())
                    drive(task, loop, z0, Noise(kind, 0.1), tally)
                if rounds:
                    tally = tallies.setdefault((where, "attack", who), Tally())
                    drive_attacked(task, who, loop, z0[::each], rounds, tally)
    for key in sorted(tallies):
        table.add_row(*key, *tallies[key].row())


def try_many(run: hyrl_mj.Run) -> None:
    rng = np.random.default_rng(0)
    layouts = drawn(rng, 12, 1_000, False)
    z0 = starts_anywhere(layouts, 1, rng)
    task = Driving(run.task, layouts, Bounds(), 0.2, LONG)
    began = time.monotonic()
    loop, settings = loops_of(run, task)["hyrl"], LoopSettings(quiet=True)
    closed_loop(task, loop, z0, Noise("alternating", 0.1), settings=settings)
    print(f"1,000 fields of 12 posts: {time.monotonic() - began:.1f} s")


def main() -> None:
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("what", choices=("published", "random", "many"))
    parser.add_argument("run", type=Path)
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--fields", type=int, default=100)
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--moving", action="store_true")
    parser.add_argument(
        "--rounds",
        type=int,
        default=0,
        help="rounds of the attack; of a random field one start in STARTS is attacked",
    )
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    run = hyrl_mj.load_run(given.run)
    table = Table(
        "field", "noise", "controller", "runs", "crashed", "late", "changes (few)", "twice"
    )
    if given.what == "published":
        try_published(run, given.file, given.rounds, table)
    elif given.what == "random":
        try_random(run, given.fields, given.starts, given.moving, given.rounds, given.seed, table)
    else:
        try_many(run)
        return
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
