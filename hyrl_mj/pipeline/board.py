"""What a person sees while a sweep works: a line for each run."""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import Any, Self

from hyrl_mj.runs.sweeps import Row
from hyrl_mj.system.progress import Say


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
