"""What commands print: the verdict, and the results of a run as tables."""

from __future__ import annotations

from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import LogNoise
from hyrl_mj.viz.tables import (
    Table,
    extent,
    noise_table,
    replay_sentence,
    replay_table,
    robustness_tables,
)


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
    print(f'hyrl-mj run TASK --noise "{noise.text}"')


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
