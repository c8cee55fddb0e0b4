"""Sentences about the results of an examination and of stage 6."""

from __future__ import annotations

import numpy as np

from hyrl_mj.errors import counted
from hyrl_mj.judging.game import NO_NOISE, Comparison, GameResult, ReplayCount, Score, percent
from hyrl_mj.judging.results import ModeResult
from hyrl_mj.tasks import Task

# What sentences call the controllers.
NAMES = {"policy": "the policy", "hyrl": "HyRL"}


def comparison_sentence(task: Task, compared: Comparison) -> str:
    """Returns what one kind of noise does to both controllers from the same starts."""
    how = "attack" if compared.noise == "attack" else f"{compared.noise} noise"
    if not compared.compared:
        return f"{how}: there is no start that both win without noise, so nothing is compared"
    low, high = compared.interval
    lost, late = compared.lost, compared.late
    # Where an episode goes on after the arrival, its end does not tell when that was.
    of_time = f"; late are {late['policy']:,} and {late['hyrl']:,}" * task.tells_arrival
    return (
        f"{how}: of {compared.compared:,} starts that both win without noise the policy loses "
        f"{lost['policy']:,} and HyRL {lost['hyrl']:,} (difference {100 * compared.difference:.1f} points, "
        f"95% interval {100 * low:.1f} to {100 * high:.1f}){of_time}"
    )


def replays_sentence(task: Task, count: ReplayCount) -> str:
    """Returns how many replays a controller lost, and the first of them."""
    who = NAMES[count.controller]
    said = "proved" if count.of == "proved" else "winnable"
    if count.first is None:
        return (
            f"{who} lost none of {count.played:,} {said} starts when they were replayed in MuJoCo"
        )
    first = count.first
    mode = "" if first.q0 is None else f" in mode {task.mode_name(first.q0)}"
    noise = "without noise" if first.noise == NO_NOISE else f"under {first.noise} noise"
    said = "a proved start" if count.of == "proved" else "a start that no known noise beats"
    withdrawn = "withdrawn: " if count.controller == "hyrl" else ""
    return (
        f"{withdrawn}{said} was lost in a replay: from {task.chart.format(np.array(first.start))}{mode} "
        f"{noise} {who} ends {first.outcome.replace('_', ' ')}, and {count.failures:,} of "
        f"{count.played:,} such replays in MuJoCo are lost"
    )


def margin_text(margin: float | None, unit: str, game: GameResult) -> str:
    """Returns a margin of a game with its unit; "none" where some run is lost even without noise.

    It is "at least" so much where no larger noise was tried, but for a cell of the lattice.
    """
    if margin is None:
        return "none"
    least = margin > game.curve.eps[-1] - max(game.lattice.spacing)
    return f"{'at least ' * least}{margin:.3g} {unit}"


def share_sentence(score: Score) -> str:
    """Returns what is proved, and what is known to be lost."""
    lost = f"known to lose {percent(1 - score.not_broken)}"
    if score.not_broken == 1:
        lost = "not known to lose any"
    return (
        f"is {lost}"
        if score.proved is None
        else f"is proved to win {percent(score.proved)} and {lost}"
    )


# What the policy of a mode is, unless it was trained.
POLICIES = {
    "pi_i": ", the agent as on its own side of M*,",
    "agent": ", the agent itself,",
    "table": ", a table of inputs,",
}


def mode_sentence(task: Task, result: ModeResult) -> str:
    """Returns how well the policy of a mode holds its set."""
    how = (
        f"after {counted(result.attempts, 'training')}"
        if result.attempts
        else "without a training of its own"
    )
    mode = f"the policy of mode {task.mode_name(result.mode)}{POLICIES.get(result.policy, '')}"
    won = "every state tested in" if result.won == 1 else f"{percent(result.won)} of"
    return f"{mode} wins {won} its set, {how}"
