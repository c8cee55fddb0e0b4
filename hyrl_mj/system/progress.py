"""Progress on standard error: bars for all that may take longer than a second; in a file, lines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import Any, Literal

# Receives each line of text that a person may read while work goes on.
Say = Callable[[str], None]
# How progress is shown. Set by the command line; as a library the package is silent.
shown: Literal["", "bars", "lines"] = ""
# How often a line is written [s], where there is no terminal to draw a bar on.
EVERY = 30.0


def progress_bar(
    work: Iterable[Any] | None, label: str, unit: str, total: int | None = None, quiet: bool = False
) -> Any:
    """Returns a tqdm bar over the work, which appears once the work has lasted half a second.

    Without an iterable, the caller updates and closes the bar, and `total` is the number of units of work.
    """
    from tqdm import tqdm  # slow to import

    if shown == "lines":

        class Lines(tqdm):
            """Writes a line where others draw a bar."""

            monitor_interval = 0  # no thread that draws what has not changed

            def display(self, msg: str | None = None, pos: int | None = None) -> None:
                if msg is None:
                    print(self, file=sys.stderr, flush=True)

            def close(self) -> None:
                self.disable = True

        known = total is not None or hasattr(work, "__len__")
        return Lines(
            work, label, total, unit=f" {unit}", unit_scale=True, delay=EVERY, mininterval=EVERY,
            maxinterval=EVERY, disable=quiet,
            bar_format="{desc}: {n_fmt}" + " of {total_fmt}" * known + "{unit} in {elapsed}",
        )  # fmt: skip
    return tqdm(
        work, label, total, unit=f" {unit}", unit_scale=True, delay=0.5, leave=False,
        dynamic_ncols=True, disable=quiet or not shown,
    )  # fmt: skip
