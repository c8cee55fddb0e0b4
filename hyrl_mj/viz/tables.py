"""The results of a run as tables and sentences, for pages and the terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from hyrl_mj.errors import counted
from hyrl_mj.judging import margin_text
from hyrl_mj.judging.game import (
    LIMIT,
    NEARLY,
    NO_NOISE,
    AttackCount,
    Comparison,
    EpisodeCount,
    GameResult,
    ReplayCount,
    Robustness,
    percent,
)
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import HybridArc, LogNoise
from hyrl_mj.tasks import Task

# With more modes than these, headings hold their numbers alone.
NAMED = 2
NAMES = {"policy": "RL policy", "hyrl": "HyRL", LIMIT: "limit"}
# The texts of numbers, and of shares that are not proved.
number, tried = "{:.3g}".format, partial(percent, surely=False)


@dataclass(frozen=True)
class Ending:
    """How a replay ended: outcome, "2.35 s, 1 jump", last chart point, and whether it arrived."""

    outcome: str
    details: str
    end: str
    success: bool

    def __str__(self) -> str:
        return f"{self.outcome} {self.details}, {self.end}"


@dataclass(frozen=True)
class Table:
    """Rows of cells under a title and headings, one a column.

    Below it stand on pages a note how to read it, and remarks everywhere.
    """

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str | Ending]]
    note: str = ""
    remarks: Sequence[str] = ()

    @staticmethod
    def of(title: str, rows: Sequence[Mapping[str, str]], *more: Any) -> Table:
        """Returns a table of rows that have the same headings; of no rows it has none."""
        headings = list(rows[0]) if rows else []
        return Table(title, headings, [list(row.values()) for row in rows], *more)


def markdown(table: Table) -> str:
    """Returns a table to paste as Markdown."""
    head, *rows = [[*map(escaped, row)] for row in (table.headings, *table.rows)]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def escaped(text: object) -> str:
    """Returns a text that holds no Markdown: no column, no link, no picture and no element of HTML."""
    return re.sub(r"([\\|\[\]<>`])", r"\\\1", str(text))


def spread(
    values: Sequence[float],
    middle: Callable[[Sequence[float]], Any],
    show: Callable[[float], str],
    of: int = 0,
    noun: str = "",
) -> str:
    """Returns the middle of values with the least and the greatest, if these differ: "3 (1 to 4)".

    Of no values that is "-". `of` is how many there could be, of "run" or "seed".
    """
    if not values:
        return "-"
    low, high, text = show(min(values)), show(max(values)), show(float(middle(values)))
    text = text if low == high else f"{text} ({low} to {high})"
    missing = of - len(values)
    return f"{text}, none in {missing} of {counted(of, noun)}" if missing > 0 else text


Arcs = Mapping[tuple[str, str], HybridArc]


# ---- replays


def replay_table(run: Run, arcs: Arcs) -> Table:
    """Returns how the replays of policy and hybrid controller ended: a row for each start."""
    task, s = run.task, run.settings
    columns = {"policy": f"policy ({s.stage1.title})"}
    for q in run.extended_sets.modes:
        name = task.mode_name(q) if len(run.extended_sets.modes) <= NAMED else q
        columns[f"hyrl_q{q}"] = f"HyRL, q0 = {name}"
    units = ", ".join(dict.fromkeys(task.chart.units))
    rows: list[list[str | Ending]] = []
    for start in dict.fromkeys(start for start, _ in arcs):
        point = _point(arcs[start, "policy"].z[0])
        endings = [_ending(task, arcs[start, who]) for who in columns]
        rows.append([f"{point} on M*" if start == "critical" else point, *endings])
    headings = [f"start ({', '.join(task.chart.names)}) in {units}", *columns.values()]
    noise = f"alternating noise {s.eps:g}{', on M* the strongest found' if run.exact else ''}"
    note = (
        "Outcome, time, jumps from mode to mode, and last state; q0 is the mode that HyRL starts in. A run "
        "that has reached its goal is marked good if it ended close to the set-point."
    )
    return Table(f"{task.name}: {noise}, seed {s.seed}", headings, rows, note)


def _ending(task: Task, arc: HybridArc) -> Ending:
    """Returns how an arc ended, as `HybridArc.ending`."""
    end = _point(task.chart.wrap(arc.z[-1:])[0])
    details = f"{arc.t[-1]:.2f} s, {counted(arc.j[-1], 'jump')}"
    return Ending(arc.ending(task).replace("_", " "), details, end, arc.arrives(task))


def arrivals(run: Run, arcs: Arcs, policy: bool) -> tuple[int, int]:
    """Returns how many of the paper's replays arrive, of the policy or else of HyRL, and of how many."""
    arrives = [
        arc.arrives(run.task)
        for (start, who), arc in arcs.items()
        if start != "critical" and (who == "policy") == policy
    ]
    return sum(arrives), len(arrives)


def replay_sentence(run: Run, arcs: Arcs) -> str:
    """Returns from how many of the scene's starts the hybrid controller reaches the set-point.

    Runs of the scene may last longer than episodes.
    """
    (reached, total), task = arrivals(run, arcs, policy=False), run.task
    found = f"HyRL reaches the set-point from {reached} of {total} of the scene's starts"
    longest = task.max_steps * task.dt
    if task.scene.time <= longest + task.dt / 2:
        return found
    return f"{found} within {task.scene.time:g} s; an episode lasts {longest:g} s"


# ---- robustness


def robustness_tables(task: Task, robustness: Robustness) -> list[Table]:
    """Returns what noise can do: the worst-case game, noisy episodes, the attack, and both compared."""
    tables = []
    if game := robustness.game:
        tables.append(score_table(task, game))
        if not game.estimate:
            tables.append(margin_table(task, game))
        if game.sensed:
            tables.append(sensed_table(task, game))
        if game.replays:
            tables.append(replays_table(task, game.replays))
    if robustness.episodes:
        tables.append(episode_table(task, robustness.episodes))
    if robustness.attacks:
        tables += [
            attack_table(task, robustness.attacks, robustness.near_critical),
            signals_table(task, robustness.attacks),
        ]
    if robustness.comparisons and len(robustness.comparisons[0].lost) > 1:
        tables.append(comparison_table(task, robustness.comparisons))
    return tables


def robustness_rows(robustness: Robustness) -> list[dict[str, Any]]:
    """Returns what noise can do in numbers: a row for each kind of noise, its bound, and each controller.

    A row has the kind of noise ("worst" is the worst-case game), its bound `eps`, the controller ("limit" is
    the best that is possible in the game), the share that is `lost`, and where starts were drawn the 95%
    interval of the share, `lost_low` to `lost_high`, and of how many `runs` it is the share. Episodes have a
    row for each region of `starts`. Under attack the share is of the starts that are won without noise, NaN
    if there are none, and in the game of the winnable ones, as are all fields of `Score`.
    """
    rows: list[dict[str, Any]] = []
    for who, level in robustness.game.scores.items() if robustness.game else ():
        for score in level:
            row = {"noise": "worst", "controller": who, "lost": 1 - score.not_broken}
            rows.append(row | vars(score))
    for e in robustness.episodes:
        low, high = (1 - share for share in reversed(e.interval))
        row = {"noise": e.noise, "controller": e.controller, "lost": 1 - e.reached}
        row["eps"] = 0.0 if e.noise == NO_NOISE else e.eps
        rows.append(
            row | {"lost_low": low, "lost_high": high, "runs": e.episodes, "starts": e.region}
        )
    for a in robustness.attacks:
        low, high = a.interval
        lost = a.lost / a.attacked if a.attacked else np.nan
        row = {"noise": "attack", "controller": a.controller, "lost": lost, "eps": a.eps}
        row |= {"lost_low": low, "lost_high": high, "runs": a.attacked}
        rows.append(row)
    return rows


def score_table(task: Task, game: GameResult) -> Table:
    """Returns the scores of the worst-case game: a row for each noise bound and controller."""
    where, unit = task.noise_on(game.everywhere)
    rows = []
    for level in zip(*game.scores.values(), strict=True):
        for who, score in zip(game.scores, level, strict=True):
            row = {
                f"noise on {where} [{unit}]": f"{score.eps:g}",
                "open": percent(score.open),
                "winnable": percent(score.winnable),
                "controller": NAMES[who],
            }
            for q0, proved, whole in (
                ("own q0", score.proved, score.not_broken),
                ("any q0", score.proved_any, score.not_broken_any),
            ):
                known = percent(whole, surely=proved == 1)
                row[f"proved, {q0}"] = proved_text(proved)
                row[f"not broken, {q0}"] = "all" if who == LIMIT and whole == 1 else known
            if game.lasting:
                own, some = score.proved_time or score.time, score.proved_time_any or score.time_any
                row["latest arrival, own q0"] = f"{own:.2f} s" if score.won else "-"
                row["latest, any q0"] = f"{some:.2f} s" if score.won_any else "-"
                excursion = None if who == LIMIT else score.excursion
                row[f"excursion [{miss_unit(task)}]"] = excursion_text(excursion)
            rows.append(row)
    estimated = ", an estimate" if game.estimate else ""
    spacing = " by ".join(f"{round(side, 5)}" for side in game.lattice.spacing)
    units = ", ".join(dict.fromkeys(task.chart.units))
    caution = 'This is an estimate: "open" and "winnable" may be too much or too little. '
    note = (
        f'Played on a lattice of states, {spacing} {units} apart. "Open" is what one who sees the state can '
        'win, "winnable" what this split can win by deciding the way from the measurement; the other shares '
        'are of the winnable starts. "Proved" holds for every state between the nodes and for every noise '
        'signal within the bound. "Not broken" is where no start is known that is lost: each start that '
        "counts as lost was lost on the plant, with its noise signal."
    )
    remarks = [
        f"Nothing is proved of {'the RL policy' if who == 'policy' else NAMES[who]}, because {why}."
        for who, why in game.why_not_proved.items()
    ]
    if game.other_starts:
        remarks.append(f"Episodes decide, because {game.other_starts}.")
    title = f"{task.name}: worst case over all noise signals{estimated}"
    return Table.of(title, rows, caution * game.estimate + note, remarks)


def proved_text(share: float | None) -> str:
    """Returns a proved share; "-" of a controller that could not be bounded."""
    return "-" if share is None else percent(share)


def miss_unit(task: Task) -> str:
    """Returns the unit of how far off the set-point a robot is."""
    # A method of the user's own may tell metres of angles.
    own = task.source is not None and type(task).miss is not Task.miss
    return "as miss() tells" if own else task.chart.unit


def margin_table(task: Task, game: GameResult) -> Table:
    """Returns the margins, and how far off runs end without noise: a row for each controller."""
    _, unit = task.noise_on(game.everywhere)
    rows = [
        {
            "controller": NAMES[who],
            "largest noise without a lost state": margin_text(margin, unit, game),
            f"{100 * NEARLY:.0f}% is proved up to noise": margin_text(
                game.proved_margin[who], unit, game
            ),
            f"off the set-point at most, no noise [{miss_unit(task)}]": f"{game.miss_without_noise[who]:.3f}",
        }
        for who, margin in game.margin.items()
    ]
    return Table.of(f"{task.name}: margins", rows)


def sensed_table(task: Task, game: GameResult) -> Table:
    """Returns what is proved under the task's own sensor: a row for each controller."""
    rows = [
        {
            "controller": NAMES[who],
            "proved, own q0": percent(score.proved),
            "proved, any q0": percent(score.proved_any),
        }
        for who, score in game.sensed.items()
    ]
    note = "The worst case above is over all signals within a bound, which is more than the sensor can do."
    return Table.of(f"{task.name}: of all starts, under its sensor: {task.sensor}", rows, note)


def excursion_text(excursion: float | None) -> str:
    """Returns how far off the set-point noise keeps a run; "-" where every run ends."""
    return "-" if excursion is None else f"{excursion:.3f}"


def replays_table(task: Task, counts: Sequence[ReplayCount]) -> Table:
    """Returns how many proved or won starts were lost when they were replayed: a row for each controller."""
    kinds = list(dict.fromkeys(kind for count in counts for kind in count.starts))
    rows = []
    for c in counts:
        row = {
            "controller": NAMES[c.controller],
            "starts": c.of,
            "played": f"{c.played:,}",
            "lost": f"{c.failures:,}",
        }
        for k in kinds:
            row[f"lost, {k}"] = f"{c.lost[k]:,} of {c.starts[k]:,}" if k in c.starts else "-"
        row |= {"judged": f"{c.judged:,}", "first lost": "-"}
        if first := c.first:
            mode = "" if first.q0 is None else f", mode {task.mode_name(first.q0)}"
            where = f"{_point(np.array(first.start))}{mode}"
            row["first lost"] = f"{first.outcome.replace('_', ' ')} from {where}"
        rows.append(row)
    noise = task.noise_text(counts[0].eps, counts[0].everywhere)
    title = f"{task.name}: replays in MuJoCo, noise of up to {noise}"
    note = (
        "The starts are proved, or no known noise beats them; they lie anywhere in their cells, the weakest "
        'first, in each start mode. "Judged" are those that plain MuJoCo played once more, one by one, with '
        "the same result at every sample. A single loss withdraws the words PROVED and WON."
    )
    return Table.of(title, rows, note)


def episode_table(task: Task, counts: Sequence[EpisodeCount]) -> Table:
    """Returns the counts of the noisy episodes: a row for each noise, controller and start region."""
    rows = []
    for c in counts:
        (low, high), (_, unit) = c.interval, task.noise_on(c.everywhere)
        outcomes = ", ".join(f"{k.replace('_', ' ')} {v:,}" for k, v in c.outcomes.items())
        row = {
            "noise": c.noise if c.noise == NO_NOISE else f"{c.noise} {c.eps:g} {unit}",
            "controller": NAMES[c.controller],
            "starts": c.region,
            "episodes": f"{c.episodes:,}",
            "reached": percent(c.reached, surely=False),
            "95%": f"{percent(low)} - {percent(high)}",
            "outcomes": outcomes,
        }
        rows.append(row)
    note = "With the 95% interval of the share that reached the set-point."
    return Table.of(f"{task.name}: noisy episodes", rows, note)


def attack_table(task: Task, counts: Sequence[AttackCount], near_critical: bool = False) -> Table:
    """Returns from how many starts the attack found a signal that makes controllers lose: a row for each."""
    rows = []
    for c in counts:
        low, high = (percent(share) for share in c.interval)
        share = percent(c.lost / c.attacked, surely=False) if c.attacked else "-"
        signal = f"{c.outcome.replace('_', ' ')} from {_point(np.array(c.start))}"
        row = {
            "controller": NAMES[c.controller],
            "starts": f"{c.starts:,}",
            "lost without noise": f"{c.unaided:,}",
            "lost": f"{c.lost:,}",
            "share of the others": share,
            "95%": f"{low} - {high}" if c.attacked else "-",
            "rounds": f"{c.rounds:,}",
            "runs": f"{sum(c.tried.values()):,}",
            "samples": f"{c.samples:,}",
            "strongest signal": signal,
        }
        rows.append(row)
    noise = task.noise_text(counts[0].eps, counts[0].everywhere)
    title = f"{task.name}: attack, a search for noise of up to {noise}"
    note = (
        f"{'All' if near_critical else 'Half'} of the starts lie near the critical set. Every loss has been "
        "repeated with its recorded noise signal. The interval is that of the share. That the attack finds "
        "nothing is no proof that there is nothing."
    )
    return Table.of(title, rows, note)


def signals_table(task: Task, counts: Sequence[AttackCount]) -> Table:
    """Returns in how many runs each controller was tried with each kind of signal."""
    kinds = dict.fromkeys(kind for count in counts for kind in count.tried)
    rows = [[kind, *(f"{count.tried.get(kind, 0):,}" for count in counts)] for kind in kinds]
    headings = ("signal", *(f"runs of {NAMES[count.controller]}" for count in counts))
    note = (
        "All are tried with the same rules; those about modes come on top for one that has several."
    )
    return Table(f"{task.name}: signals that the attack tried", headings, rows, note)


def comparison_table(task: Task, comparisons: Sequence[Comparison]) -> Table:
    """Returns what each kind of noise does to both controllers from the same starts: a row for each."""
    rows = []
    for c in comparisons:
        low, high = (f"{100 * end:.1f}" for end in c.interval)
        arrive = [who for who, lost in c.lost.items() if lost < c.compared]
        row = {
            "noise": c.noise,
            "lost without noise": _both(c.unaided),
            "starts compared": f"{c.compared:,} of {c.starts:,}",
            "lost under noise": _both(c.lost),
            "difference, 95% [points]": f"{100 * c.difference:.1f} ({low} to {high})"
            if c.compared
            else "-",
            "late": _both(c.late, arrive) if task.tells_arrival else "-",
            "time, median and 99%": _both(c.time, arrive) if task.tells_arrival else "-",
            "way, median and 99%": _both(c.way, arrive),
        }
        rows.append(row)
    names = " and ".join(NAMES[name] for name in comparisons[0].lost)
    title = f"{names} from the same starts; time and way are relative to those without noise"
    note = (
        "Under noise only starts are compared that both win without it. Late is a run that takes more than "
        "twice its time without noise."
    )
    return Table.of(f"{task.name}: {title}", rows, note)


def _both(
    values: Mapping[str, int | tuple[float, float]], only: Collection[str] | None = None
) -> str:
    """Returns the values of both controllers, as "20, 3", and "-" for one that is not in `only`."""
    texts = [
        "-"
        if only is not None and who not in only
        else f"{v[0]:.2f} {v[1]:.2f}"
        if isinstance(v, tuple)
        else f"{v:,}"
        for who, v in values.items()
    ]
    return ("; " if any(isinstance(v, tuple) for v in values.values()) else ", ").join(texts)


def robustness_sentence(robustness: Robustness) -> str:
    """Returns the most important scores in one line."""
    if robustness.deciding is None:
        parts = []
        for who in ("policy", "hyrl"):
            least = min(c.reached for c in robustness.episodes if c.controller == who)
            share = "all" if least == 1 else f"{percent(least)} or more of the"
            parts.append(f"{NAMES[who]} reaches in {share} episodes")
        if robustness.attacks:
            broken = (f"{NAMES[c.controller]} from {c.broken}" for c in robustness.attacks)
            parts.append(f"the attack breaks {', '.join(broken)}")
        return ", ".join(parts)
    policy, hyrl = (robustness.deciding.scores[who][-1] for who in ("policy", "hyrl"))
    shares = [
        f"{NAMES[who]} {proved_text(proved)} proved and {percent(1 - whole)} lost{how}"
        for who, proved, whole, how in (
            ("policy", policy.proved, policy.not_broken, ""),
            ("hyrl", hyrl.proved, hyrl.not_broken, ""),
            ("hyrl", hyrl.proved_any, hyrl.not_broken_any, " if any q0 is given"),
        )
    ]
    shares += [
        f"{NAMES[count.controller]} lost {count.failures:,} of {count.played:,} replays"
        for count in robustness.deciding.replays
    ]
    found = f"worst case at noise {hyrl.eps:g}, of the winnable starts: {', '.join(shares)}"
    if sensed := robustness.deciding.sensed:
        proved_of = (f"{NAMES[who]} {percent(s.proved)} proved" for who, s in sensed.items())
        found += f"; under the sensor itself, of all starts: {', '.join(proved_of)}"
    return found


# ---- logs


def noise_table(noise: LogNoise) -> Table:
    """Returns the noise of a log: a row for each column; "-" is what the log does not tell."""

    def told(value: float) -> str:
        return "-" if np.isnan(value) else f"{value:.2g}"

    rows = []
    for c in noise.columns:
        row = {
            "": c.name,
            "delay": told(c.delay),
            "held": f"{c.held}, {100 * c.held_rate:.0f}%" if c.held else "0",
            "quantum": told(c.quantum),
            "bias": told(c.bias),
            "drift": f"{c.drift:.2g}, {c.drift_rate:.2g}/s" if c.drift else "0",
            "bound": told(c.bound),
            "sigma": told(c.sigma),
            "lag 1": f"{c.correlation:.2f}",
        }
        rows.append(row if len(c.errors) else dict.fromkeys(row, "-") | {"": c.name})
    return Table.of("noise, in the units of the log; delay and held in samples", rows)


# ---- sets


def extent(run: Run, mode: int) -> str:
    """Returns which part of the chart a mode's extended set covers."""
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


# ---- what commands print


def print_summary(run: Run) -> None:
    """Prints the verdict, and the results of policy and hybrid controller in replays and worst case."""
    arcs = run.arcs()
    print_verdict(run)
    print_table(replay_table(run, arcs))
    print(run.critical_set.sentence(run.task))
    for q in run.extended_sets.modes:
        print(f"mode {run.task.mode_name(q)}: {extent(run, q)}")
    print(replay_sentence(run, arcs))
    print_robustness(run)
    print(f"run directory {run.path}")
    for what, name in (("video", "replay.mp4"), ("report", "report.html")):
        path = run.path / name
        print(f"{what} {path}" if run.manifest.has(path) else f"no {what}")


def print_verdict(run: Run) -> None:
    """Prints the verdict with its reasons."""
    print(run.verdict)
    for reason in run.verdict.reasons:
        print(f"- {reason}")


def print_robustness(run: Run) -> None:
    """Prints what noise can do."""
    for table in robustness_tables(run.task, run.robustness):
        print_table(table)


def print_noise(noise: LogNoise) -> None:
    """Prints the noise of a log: a table, what it does not tell, and the noise to give to a run."""
    print_table(noise_table(noise))
    for remark in (*noise.remarks, *(text for column in noise.columns for text in column.remarks)):
        print(f"- {remark}")
    if len({column.text for column in noise.columns}) > 1:
        for column in noise.columns:
            print(f"{column.name}: {column.text}")
    none = "it shows no noise, so no run is made for it: a bound that covers more is given by --eps"
    print(none if noise.text == "none" else f'hyrl-mj run TASK --noise "{noise.text}"')


def print_table(table: Table) -> None:
    """Prints a table, every cell whole; on a terminal too narrow for its words, a line for each cell."""
    import rich.table  # slow to import, and --help does not need it
    from rich.console import Console
    from rich.measure import Measurement

    drawn = rich.table.Table(*table.headings, title=table.title)
    for row in table.rows:
        drawn.add_row(*map(str, row))
    # Off a terminal rich assumes 80 columns, which would cut the cells.
    width = None if Console().is_terminal else 160
    console = Console(width=width, markup=False, emoji=False, highlight=False)
    wide = console.options.update(max_width=10_000)  # no table is wider
    if Measurement.get(console, wide, drawn).minimum <= console.width:
        console.print(drawn)
    else:
        print(table.title)
        for row in table.rows:
            print()
            for heading, cell in zip(table.headings, row, strict=True):
                print(f"{heading}: {cell}")
    for remark in table.remarks:
        print(remark)
