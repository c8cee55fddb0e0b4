"""Progress bars on standard error, for everything that may take longer than a second."""

from __future__ import annotations

from collections.abc import Callable

# Is told each line of text that a person may read while work goes on.
Say = Callable[[str], None]


class Progress:
    """A bar that appears once the work has lasted half a second.

    Args:
        label: what is being done.
        total: number of units of work.
        unit: what is counted.
    """

    def __init__(self, label: str, total: int, unit: str):
        from tqdm import tqdm  # slow to import

        self._bar = tqdm(
            desc=label,
            total=total,
            unit=f" {unit}",
            unit_scale=True,
            delay=0.5,
            leave=False,
            dynamic_ncols=True,
            disable=not enabled,
        )

    def update(self, done: int) -> None:
        """Say how much is done in all."""
        self._bar.update(min(done, self._bar.total) - self._bar.n)

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()


# Set by the command line; as a library the package is silent.
enabled = False
