"""The summary that ends a run: tables on the terminal."""

from __future__ import annotations

from hyrl_mj.run_directory import Run
from hyrl_mj.viz.tables import (
    Table,
    episode_table,
    extent,
    margin_table,
    replay_sentence,
    replay_table,
    score_table,
)


def print_summary(run: Run) -> None:
    """Prints the results of policy and hybrid controller in the replays and in the worst case."""
    arcs = run.arcs()
    _print(replay_table(run, arcs))
    print(run.critical_set.sentence(run.task))
    for q in run.extended_sets.modes:
        print(f"mode {run.task.scene.mode_name(q)}: {extent(run, q)}")
    print(replay_sentence(run, arcs))
    print_robustness(run)
    print(f"run directory {run.path}")
    for what, name in (("video", "replay.mp4"), ("report", "report.html")):
        print(f"{what} {run.path / name}" if (run.path / name).is_file() else f"no {what}")


def print_robustness(run: Run) -> None:
    """Prints the scores of the worst-case game and the counts of the noisy episodes."""
    game, episodes = run.robustness.game, run.robustness.episodes
    if game is not None:
        _print(score_table(run.task, game))
        _print(margin_table(run.task, game))
    if episodes:
        _print(episode_table(run.task, episodes))


def _print(table: Table) -> None:
    """Prints a table, every cell whole."""
    import rich.table  # slow to import, and --help does not need it
    from rich.console import Console
    from rich.text import Text

    drawn = rich.table.Table(title=table.title)
    for heading in table.headings:
        drawn.add_column(Text(heading))
    for row in table.rows:
        drawn.add_row(*(Text(str(cell)) for cell in row))
    # Off a terminal rich assumes 80 columns, which would cut the cells.
    console = Console()
    Console(width=None if console.is_terminal else 160).print(drawn)
