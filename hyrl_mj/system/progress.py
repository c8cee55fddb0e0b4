"""Progress bars on standard error, for everything that may take longer than a second."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

# Receives each line of text that a person may read while work goes on.
Say = Callable[[str], None]
# Set by the command line; as a library the package is silent.
enabled = False


def progress_bar(
    work: Iterable[Any] | None, label: str, unit: str, total: int | None = None, quiet: bool = False
) -> Any:
    """Returns a tqdm bar over the work, which appears once the work has lasted half a second.

    Without an iterable, the caller updates and closes the bar, and `total` is the number of units of work.
    """
    from tqdm import tqdm  # slow to import

    return tqdm(
        work, label, total, unit=f" {unit}", unit_scale=True, delay=0.5, leave=False,
        dynamic_ncols=True, disable=quiet or not enabled,
    )  # fmt: skip
