"""Drives through a field, as tables and as replays."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from hyrl_mj.errors import BadInput, counted, printable
from hyrl_mj.fields import (
    DriveOptions,
    Drives,
    cautions,
    changes,
    check_passable,
    drive,
    ending,
    least_clearance,
    noise_cautions,
    read_field,
)
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import Field
from hyrl_mj.viz.options import USUAL, ReplayOptions
from hyrl_mj.viz.replay import Show, check_replay, render_replay
from hyrl_mj.viz.tables import NAMES, Table, print_table

# The controllers with columns of their own, and panes in a replay.
SHOWN = ("policy", "hyrl")


def _table(drives: Drives, arcs: Mapping[str, Sequence[HybridArc]], title: str) -> Table:
    """Returns how the runs ended, a row for each start."""
    task, rows = drives.task, []
    for number, (policy, hyrl) in enumerate(zip(*(arcs[n] for n in SHOWN), strict=True)):
        x, y, heading = hyrl.z[0]
        row = [f"{number}", f"{x:.2f} m, {y:.2f} m, {heading:.2f} rad"]
        for arc in (policy, hyrl):
            row += [f"{ending(arc)} {arc.t[-1]:.2f} s", f"{least_clearance(task, arc):.2f} m"]
        rows.append([*row, f"{changes(hyrl)}"])
    both = [title for name in SHOWN for title in (NAMES[name], "least clearance")]
    return Table(title, ["", "start", *both, "changes of focus or side"], rows)


def drive_sentences(drives: Drives) -> list[str]:
    """Returns from how many starts the controllers arrive, a sentence for each table."""
    whole = [_arrivals(drives, drives.arcs)]
    if drives.attacked:
        whole.append(f"under the worst noise that was found {_arrivals(drives, drives.attacked)}")
    return whole


def _arrivals(drives: Drives, arcs: Mapping[str, Sequence[HybridArc]]) -> str:
    counts = []
    for name in arcs:
        ends = [ending(arc) for arc in arcs[name]]
        arrives = f"{ends.count('arrived')}" + f" of {len(ends)} starts" * (name == "policy")
        waits = ends.count("waited")
        counts.append(arrives + f" and waits near a post at the goal from {waits}" * (waits > 0))
    return (
        f"RL policy arrives from {counts[0]}, HyRL from {counts[1]}, and HyRL from {counts[2]} if its modes "
        "drive by a law without learning"
    )


def drive_run(
    run: Run,
    path: Path,
    options: DriveOptions,
    out: Path | None = None,
    how: ReplayOptions = USUAL,
    shown: Sequence[int] | None = None,
) -> Drives:
    """Drives through the field of a file with the controllers of a run, prints how it went, and renders it.

    What the policies were not made for is logged as a warning.

    Args:
        run: of the task `field`, whose both sides have a policy.
        path: the JSON file of the field.
        options: the noise.
        out: the video or picture to write; by default none.
        how: how the replay is rendered.
        shown: numbers of the starts that it shows, by default all.

    Raises:
        BadInput: a file, a run or an option that cannot be used.
        NoRenderer: there is no GL library or no video encoder.
    """
    if how.layout != "side-by-side":
        raise BadInput(
            f"layout {how.layout!r} cannot show a drive, in which posts may move: choose side-by-side"
        )
    if out is None and (shown is not None or how != USUAL):
        raise BadInput("what is rendered needs a file to write: give --out, as in --out drive.mp4")
    local, policy, policies = _parts(run)
    field = read_field(path)
    check_passable(field, local.body)
    if out is not None:
        check_replay(local, out, how)
    starts = range(len(field.starts)) if shown is None else shown
    for number in starts:
        if number >= len(field.starts):
            raise BadInput(
                f"--shown {number}: the file has no such start, give numbers from 0 to "
                f"{len(field.starts) - 1}"
            )
    made_for = run.settings.eps
    speed = float(local.input_limits[1][0])
    unknown = (*cautions(field, local.body, speed), *noise_cautions(local, made_for, options))
    for caution in unknown:
        logging.getLogger("hyrl_mj").warning("warning: %s", printable(caution))
    drives = drive(local, policy, policies, made_for, field, options, run.settings.attack)
    what, seed = counted(drives.task.layouts.posts, "post"), options.seed
    noise = "no noise" if options.noise == "none" else f"{options.noise} noise of {drives.bounds}"
    near = f"arrived: within {drives.task.reached:g} m of the goal"
    print_table(_table(drives, drives.arcs, f"{what}: {noise}, seed {seed}; {near}"))
    if drives.attacked:
        worst = f"the worst noise of up to {drives.bounds} that a search found for each"
        print_table(_table(drives, drives.attacked, f"{what}: {worst}"))
    for sentence in drive_sentences(drives):
        print(sentence)
    if out is not None:
        policy_arcs, hybrid_arcs = ((drives.attacked or drives.arcs)[name] for name in SHOWN)
        shows = [
            Show([policy_arcs[i]], [hybrid_arcs[i]], f"{run.policy_title}, start {i}")
            for i in starts
        ]
        render_replay(drives.task, shows, out, how)
        print(f"{'picture' if out.suffix == '.png' else 'video'} at {out}")
    return drives


def _parts(run: Run) -> tuple[Field, MlpPolicy, Mapping[int, MlpPolicy]]:
    """Returns what a run trained: its task, the policy of stage 1, and that of each side.

    Raises:
        BadInput: it is not a run of `field`.
    """
    remedy = "make one with hyrl-mj run field --out runs/field"
    local = run.task
    if not isinstance(local, Field):
        raise BadInput(
            f"{run.path} is a run of {local.name}, but drive takes a run of field: {remedy}"
        )
    policy, policies = run.policy, run.mode_networks
    if not isinstance(policy, MlpPolicy):
        raise BadInput(
            f"{run.path} is a run of an agent, but drive takes a run that trained: {remedy}"
        )
    return local, policy, policies
