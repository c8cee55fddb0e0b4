"""The results of a sweep as tables, for its page and the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from hyrl_mj.judging.game import percent
from hyrl_mj.runs.improvement import COMPARED, Mean, improvements
from hyrl_mj.runs.sweeps import Row, Sweep
from hyrl_mj.simulation import KINDS
from hyrl_mj.viz.tables import NAMES, Table, number, print_table, spread, tried


@dataclass(frozen=True)
class Column:
    """A figure of `Row.figures`.

    Attributes:
        heading: of the column.
        show: returns the text of a value.
        least: whether the worst run has the least value; None for a figure that says nothing of it.
    """

    heading: str
    show: Callable[[float], str]
    least: bool | None = None


# Figures that both controllers have: the heading, what that of HyRL ends with, and the text of a value.
FIGURES: dict[str, tuple[str, str, Callable[[float], str]]] = {
    "proved": ("proved", ", own q0", percent),
    "not_broken": ("not broken", ", own q0", tried),
    "margin": ("margin", "", number),
    **{
        f"reached_{kind}": (f"arrives, {'no' if kind == 'none' else kind} noise", "", percent)
        for kind in KINDS
    },
    "withstood_attack": ("not lost under attack", "", tried),
    "lost_without_noise": ("lost without noise", "", percent),
    "late": ("late", "", percent),
    "longest": ("time relative to that without noise, 99%", "", number),
}


def _both(*names: str) -> dict[str, Column]:
    """Returns the columns of figures that both controllers have."""
    columns = {}
    for name in names:
        heading, own, show = FIGURES[name]
        columns[f"policy_{name}"] = Column(f"{NAMES['policy']} {heading}", show)
        least = COMPARED.get(name, False)
        columns[f"hyrl_{name}"] = Column(f"{NAMES['hyrl']} {heading}{own}", show, least)
    return columns


# The figures in tables, the most important first: by these the worst run is found.
COLUMNS = {
    "open": Column("open starts", percent),
    "winnable": Column("winnable starts", percent),
    **_both("proved", "not_broken"),
    "hyrl_proved_any": Column("HyRL proved, any q0", percent, True),
    "hyrl_not_broken_any": Column("HyRL not broken, any q0", tried, True),
    "limit_won_any": Column("limit, any q0", percent),
    **_both("margin"),
    "hyrl_proved_time": Column("latest arrival proved, own q0", "{:.2f} s".format),
    "hyrl_proved_time_any": Column("latest arrival proved, any q0", "{:.2f} s".format, False),
    "hyrl_excursion": Column("excursion", number),  # which is missing where each run ends
    "hyrl_miss_without_noise": Column("HyRL off the set-point, no noise", number, False),
    **_both(*list(FIGURES)[3:]),
}


def shown(rows: Iterable[Row]) -> list[str]:
    """Returns the names of the figures that some row has."""
    there = {name for row in rows for name, value in row.figures.items() if value is not None}
    return [name for name in COLUMNS if name in there]


def summary_table(sweep: Sweep) -> Table:
    """Returns median, least and greatest of each figure over the seeds: a column for each setting."""
    groups = sweep.groups()
    done = {setting: [row for row in rows if row.done] for setting, rows in groups.items()}
    rows = [
        ["runs", *(f"{len(done[setting])} of {len(group)}" for setting, group in groups.items())],
        ["verdicts", *(_verdicts(group) for group in done.values())],
    ]
    for name in shown(sweep.rows):
        cells = [COLUMNS[name].heading]
        for group in done.values():
            known = [v for row in group if (v := row.figures.get(name)) is not None]
            cells.append(spread(known, np.median, COLUMNS[name].show, len(group), "run"))
        rows.append(cells)
    title = "median over the seeds (least to greatest where they differ)"
    return Table(title, ["figure", *(setting.title for setting in groups)], rows)


def improvement_table(sweep: Sweep) -> Table | None:
    """Returns what HyRL improves over all runs that are done; None if nothing can be compared."""
    found = improvements(sweep.rows)
    if not found:
        return None
    rows = []
    for one in found:
        heading, own, show = FIGURES[one.figure]
        signed = (lambda v: f"{v:+.3g}") if show is number else (lambda v: f"{100 * v:+.2f}%")
        row = {
            "figure": heading + own,
            "runs": f"{one.runs}",
            "RL policy": _with_interval(one.policy, show),
            "HyRL": _with_interval(one.hyrl, show),
            "difference": _with_interval(one.difference, signed),
            "probability of improvement": f"{one.better:.2f}",
        }
        rows.append(row)
    title = "HyRL against the RL policy: means, 95% intervals (bootstrap over seeds and starts)"
    note = (
        "Over the seeds and settings; there are intervals where a setting has at least three seeds. The "
        "probability is that a run of HyRL is better than one of the policy."
    )
    return Table.of(title, rows, note)


def _with_interval(mean: Mean, show: Callable[[float], str]) -> str:
    if mean.interval is None:
        return show(mean.value)
    return f"{show(mean.value)} ({' to '.join(map(show, mean.interval))})"


def _verdicts(group: list[Row]) -> str:
    """Returns how often each verdict was given."""
    verdicts = [row.verdict for row in group]
    return ", ".join(f"{verdicts.count(word)} {word}" for word in sorted({*verdicts})) or "-"


def run_table(group: Iterable[Row]) -> Table:
    """Returns the figures of each run of a setting."""
    group, rows = [*group], []
    for row in group:
        cells = {"seed": f"{row.seed}", "verdict": row.verdict or row.state}
        for name in shown(group):
            value, column = row.figures.get(name), COLUMNS[name]
            cells[column.heading] = "-" if value is None else column.show(value)
        rows.append(cells | {"time": f"{row.seconds:.0f} s"})
    return Table.of(group[0].setting.title, rows)


def worst(group: Iterable[Row]) -> Row | None:
    """Returns the run of a setting with the worst figures; None if no run is done."""

    def goodness(row: Row) -> list[float]:
        kept = [(row.figures.get(name), column.least) for name, column in COLUMNS.items()]
        return [
            # No margin means that some start is lost even without noise.
            float("-inf") if value is None else value if least else -value
            for value, least in kept
            if least is not None
        ]

    return min((row for row in group if row.done), key=goodness, default=None)


def print_sweep(sweep: Sweep) -> None:
    """Prints the summary, and the runs that are not done."""
    print_table(summary_table(sweep))
    if (improved := improvement_table(sweep)) is not None:
        print_table(improved)
    for row in sweep.rows:
        if not row.done:
            print(f"{row.name}: {row.state}{f': {row.sentence}' if row.sentence else ''}")
