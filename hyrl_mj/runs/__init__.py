"""Run directories: what they hold, the replays and the diagnosis of a run, and many runs in a sweep."""

__all__ = ["arcs", "compared", "diagnosis", "directory", "improvement", "sweeps"]
