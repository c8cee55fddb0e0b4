"""Drives: controllers go through a field from its starts, under the same noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hyrl_mj.errors import BadInput, check_bound, check_seed
from hyrl_mj.fields.controller import controllers
from hyrl_mj.fields.driving import Bounds, Driving
from hyrl_mj.fields.files import FieldFile
from hyrl_mj.fields.focus import decoded
from hyrl_mj.judging import Budget, attack
from hyrl_mj.policies import MlpPolicy, ObservationPolicy
from hyrl_mj.simulation import AttackSettings, HybridArc, Noise, simulate_batch
from hyrl_mj.tasks import POSE, Field, length

# The rounds of the attack.
ROUNDS = 4


@dataclass(frozen=True)
class DriveOptions:
    """The noise on what a robot measures while it drives through a field.

    Attributes:
        noise: kind of noise, as in `hyrl-mj simulate`, but neither attack nor worst.
        eps: bound of the noise on the robot's position [m]; by default the run's.
        eps_heading: bound of the noise on its heading [rad]; by default half the number of --eps.
        eps_posts: bound of the noise on the posts' positions [m].
        eps_speeds: bound of the noise on the posts' velocities [m/s].
        seed: seed of the noise and of the attack.
        attack: also search for the noise that is worst for each controller.
    """

    noise: str = "alternating"
    eps: float | None = None
    eps_heading: float | None = None
    eps_posts: float = 0.0
    eps_speeds: float = 0.0
    seed: int = 0
    attack: bool = False


def bounds_made_for(local: Field, eps: float) -> Bounds:
    """Returns the bounds that policies were made for, on a task with a bound of the noise [m]."""
    # Position and heading of the robot, position and velocity of the post.
    return Bounds(*(eps * float(local.noisy[column]) for column in (0, 2, POSE, POSE + 2)))


def bounds_asked_for(options: DriveOptions, made_for: Bounds) -> Bounds:
    """Returns the bounds that options stand for; `made_for` are those that the policies were made for.

    Raises:
        BadInput: a bound is negative or not finite, or no heading could be told from another.
    """
    place = check_bound(made_for.place if options.eps is None else options.eps)
    heading = place / 2 if options.eps_heading is None else check_bound(options.eps_heading)
    if heading >= np.pi:
        raise BadInput(
            f"noise bound {heading:g} rad hides the heading: give an --eps-heading below {np.pi:.3g}"
        )
    return Bounds(place, heading, check_bound(options.eps_posts), check_bound(options.eps_speeds))


@dataclass(frozen=True)
class Drives:
    """Runs through a field: an arc for each start, by controller, "policy", "hyrl" and "law".

    A run that arrives comes within `task.reached` of the goal, and touches no post on the whole way.

    Attributes:
        task: the field with its robot.
        bounds: of the noise.
        arcs: under the noise of the options.
        attacked: under the worst noise that was found for each controller and start; {} if none was looked
            for.
    """

    task: Driving
    bounds: Bounds
    arcs: Mapping[str, list[HybridArc]]
    attacked: Mapping[str, list[HybridArc]]


def drive(
    local: Field,
    policy: MlpPolicy,
    policies: Mapping[int, ObservationPolicy],
    made_for: float,
    field: FieldFile,
    options: DriveOptions = DriveOptions(),
    attacks: AttackSettings = AttackSettings(),
) -> Drives:
    """Drives through a field from all its starts, with the controllers of `controllers`.

    Args:
        local: the task on which the policies were trained.
        policy: of stage 1.
        policies: of each side.
        made_for: bound of the noise that they were made for [m].
        field: posts, goal and starts.
        options: the noise.
        attacks: what signals an attack tries.

    Raises:
        BadInput: a noise or a seed that cannot be used.
    """
    check_seed(options.seed)
    bounds = bounds_asked_for(options, bounds_made_for(local, made_for))
    if options.attack and not bounds.largest:
        raise BadInput("--attack looks for the worst noise within bounds: give an --eps > 0")
    reached = 0.1 + bounds.place  # [m]
    task = Driving(local, field.layouts, bounds, reached, field.time, field.starts)
    noise = Noise(options.noise, bounds.largest)
    loops = controllers(task, policy, policies, made_for)
    arcs = {
        name: _checked(task, simulate_batch(task, loop, field.starts, noise, seed=options.seed))
        for name, loop in loops.items()
    }
    attacked = {}
    if options.attack:
        found = attack(
            task,
            loops,
            field.starts,
            bounds.largest,
            Budget(rounds=ROUNDS),
            seed=options.seed,
            settings=attacks,
        )
        # Where nothing that was searched for loses a start, the noise of the options may do so.
        for name, one in found.items():
            pairs = zip(_checked(task, one.arcs), arcs[name], strict=True)
            attacked[name] = [
                plain if worst.outcome == "reached" != plain.outcome else worst
                for worst, plain in pairs
            ]
    return Drives(task, bounds, arcs, attacked)


def ending(arc: HybridArc) -> str:
    """Returns how a run ended: "arrived", "waited" near a goal that a post stood on, "crashed", "stalled"."""
    return "arrived" if arc.outcome == "reached" else arc.outcome.replace("_", " ")


def changes(arc: HybridArc) -> int:
    """Returns how often a run changed the post in focus, or the side on which it is passed."""
    focus, side, *_ = decoded(arc.q)
    return int(((np.diff(focus) != 0) | (np.diff(side) != 0)).sum())


def least_clearance(task: Driving, arc: HybridArc) -> float:
    """Returns the least distance of the robot's hull from a post on the way [m]; negative in a post."""
    return float(_clearances(task, arc)[1].min())


def _clearances(task: Driving, arc: HybridArc) -> tuple[np.ndarray, np.ndarray]:
    """Returns times (m,) [s], and the least distances (m,) [m] of the hull from posts since the time before.

    Robot and posts move straight from each of these times to the next: a post that is fast could leap over
    the robot between two samples.
    """
    layouts = task.layouts
    t, rows = np.unique(arc.t, return_index=True)
    turns = layouts.interval * np.arange(layouts.tracks.shape[1])
    times = np.union1d(t, turns[(turns > t[0]) & (turns < t[-1])])
    x, y = (np.interp(times, t, arc.z[rows, i]) for i in range(2))
    posts = layouts.positions(np.zeros(len(times), dtype=int), times)
    away = posts - np.stack([x, y], axis=1)[:, None]
    before = np.concatenate([away[:1], away[:-1]])
    step = away - before
    # Where on the straight line between two relative places the origin is nearest.
    share = -(before * step).sum(axis=2) / np.maximum((step * step).sum(axis=2), 1e-300)
    nearest = before + np.clip(share, 0.0, 1.0)[..., None] * step
    return times, (length(nearest) - layouts.radii[0] - task.body).min(axis=1)


def _checked(task: Driving, arcs: Iterable[HybridArc]) -> list[HybridArc]:
    """Returns arcs that crash where a post is touched between two samples, or that waited in the end."""
    checked = []
    for arc in arcs:
        times, clearances = _clearances(task, arc)
        hits = np.flatnonzero(clearances <= 0)
        if len(hits) and arc.outcome != "crashed":
            # The first row at the next sample, as where a crash was seen.
            end = int(np.searchsorted(arc.t, times[hits[0]])) + 1
            names = ("t", "j", "z", "measured", "q", "u", "state")
            rows = {name: getattr(arc, name)[:end].copy() for name in names}
            rows["measured"][-1] = rows["u"][-1] = np.nan
            arc = replace(arc, outcome="crashed", **rows)
        if arc.outcome == "stalled":
            last = task.measured_at(arc.z[-1:, :3], arc.t[-1:], np.zeros(1, dtype=int))
            arc = replace(arc, outcome="waited") if task.waits(last)[0] else arc
        checked.append(arc)
    return checked


def noise_cautions(local: Field, made_for: float, options: DriveOptions) -> list[str]:
    """Returns a sentence about each bound that is greater than that which the policies were made for.

    `local` and `made_for` are as in `drive`.
    """
    if options.noise == "none" and not options.attack:
        return []
    usual = bounds_made_for(local, made_for)
    bounds = bounds_asked_for(options, usual)
    names = {
        "place": ("the robot's position", "m"),
        "heading": ("its heading", "rad"),
        "posts": ("the posts' positions", "m"),
        "speeds": ("the posts' velocities", "m/s"),
    }
    texts = []
    for name, (what, unit) in names.items():
        bound, known = getattr(bounds, name), getattr(usual, name)
        if bound > known * (1 + 1e-9):
            texts.append(
                f"noise of {bound:g} {unit} on {what} is more than the {known:g} {unit} that the run was "
                "made for"
            )
    return texts
