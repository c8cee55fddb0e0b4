"""The command line `hyrl-mj`: it calls a command, and gives each error a sentence and an exit status."""

from __future__ import annotations

import atexit
import gc
import sys
import textwrap
from collections.abc import Sequence

from hyrl_mj import __version__
from hyrl_mj.cli.commands import COMMANDS
from hyrl_mj.cli.parsing import call, documented
from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.system import progress
from hyrl_mj.system.gl import spare_matplotlib
from hyrl_mj.system.streams import Streams


def overview() -> str:
    """Returns the help of `hyrl-mj`."""
    lines = [
        "usage: hyrl-mj [-h] [--version] COMMAND ...\n",
        "Hysteresis-Based RL on MuJoCo: policies that withstand measurement noise.\n",
        "commands (hyrl-mj COMMAND --help shows the options of one):",
    ]
    for name, command in COMMANDS.items():
        summary = documented(command)[0].partition("\n")[0]
        lines.append(textwrap.fill(f"  {name:15}{summary}", 80, subsequent_indent=" " * 17))
    return "\n".join(lines)


def dispatch(words: Sequence[str]) -> None:
    """Runs the command that the words after `hyrl-mj` name, or raises `BadInput`."""
    match words:
        case ["-h" | "--help", *_]:
            print(overview())
        case ["--version", *_]:
            print(f"hyrl-mj {__version__}")
        case [name, *rest] if name in COMMANDS:
            call(COMMANDS[name], name, rest)
        case [name, *_]:
            raise unknown("command", name, COMMANDS)
        case _:
            raise BadInput(f"give a command, one of {', '.join(COMMANDS)}: see hyrl-mj --help")


def main() -> None:
    """The console script `hyrl-mj`."""
    streams = Streams()
    progress.shown = "bars" if streams.has_room_for_bars else "lines"
    # Python would look for garbage among torch's modules for most of a second before it ends.
    atexit.register(gc.freeze)

    def work() -> None:
        spare_matplotlib()
        dispatch(sys.argv[1:])

    sys.exit(streams.run(work))
