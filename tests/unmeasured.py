"""Processes that coverage does not measure: other tests run the same lines, and it takes a quarter more."""

import os


def environment(**more: str) -> dict[str, str]:
    """The environment of such a process."""
    return {k: v for k, v in os.environ.items() if not k.startswith("COVERAGE")} | more
