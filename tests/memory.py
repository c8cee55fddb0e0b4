"""How much memory a part of a test needs, whatever the tests before it needed."""

from pathlib import Path

import pytest


class Peak:
    """The most that this process had in memory within the context, above what it had at its start [MB]."""

    def __enter__(self) -> "Peak":
        if not Path("/proc/self/clear_refs").exists():
            pytest.skip("only Linux lets a process begin the count of its peak anew")
        self.before = now("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")
        return self

    def __exit__(self, *error) -> None:
        self.megabytes = now("VmHWM") - self.before


def now(name: str) -> float:
    """What Linux says of the memory of this process under a name, as VmRSS [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))
