"""What a diagnosis finds out about the policy of a run: what it loses, a run that it loses, and sentences."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.judging import (
    Budget,
    Regions,
    attack,
    attack_starts,
    margin_text,
    replays_sentence,
)
from hyrl_mj.judging.game import (
    NEVER,
    NO_NOISE,
    Game,
    Robustness,
    curve_grid,
    percent,
    worst_signal,
)
from hyrl_mj.policies import PolicyController
from hyrl_mj.runs.arcs import critical_starts, near_middle
from hyrl_mj.runs.directory import Run
from hyrl_mj.sets import within_reach
from hyrl_mj.simulation import HybridArc, Noise, simulate_batch
from hyrl_mj.stages import part_policies


@dataclass(frozen=True)
class Losses:
    """The winnable starts that a policy loses in the worst-case game, by what would cure it.

    Attributes:
        unaided: (n, d) starts that are lost without noise, too. The others are won without noise.
        undecided: (n, d) starts that are won if the policy holds the way of its first measurement: noise
            makes it change its mind at M*. Hysteresis cures that.
        grazing: (n, d) starts that are lost all the same: on its way the policy comes so close to where it
            fails that noise does the rest. Training under noise cures that.
    """

    unaided: np.ndarray
    undecided: np.ndarray
    grazing: np.ndarray


def losses_of(run: Run) -> Losses | None:
    """Returns why the policy loses winnable starts to the worst noise, where the game decides.

    Each part's policy pi_i (paper, Step 4) plays the game alone, on the lattice of `curve_grid`. A start is
    won by holding the way if all pi_i win that the first measurement can select.
    """
    if not run.exact:
        return None
    task, policy, s = run.task, run.steady, run.settings
    pis = part_policies(task, policy, run.partition, s.eps)
    loops = {f"part {q}": PolicyController(pi) for q, pi in pis.items()}
    grid, both = curve_grid(task, s.lattice), {"policy": PolicyController(policy), **loops}
    game = Game(task, run.partition.parts, both, s.eps, grid=grid)
    lost = game.starts & game.winnable(s.eps) & (game.value("policy", s.eps)[-1, :-2] >= NEVER)
    held = np.ones(len(lost), dtype=bool)
    window = np.ceil(game.bound(s.eps) / grid.spacing).astype(int)
    for name, side in zip(loops, game.limit.sides, strict=True):
        selected = within_reach(side.reshape(grid.counts), window, task.chart.periodic).ravel()
        held &= ~selected | (game.value(name, s.eps)[-1, :-2] < NEVER)
    nodes, alone = grid.nodes, game.value("policy", 0.0)[-1, :-2] >= NEVER
    return Losses(nodes[lost & alone], nodes[lost & ~alone & held], nodes[lost & ~alone & ~held])


def worst_arc(run: Run, losses: Losses | None) -> HybridArc | None:
    """Returns a run that the policy loses, or None if no such run was found.

    Where the game decides its adversary gives the noise, from the starts of the more frequent kind of
    losses first: of each kind from the 64 that are nearest to the middle of the replay starts. Otherwise an
    attack searches for noise, from starts half of which are near M*. If it finds none, attacks from a third
    of these starts search for noise of 2, 4 and 8 times the bound.
    """
    task, eps, loop = run.task, run.settings.eps, PolicyController(run.policy)
    if losses is not None:
        parts = losses.grazing, losses.undecided, losses.unaided
        kinds = sorted(parts, key=len, reverse=True)
        z0 = np.vstack([near_middle(task, z, 64) for z in kinds])
        if not len(z0):
            return None
        game = Game(task, run.partition, {"policy": loop}, eps, grid=run.lattice_grid)
        noise = worst_signal(game, "policy", z0, eps)
        return _first_lost(simulate_batch(task, loop, z0, noise))
    count = 48
    if not task.abilities.arrival_ends:
        # Where every episode is played to its end, they have about 20,000 samples together.
        count = int(np.clip(20_000 / task.max_steps, 16, count))
    starts = attack_starts(task, Regions(run.critical_set.points), eps, count, run.settings.seed)
    for factor in (1, 2, 4, 8):
        try:
            task.check_noise(factor * eps)
        except BadInput:  # it would hide the whole chart
            break
        some = starts if factor == 1 else starts[::3]
        budget, settings = Budget(rounds=1, enough=1), run.settings.attack
        found = attack(task, {"policy": loop}, some, factor * eps, budget, settings=settings)
        if (lost := _first_lost(found["policy"].arcs)) is not None:
            return lost
    return None


def _first_lost(arcs: Iterable[HybridArc]) -> HybridArc | None:
    return next((arc for arc in arcs if arc.outcome != "reached"), None)


def usual_arc(run: Run) -> HybridArc:
    """Returns a run of the policy under the paper's noise, from M* if there is one."""
    starts, scene, s = critical_starts(run), run.task.scene, run.settings
    z0, noise = starts[0] if len(starts) else scene.starts[0], Noise("alternating", s.eps)
    (arc,) = simulate_batch(run.task, run.policy, z0, noise, horizon=scene.time, seed=s.seed)
    return arc


def sentences(
    run: Run, robustness: Robustness, arc: HybridArc | None, losses: Losses | None
) -> list[str]:
    """Returns the results in sentences: the critical set, what noise costs and why, the margin, a run."""
    eps, task = robustness.eps, run.task
    unit = task.noise_on(robustness.everywhere)[1]
    results = [f"it {run.arrivals}", run.critical_set.sentence(task)]
    noise = f"noise of up to {task.noise_text(eps, robustness.everywhere)}"
    if (game := robustness.deciding) is not None:
        score = game.scores["policy"][-1]
        lost = percent(1 - score.not_broken)
        if losses is not None and len(losses.unaided):
            results.append(f"without noise it loses {len(losses.unaided):,} nodes that can be won")
        results.append(
            f"signals of {noise} are known that make it lose {lost} of the winnable starts"
        )
        replays = game.replays_of("policy")
        if replays and replays.failures:
            results.append(replays_sentence(task, replays))
        elif score.proved is not None:
            results.append(f"it is proved to win {percent(score.proved)} of them")
        if losses is not None:
            results.append(losses_sentence(losses))
        if (margin := game.margin["policy"]) is None:
            results.append("on the nodes it does not win all of them even without noise")
        else:
            results.append(
                f"on the nodes it wins all of them up to noise {margin_text(margin, unit, game)}"
            )
    else:
        if run.agent and run.agent.why_no_function:
            why = run.agent.why_no_function
            results.append(f"{why}: noisy episodes stand in for the worst case")
        noisy = [count for count in robustness.episodes if count.noise != NO_NOISE]
        worst = min(noisy, key=lambda count: count.reached)
        where = f"episodes that start {worst.region}"
        for count in robustness.episodes:
            if (count.noise, count.region) == (NO_NOISE, worst.region) and count.lost:
                results.append(
                    f"without noise it loses {count.lost:,} of {count.episodes:,} {where}"
                )
        results.append(
            f"under {worst.noise} {noise} it loses {worst.lost:,} of {worst.episodes:,} {where}"
        )
    if arc is None:
        return [*results, f"no start was found that {noise} makes it lose"]
    start, outcome = task.chart.format(arc.z[0]), arc.outcome.replace("_", " ")
    end = f"it ends {outcome} after {arc.t[-1]:.2f} s, under {arc.noise} noise"
    if arc.bound > eps * (1 + 1e-9):
        results.append(f"no start was found that {noise} makes it lose")
        end += f" of up to {arc.bound:g} {unit}"
    (alone,) = simulate_batch(task, run.policy, arc.z[:1])
    if alone.outcome != "reached":
        end += ", and without noise, too"
    return [*results, f"from {start} {end}"]


def losses_sentence(losses: Losses) -> str:
    """Returns why starts are lost: the shares, what is lost without noise first, and what to do."""
    alone, n, close = len(losses.unaided), len(losses.undecided), len(losses.grazing)
    total = alone + n + close
    if not total:
        return "it loses none of them on the nodes"
    fails = "it fails there by itself, train it further first"
    if alone == total:
        return f"it loses all {total:,} lost nodes without noise, too: {fails}"
    first = (
        f"loses {alone:,} without noise, too ({100 * alone / total:.0f}%: {fails}), "
        if alone
        else ""
    )
    return (
        f"of {total:,} lost nodes it {first}would win {n:,} if it held the way of its first measurement "
        f"({100 * n / total:.0f}%: noise at M* keeps it undecided, hysteresis cures that), and loses "
        f"{close:,} all the same ({100 * close / total:.0f}%: it passes closer than the noise, "
        "training under noise cures that); hyrl-mj robustify does both"
    )
