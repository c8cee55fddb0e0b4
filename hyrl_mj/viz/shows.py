"""What a replay shows of the arcs of a run, and the marks on its floor."""

from __future__ import annotations

from functools import partial

from numpy.typing import ArrayLike

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.runs.arcs import attack_replay, noisy_arcs, replay_arcs
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import AnyNoise
from hyrl_mj.viz.replay import Floor, Floors, Show
from hyrl_mj.viz.section import critical_sets, sections


def replay_shows(
    run: Run,
    starts: str | ArrayLike = "critical",
    noise: str | AnyNoise | None = None,
    eps: float | None = None,
) -> list[Show]:
    """Returns the shows that a replay plays.

    Args:
        run: with its arcs.
        starts: "critical" for the start on M*, once for each start mode, or where no game decides for
            the strongest signals of the attack; "paper" for all of the paper's
            starts at once; "latest" for the arcs of the last `hyrl-mj simulate --start`; or starts (n, d).
        noise: of a new simulation, as in `noisy_arcs`; by default the arcs on disk are played, and starts
            (n, d) are simulated under alternating noise.
        eps: the bound of a new simulation, by default the run's; without `noise` that of `replay_arcs`.

    Raises:
        BadInput: a value that cannot be used.
    """
    modes = run.extended_sets.modes
    show = partial(Show, title=run.policy_title, modes=modes)
    if not isinstance(starts, str):
        z0 = run.task.chart.check(starts, run.task.name)
        found = noisy_arcs(run, z0, "alternating" if noise is None else noise, eps)
        return [show(found["policy"], found["hyrl"])]
    if starts not in (known := ("critical", "paper", "latest")):
        raise unknown("starts", starts, known)
    is_new = noise is not None or eps is not None
    if starts == "latest":
        if is_new:
            raise BadInput(
                "the latest simulation has its noise: give noise and eps to hyrl-mj simulate, not here"
            )
        policy, hybrid = ([run.arc(run.arc_path("latest", who))] for who in ("policy", "hyrl"))
        return [show(policy, hybrid)]
    if starts == "critical" and not is_new and (attacked := attack_replay(run)):
        return [show([attacked["policy"]], [attacked["hyrl"]])]
    arcs = replay_arcs(run, noise, eps) if is_new else run.arcs()
    names = dict.fromkeys(name for name, _ in arcs)
    loops = [f"hyrl_q{q}" for q in modes]
    if starts == "paper":
        names.pop("critical", None)
        policy = [arcs[name, "policy"] for name in names]
        hybrid = [arcs[name, loop] for name in names for loop in loops]
        return [show(policy, hybrid)]
    name = "critical" if "critical" in names else next(iter(names))
    policy = [arcs[name, "policy"]]
    return [show(policy, [arcs[name, loop]]) for loop in loops]


def replay_floor(run: Run, overlap: bool = True) -> Floors:
    """Returns the marks on the floor of a replay, in sections of the task's chart."""
    axis, cuts = sections(run.task)
    parts = run.split if overlap else run.partition
    floors = [
        Floor.from_sets(
            cut,
            critical,
            cut.partition(parts),
            cut.extended_sets(run.extended_sets) if overlap else None,
        )
        for cut, critical in zip(cuts, critical_sets(run, cuts), strict=True)
    ]
    return Floors(run.task.chart, axis, tuple(floors))
