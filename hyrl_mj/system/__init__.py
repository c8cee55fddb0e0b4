"""What the machine gives: cores, processes with limits, generators, streams, progress bars, a GL backend."""

__all__ = ["cores", "forked", "generators", "gl", "limits", "progress", "streams"]
