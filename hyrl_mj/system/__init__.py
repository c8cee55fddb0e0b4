"""What the machine gives: cores, processes with limits, output streams and progress bars."""

__all__ = ["cores", "forked", "limits", "progress", "streams"]
