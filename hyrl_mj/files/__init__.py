"""Files that are read and written, what a run directory may hold, and what of it is trusted.

Every file is written under a temporary name and renamed, and nothing that is read is a pickle.
"""

__all__ = ["archives", "artifacts", "logs", "manifest", "sources", "trust"]
