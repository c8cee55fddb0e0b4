"""What people would do instead of HyRL, a file for each family: `hyrl-mj compare` plays them beside it.

A new alternative is one file in this folder, or anywhere, with a class that `register` decorates.
"""

from importlib import import_module
from pkgutil import iter_modules

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, Unfit, register, registered

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = ["Alternative", "Candidate", "Given", "Unfit", "register", "registered"]
