"""What the machine gives: cores, processes with limits, generators, output streams and progress bars."""

__all__ = ["cores", "forked", "generators", "limits", "progress", "streams"]
