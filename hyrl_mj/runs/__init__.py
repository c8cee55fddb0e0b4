"""Run directories: what they hold, the replays of a run, its verdict, and many runs in a sweep."""

__all__ = ["arcs", "directory", "improvement", "sentences", "sweeps", "verdict"]
