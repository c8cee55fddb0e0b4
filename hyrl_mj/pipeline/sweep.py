"""Sweeps: runs over tasks, algorithms, noise bounds and seeds, each in a run directory of its own."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from hyrl_mj import sweeps
from hyrl_mj.errors import BadInput, check_seed
from hyrl_mj.pipeline import cluster
from hyrl_mj.pipeline.board import Board
from hyrl_mj.pipeline.runs import RunOptions, complete, settings_of
from hyrl_mj.progress import Say
from hyrl_mj.ranges import Integer, Number
from hyrl_mj.sweeps import DONE, Common, Row, Setting, Sweep
from hyrl_mj.tasks import check_task, get_task, reference


@dataclass(frozen=True)
class SweepOptions:
    """The options of a sweep: a run is made for each combination of algorithm, noise bound and seed.

    Attributes:
        seeds: seeds of the runs, as 0-9.
        eps: bounds of the measurement noise to survive, in the units of the chart, as 0.05,0.1,0.2.
        algorithm: the algorithms of stage 1, as dqn,ppo; by default the task's.
        preset: fast, paper or smoke, as for `hyrl-mj run`.
        horizon: time T of the backward propagation [s]; by default as for `hyrl-mj run`.
        set: settings to change in all runs, as stage1.samples=300000; by default none.
        cores: cores of each run; by default the cores of the machine divided by the number of runs, at
            least one.
        memory: memory that each run may need [GB].
        address: a Ray cluster that is running, as 10.0.0.1:6379, whose machines share the folder of the
            sweep; by default this machine.
        out: the folder of the sweep.
    """

    seeds: tuple[int, ...] = (0,)
    eps: tuple[float, ...] = (0.1,)
    algorithm: tuple[str, ...] = ()
    preset: str = "fast"
    horizon: float | None = None
    set: dict[str, Any] = field(default_factory=dict)
    cores: int | None = None
    memory: float = 1.5
    address: str | None = None
    out: str | Path = Path("runs/sweep")


def sweep(
    tasks: str | Path | Iterable[str | Path],
    options: SweepOptions | None = None,
    *,
    say: Say | None = None,
    **changes: Any,
) -> Sweep:
    """Makes many runs side by side, or those that the folder of the sweep lacks, and their tables.

    Args:
        tasks: names of tasks, or the Python files that define them.
        options: the options, by default `SweepOptions()`.
        say: receives a line about each stage of each run; by default they are printed.
        changes: fields of the options to change, as in `sweep("vehicle", seeds=range(10))`.

    Returns:
        The rows of all runs, which `sweep.json`, `sweep.csv` and `sweep.html` in the folder hold as well.

    Raises:
        BadInput: a value that cannot be used, a folder with another sweep, or a cluster that does not answer.
    """
    options = complete(SweepOptions, options, changes)
    names = [tasks] if isinstance(tasks, str | Path) else [*tasks]
    jobs = {row.name: (row, one) for row, one in _jobs(names, options)}
    folder = Path(options.out)
    common = Common(options.preset, options.horizon, json.loads(json.dumps(options.set)))
    result = sweeps.opened(folder, common, (row for row, _ in jobs.values()))
    result.save(folder)
    rows = [row for row in result.rows if row.name in jobs]
    with Board(say, len(rows)) as board:
        missing = []
        for row in rows:
            if (run := sweeps.finished_run(folder / row.name)) is None:
                missing.append((row, jobs[row.name][1]))
            else:
                row = row.finished(run)
                result = result.with_row(row)
                board.end(row, "done before: ")
        if missing:
            ended = cluster.work(
                missing, options.address, options.cores, options.memory, board.tell
            )
            for row in ended:
                result = result.with_row(_on_disk(row, folder))
                result.save(folder)
                board.end(row)
    write(result, folder)
    return result


def report(folder: str | Path) -> Sweep:
    """Makes `sweep.csv` and `sweep.html` again from the run directories in the folder of a sweep.

    Raises:
        BadArtifact: the folder holds no sweep.
    """
    folder = Path(folder)
    result = Sweep.load(folder)
    for row in result.rows:
        run = sweeps.finished_run(folder / row.name)
        if run is not None:
            result = result.with_row(row.finished(run))
        elif row.state == DONE:
            result = result.with_row(Row(row.setting, row.seed, seconds=row.seconds))
    write(result, folder)
    return result


def write(result: Sweep, folder: Path) -> None:
    """Writes `sweep.json`, `sweep.csv` and `sweep.html`."""
    from hyrl_mj.viz.sweep_page import write_page

    result.save(folder)
    result.write_csv(folder)
    write_page(result, folder)


def _jobs(names: list[str | Path], options: SweepOptions) -> Iterator[tuple[Row, RunOptions]]:
    """Yields an open row and the options of each run; every value is checked before anything is made."""
    _check(names, options)
    seen: set[str] = set()
    for name in names:
        task = check_task(get_task(name))
        for algorithm, eps in product(options.algorithm or (None,), options.eps):
            one = RunOptions(
                eps=eps,
                preset=options.preset,
                algorithm=algorithm,
                horizon=options.horizon,
                set=options.set,
            )
            settings_of(task, one)
            setting = Setting(reference(task), algorithm or "", eps)
            if setting.stem in seen:
                raise BadInput(f"{setting.title} is given twice: give each run once")
            seen.add(setting.stem)
            for seed in options.seeds:
                row = Row(setting, seed)
                yield row, replace(one, seed=seed, out=Path(options.out).resolve() / row.name)


def _check(names: list[str | Path], options: SweepOptions) -> None:
    """Raises `BadInput` for values that say nothing, or twice the same."""
    for what, values in (("task", names), ("seed", options.seeds), ("eps", options.eps)):
        if not values:
            raise BadInput(f"a sweep needs at least one {what}: give one or more")
    for seed in options.seeds:
        check_seed(seed)
        if [*options.seeds].count(seed) > 1:
            raise BadInput(f"the seed {seed} is given twice: give each seed once")
    if options.cores is not None:
        Integer(1, 1_024).checked("cores", options.cores)
    Number(0, 10_000, above=True).checked("memory", options.memory)


def _on_disk(row: Row, folder: Path) -> Row:
    """Returns a row, which tells of an error if this machine does not see its run directory."""
    if row.state == DONE and not (folder / row.name).is_dir():
        sentence = f"it was written where this machine does not see it: share {folder} between all machines"
        return replace(Row(row.setting, row.seed), state=sweeps.STOPPED, sentence=sentence)
    return row
