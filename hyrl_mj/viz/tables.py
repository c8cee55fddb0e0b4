"""The results of a run as tables and sentences, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hyrl_mj.game import LIMIT, EpisodeCount, GameResult, Robustness
from hyrl_mj.run_directory import Run
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks import Task

NAMES = {"policy": "RL policy", "hyrl": "HyRL", LIMIT: "limit"}


@dataclass(frozen=True)
class Ending:
    """How a replay ended.

    Attributes:
        outcome: of the arc.
        time: when it ended [s].
        jumps: how often the mode changed.
        end: the last chart point.
        success: whether it ended at the set-point.
    """

    outcome: str
    time: float
    jumps: int
    end: str
    success: bool

    @property
    def details(self) -> str:
        """When it ended, and after how many jumps."""
        jumps = "1 jump" if self.jumps == 1 else f"{self.jumps} jumps"
        return f"{self.time:.2f} s, {jumps}"

    def __str__(self) -> str:
        return f"{self.outcome} {self.details}, {self.end}"


@dataclass(frozen=True)
class Table:
    """Rows under headings.

    Attributes:
        title: over the table.
        headings: one a column.
        rows: the cells.
    """

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str | Ending]]


Arcs = Mapping[tuple[str, str], HybridArc]


# ---- replays


def replay_table(run: Run, arcs: Arcs) -> Table:
    """Returns how policy and hybrid controller did from the replay starts, under the same noise."""
    task = run.task
    columns = {"policy": f"policy ({run.settings.stage1.title})"}
    columns |= {
        f"hyrl_q{q}": f"HyRL, q0 = {task.scene.mode_name(q)}" for q in run.extended_sets.modes
    }
    units = ", ".join(dict.fromkeys(task.chart.units))
    rows: list[list[str | Ending]] = []
    for start in dict.fromkeys(start for start, _ in arcs):
        point = _point(arcs[start, "policy"].z[0])
        endings = [_ending(task, arcs[start, who]) for who in columns]
        rows.append([f"{point} on M*" if start == "critical" else point, *endings])
    return Table(
        f"{task.name}: alternating noise {run.settings.noise:g}, seed {run.settings.seed}",
        [f"start ({', '.join(task.chart.names)}) in {units}", *columns.values()],
        rows,
    )


def _ending(task: Task, arc: HybridArc) -> Ending:
    end, success = _point(task.chart.wrap(arc.z[-1:])[0]), arc.arrives(task)
    outcome = arc.outcome.replace("_", " ") if success or arc.outcome != "reached" else "missed"
    return Ending(outcome, float(arc.t[-1]), int(arc.j[-1]), end, success)


def arrivals(run: Run, arcs: Arcs, policy: bool) -> tuple[int, int]:
    """Returns how many of the paper's replays arrive, and how many there are, of the policy or of HyRL."""
    arrives = [
        arc.arrives(run.task)
        for (start, who), arc in arcs.items()
        if start != "critical" and (who == "policy") == policy
    ]
    return sum(arrives), len(arrives)


def replay_sentence(run: Run, arcs: Arcs) -> str:
    """Returns from how many of the paper's starts the hybrid controller reaches the set-point."""
    reached, total = arrivals(run, arcs, policy=False)
    return f"HyRL reaches the set-point from {reached} of {total} of the paper's starts"


# ---- robustness


def score_table(task: Task, game: GameResult) -> Table:
    """Returns the scores of the worst-case game: a row for each noise bound and controller."""
    where, unit = task.noise_on(game.everywhere)
    headings = [f"noise on {where} [{unit}]", "winnable starts", "controller"]
    headings += ["won, own q0", "won, any q0"]
    if game.lasting:
        headings += ["latest arrival, own q0", "latest, any q0", f"excursion [{unit}]"]
    rows = []
    for level in zip(*game.scores.values(), strict=True):
        for who, score in zip(game.scores, level, strict=True):
            row = [f"{score.eps:g}", percent(score.winnable), NAMES[who]]
            row += [percent(score.won), percent(score.won_any)]
            if game.lasting:
                row += [
                    _seconds(score.time, score.won),
                    _seconds(score.time_any, score.won_any),
                    excursion_text(None if who == LIMIT else score.excursion),
                ]
            rows.append(row)
    return Table(f"{task.name}: worst case over all noise signals, exact game", headings, rows)


def margin_table(task: Task, game: GameResult) -> Table:
    """Returns the margins, and how far off runs end without noise: a row for each controller."""
    _, unit = task.noise_on(game.everywhere)
    units = ", ".join(dict.fromkeys(task.chart.units))
    off = f"off the set-point at most, no noise [{units}]"
    return Table(
        f"{task.name}: margins",
        ["controller", "all winnable starts are won up to noise", off],
        [
            [NAMES[who], margin_text(margin, unit), f"{game.miss_without_noise[who]:.3f}"]
            for who, margin in game.margin.items()
        ],
    )


def excursion_text(excursion: float | None) -> str:
    """Returns how far off the set-point noise keeps a run; none where every run ends."""
    return "-" if excursion is None else f"{excursion:.3f}"


def margin_text(margin: float | None, unit: str) -> str:
    """Returns a margin with its unit; "none" where some run is lost even without noise."""
    return "none" if margin is None else f"{margin:.3g} {unit}"


def episode_table(task: Task, counts: Sequence[EpisodeCount]) -> Table:
    """Returns the counts of the noisy episodes: a row for each noise, controller and start region."""
    rows = []
    for c in counts:
        (low, high), (_, unit) = c.interval, task.noise_on(c.everywhere)
        outcomes = ", ".join(f"{k.replace('_', ' ')} {v:,}" for k, v in c.outcomes.items())
        row = [f"{c.noise} {c.eps:g} {unit}", NAMES[c.controller], c.region]
        row += [f"{c.episodes:,}", percent(c.reached), f"{percent(low)} - {percent(high)}"]
        rows.append([*row, outcomes])
    headings = ("noise", "controller", "starts", "episodes", "reached", "95%", "outcomes")
    return Table(f"{task.name}: noisy episodes", headings, rows)


def robustness_sentence(robustness: Robustness) -> str:
    """Returns the most important figures in one line."""
    if robustness.game is None:
        worst = {
            who: min(c.reached for c in robustness.episodes if c.controller == who)
            for who in ("policy", "hyrl")
        }
        return ", ".join(
            f"{NAMES[who]} reaches in {percent(x)} or more" for who, x in worst.items()
        )
    policy, hyrl = (robustness.game.scores[who][-1] for who in ("policy", "hyrl"))
    return (
        f"worst case at noise {hyrl.eps:g}: the policy wins {percent(policy.won)} of the winnable "
        f"starts, HyRL {percent(hyrl.won)}, from every q0 {percent(hyrl.won_any)}"
    )


# ---- sets


def extent(run: Run, mode: int) -> str:
    """Returns how far a mode's extended set reaches."""
    members = run.extended_sets.sets[run.extended_sets.modes.index(mode)]
    inside, chart = members.mask, run.task.chart
    if inside.all():
        return "extended set everything"
    if chart.dimension > 1 or not chart.periodic[0]:
        return f"extended set {100 * inside.mean():.1f}% of the chart"
    scale, unit = (np.pi, " pi") if chart.units[0] == "rad" else (1.0, f" {chart.units[0]}")
    pieces = [f"{a / scale:.3f}{unit} to {b / scale:.3f}{unit}" for a, b in members.pieces()]
    return f"extended set {', '.join(pieces)}"


def _point(z: np.ndarray) -> str:
    """Returns a chart point (d,), to a thousandth."""
    return f"({', '.join(f'{v + 0.0:.3f}' for v in np.round(z, 3))})"


def percent(share: float) -> str:
    """Returns a share in percent; only 1 is called 100%, and only 0 is called 0%."""
    if share in (0, 1):
        return f"{100 * share:.0f}%"
    text = f"{100 * share:.2f}%"
    return {"100.00%": ">99.99%", "0.00%": "<0.01%"}.get(text, text)


def _seconds(time: float, won: float) -> str:
    """Returns a worst time to arrival; "-" where nothing is won."""
    return f"{time:.2f} s" if won else "-"
