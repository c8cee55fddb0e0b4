"""The results of a comparison with what people would do instead, as tables and sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from hyrl_mj.errors import counted
from hyrl_mj.judging.game import percent
from hyrl_mj.runs.compared import Compared, Row
from hyrl_mj.viz.tables import Table, number, print_table, spread, tried

# The figures in the table, with the headings of their columns and the texts of their values.
COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "worst": ("won under attack", tried),
    "won": ("won in the game", tried),
    "proved": ("proved", percent),
    "lost_quiet": ("lost without noise", percent),
    "late": ("late", percent),
    "miss": ("off the set-point", number),
    "variation": ("variation of inputs [1/s]", number),
}
BRIEF = ("worst", "won", "lost_quiet", "late")


def ranked(compared: Compared) -> list[str]:
    """Returns the names of the alternatives that have results, the best first; HyRL follows its equals."""
    done = sorted((n for n in compared.names if compared.of(n)), key=lambda name: name == "hyrl")
    return sorted(done, key=lambda name: [-_middle(compared, name, f) for f in ("worst", "won")])


def _middle(compared: Compared, name: str, figure: str) -> float:
    """Returns the mean of a figure over the seeds, -1 if there is none.

    An alternative that lacks seeds may lack those that are hard: it is as far from HyRL as in the seeds that
    both have.
    """
    own, hyrl = (
        {row.seed: row.figures[figure] for row in compared.of(n) if figure in row.figures}
        for n in (name, "hyrl")
    )
    both = own.keys() & hyrl.keys()
    if not both:
        return float(np.mean([*own.values()])) if own else -1.0
    apart = np.mean([own[seed] - hyrl[seed] for seed in both])
    return round(float(apart + np.mean([*hyrl.values()])), 12)


def result_table(compared: Compared, brief: bool = False) -> Table:
    """Returns the results: a row for each alternative, the best first; means and ranges over the seeds.

    A brief one, for terminals, holds what decides alone.
    """
    rows, seeds = [], {row.seed for row in compared.rows}
    for name in ranked(compared):
        of = compared.of(name)
        row = {"alternative": of[0].title}
        if len(of) < len(seeds):
            row["alternative"] += f", {len(of)} of {counted(len(seeds), 'seed')}"
        if not brief:
            row["setting"] = _settings(of)
        for figure, (heading, show) in COLUMNS.items():
            if (figure != "late" or compared.lasting) and (figure in BRIEF or not brief):
                row[heading] = spread(compared.values(name, figure), np.mean, show, len(of), "seed")
        if not brief:
            row["samples trained"] = f"{np.mean([r.samples for r in of]):,.0f}"
            row["seconds"] = f"{np.mean([r.seconds for r in of]):.0f}"
        rows.append(row)
    title = f"{compared.task}: what would do instead, noise {compared.eps:g}"
    return Table.of(title, rows, "Means over the seeds (least to greatest where they differ).")


def _settings(rows: list[Row]) -> str:
    """Returns the settings that were taken, the most frequent first."""
    taken = [row.sentence for row in rows]
    return "; ".join(sorted(dict.fromkeys(taken), key=taken.count, reverse=True))


def tried_table(compared: Compared) -> Table | None:
    """Returns by which share of starts each setting was chosen; None if there was nothing to choose."""
    rows = []
    for name in ranked(compared):
        of = [row for row in compared.of(name) if row.tried]
        for label in dict.fromkeys(label for row in of for label in row.tried):
            won = [row.tried[label] for row in of if label in row.tried]
            chosen = sum(row.sentence == label for row in of)
            taken = f"{chosen} of {len(won)}"
            rows.append([of[0].title, label, spread(won, np.mean, tried), taken])
    headings = ("alternative", "setting", "won when it was chosen", "taken, seeds")
    note = (
        "The share of the winnable starts that each setting wins in the game, or of other starts under a "
        "short attack: the best setting is taken."
    )
    title = f"{compared.task}: settings that were tried"
    return Table(title, headings, rows, note) if rows else None


def sentences(compared: Compared) -> Iterator[str]:
    """Yields how HyRL compares with the best alternative, and which ones could not be compared."""
    others = [n for n in ranked(compared) if n not in ("hyrl", "policy")]
    best = others[0] if others else "hyrl"
    mean, both = compared.difference(best), compared.both(best)
    if others and len(both):
        title = compared.of(best)[0].title
        wins, hyrl = (f"{100 * share:.2f}%" for share in both.mean(axis=0)[:2])
        between, count = "", len({row.seed for row in compared.rows})
        seeds = f", in {len(both)} of {count} seeds" if len(both) < count else ""
        if mean.interval is not None and np.ptp(mean.interval):
            low, high = (f"{100 * end:+.2f}" for end in mean.interval)
            between = f" (95% interval {low} to {high})"
        word = "as many"
        if abs(mean.value) > 1e-9:
            more = "more" if mean.value > 0 else "less"
            word = f"{100 * abs(mean.value):.2f} percentage points {more}"
        yield (
            f"The best alternative is {title}, which wins from {wins} of the starts under attack; HyRL wins "
            f"from {hyrl}, {word}{between}{seeds}."
        )
    for row in compared.rows:
        if row.state == "unfit":
            yield f"{row.title}, seed {row.seed}: {row.sentence}."


def print_compared(compared: Compared) -> None:
    """Prints the results."""
    print_table(result_table(compared, brief=True))
    for sentence in sentences(compared):
        print(sentence)
