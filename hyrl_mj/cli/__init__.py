"""The command line `hyrl-mj`."""

from hyrl_mj.cli.commands import COMMANDS
from hyrl_mj.cli.main import dispatch, main

__all__ = ["COMMANDS", "dispatch", "doctor", "main"]
