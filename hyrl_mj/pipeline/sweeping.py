"""Sweeps: runs over tasks, algorithms, noise bounds and seeds, each in a run directory of its own."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Self

from hyrl_mj.errors import BadInput
from hyrl_mj.files.manifest import locked
from hyrl_mj.pipeline import cluster
from hyrl_mj.pipeline.runs import (
    BOUND,
    RunOptions,
    checked_bounds,
    checked_seeds,
    complete,
    setting_values,
    settings_of,
    several,
    usable_task,
)
from hyrl_mj.ranges import By, Checked, Integer, Number, Optional
from hyrl_mj.runs import sweeps
from hyrl_mj.runs.sweeps import Common, Row, Setting, Sweep
from hyrl_mj.system.progress import Say
from hyrl_mj.tasks import reference


@dataclass(frozen=True)
class SweepOptions(Checked):
    """The options of a sweep: a run is made for each combination of algorithm, noise bound and seed.

    Attributes:
        seeds: seeds of the runs, as 0-9.
        eps: bounds of the measurement noise to survive, in the units of the chart, as 0.05,0.1,0.2; by
            default 0.1.
        algorithm: the algorithms of stage 1, as dqn,ppo; by default the task's.
        preset: fast, paper or smoke, as for `hyrl-mj run`.
        horizon: time T of the backward propagation [s]; by default as for `hyrl-mj run`.
        all_coordinates: noise on every coordinate of the measurement, not only on the noisy ones of the task.
        set: settings to change in all runs, as stage1.samples=300000; by default none.
        cores: cores of each run; by default the cores of the machine divided by the number of runs, at
            least one.
        memory: memory that each run may need [GB].
        address: a Ray cluster that is running, as 10.0.0.1:6379, whose machines share the folder of the
            sweep; by default this machine.
        out: the folder of the sweep.
    """

    seeds: Annotated[tuple[int, ...], By(checked_seeds)] = (0,)
    eps: Annotated[tuple[float, ...] | None, Optional(By(checked_bounds))] = None
    algorithm: Annotated[tuple[str, ...], By(several)] = ()
    preset: str = "fast"
    horizon: float | None = None
    all_coordinates: bool = False
    set: Annotated[dict[str, Any], By(setting_values)] = field(default_factory=dict)
    cores: Annotated[int | None, Optional(Integer(1, 1_024))] = None
    memory: Annotated[float, Number(0, 10_000, above=True)] = 1.5
    address: str | None = None
    out: str | Path = Path("runs/sweep")

    @property
    def bounds(self) -> tuple[float, ...]:
        """The bounds of the noise."""
        return (BOUND,) if self.eps is None else self.eps


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
    jobs = {row.name: (row, one) for row, one in _jobs(several(tasks), options)}
    folder = Path(options.out)
    common = Common(options.preset, options.horizon, options.set, options.all_coordinates)
    planned = [row for row, _ in jobs.values()]
    result = sweeps.opened(folder, common, planned)
    rows = [row.on_disk(folder, common) for row in result.rows if row.name in jobs]
    missing = [(row, jobs[row.name][1]) for row in rows if not row.done]
    with ExitStack() as stack:
        stack.enter_context(locked(folder))
        result = sweeps.opened(folder, common, planned)  # what others have added meanwhile
        engine = None
        if missing:
            engine = stack.enter_context(cluster.started(options.address))
            share = cluster.share(engine, len(missing), options.cores, options.memory)
        result.save(folder)
        board = stack.enter_context(Board(say, len(rows)))
        for row in rows:
            if row.done:
                result = result.with_row(row)
                board.end(row, "done before: ")
        if engine is not None:
            memory = options.memory
            with closing(cluster.work(engine, missing, share, memory, board.tell)) as ended:
                for row in ended:
                    row = row if row.state == "stopped" else _seen(row, folder, common)
                    result = result.with_row(row)
                    result.save(folder)
                    board.end(row)
        result = result.on_disk(folder)  # of the other runs, too
        write(result, folder)
    return result


def report(folder: str | Path) -> Sweep:
    """Makes `sweep.csv` and `sweep.html` again from the run directories in the folder of a sweep.

    Raises:
        BadArtifact: the folder holds no sweep, or a link.
        BadInput: a sweep is at work there.
    """
    folder = Path(folder)
    Sweep.load(folder)
    with locked(folder):
        result = Sweep.load(folder).on_disk(folder)
        write(result, folder)
    return result


def write(result: Sweep, folder: Path) -> None:
    """Writes `sweep.json`, `sweep.csv` and `sweep.html`."""
    from hyrl_mj.viz.sweep_page import write_page

    result.save(folder)
    result.write_csv(folder)
    write_page(result, folder)


def _jobs(names: tuple[str | Path, ...], options: SweepOptions) -> Iterator[tuple[Row, RunOptions]]:
    """Yields an open row and the options of each run; every value is checked before anything is made."""
    for what, values in (("task", names), ("seed", options.seeds), ("eps", options.bounds)):
        if not values:
            raise BadInput(f"a sweep needs at least one {what}: give one or more")
    seen: set[str] = set()
    for name in names:
        task = usable_task(name)
        if task.source is None and type(task).__module__ == "__main__":
            raise BadInput(
                f"the task {task.name} is defined in this session alone, where the processes of a sweep do "
                "not find it: write it into a Python file, and give that"
            )
        if task.sensor and options.eps is None:
            raise BadInput(
                f"{task.name} declares what its sensors do ({task.sensor}), and a sweep is made for bounds "
                "alone: give --eps, and the sensors are left out"
            )
        for algorithm, eps in product(options.algorithm or (None,), options.bounds):
            one = RunOptions(
                eps=eps,
                preset=options.preset,
                algorithm=algorithm,
                horizon=options.horizon,
                all_coordinates=options.all_coordinates,
                set=options.set,
            )
            settings_of(task, one)
            setting = Setting(reference(task), algorithm or "", eps)
            if setting.stem in seen:
                raise BadInput(
                    f"two runs would be called {setting.stem}: give each run once, and task files of "
                    "different names"
                )
            seen.add(setting.stem)
            for seed in options.seeds:
                row = Row(setting, seed)
                yield row, replace(one, seed=seed, out=Path(options.out).resolve() / row.name)


def _seen(row: Row, folder: Path, common: Common) -> Row:
    """Returns the row of a finished run, as this machine sees its run directory."""
    row = row.on_disk(folder, common)
    if row.state == "open":
        return row.stopped(
            f"this machine does not see its results: share {folder} between all machines"
        )
    return row


class Board:
    """Shows the stage and the time of each run: in a log a line for each stage, on a terminal a live one.

    Args:
        say: receives the lines instead.
        count: number of runs.
    """

    def __init__(self, say: Say | None, count: int):
        self._count, self._ended = count, 0
        self._began: dict[str, float] = {}
        self._latest: dict[str, str] = {}
        self._live: Any = None
        self._say: Say = say or partial(print, flush=True)
        if say is None and sys.stdout is not None and sys.stdout.isatty():
            from rich.live import Live

            self._live = Live(get_renderable=self._picture, transient=True, refresh_per_second=2)
            self._say = partial(self._live.console.print, markup=False, highlight=False)

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def tell(self, row: Row, text: str) -> None:
        """Shows what a run says about a stage."""
        began = self._began.setdefault(row.name, time.monotonic())
        self._latest[row.name] = text
        if self._live is None:
            self._say(f"{row.name}: {time.monotonic() - began:.0f} s: {text}")

    def end(self, row: Row, how: str = "") -> None:
        """Shows how a run ended."""
        self._ended += 1
        self._latest.pop(row.name, None)
        end = row.sentence if row.verdict == "" else f"{row.verdict}: {row.sentence}"
        end = end if row.done else f"stopped: {end}"
        self._say(f"{row.name}: {row.seconds:.0f} s: {how}{end} ({self._ended} of {self._count})")

    def _picture(self) -> Any:
        from rich.text import Text

        now = time.monotonic()
        lines = [
            f"{name}: {now - self._began[name]:.0f} s: {text}"
            for name, text in self._latest.items()
        ]
        return Text("\n".join(lines), overflow="ellipsis", no_wrap=True)
