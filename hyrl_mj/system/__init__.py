"""What the machine gives: cores, limited processes, generators, streams, progress, pictures, a GL backend."""

__all__ = ["cores", "forked", "generators", "gl", "limits", "picture", "progress", "streams"]
