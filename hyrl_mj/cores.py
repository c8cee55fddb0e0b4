"""How many cores this process may use; results do not depend on it."""

import os

# Set where several runs share a machine; 0 for all cores.
allowed = 0


def count() -> int:
    """Returns the number of cores that this process may use."""
    if allowed:
        return allowed
    if hasattr(os, "sched_getaffinity"):  # on Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
