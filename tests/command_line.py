"""The command line, called in this process: one of its own would import everything again; other code, and who
listens.
"""

import contextlib
import io
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from hyrl_mj.cli import dispatch
from hyrl_mj.system.streams import Streams


class Answer(NamedTuple):
    """What a command has answered: its exit status, and what it wrote to both streams."""

    returncode: int
    stdout: str
    stderr: str


def contents(path):
    """The bytes of all files in a folder, by their paths."""
    return {p: p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def call(*words, cwd="."):
    """Call `hyrl-mj` with these words in a folder."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(Path(cwd)),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        status = Streams().run(lambda: dispatch([*map(str, words)]))
    return Answer(status, out.getvalue(), err.getvalue())


def python(code, *words, **options):
    """Run code in a process of its own, with words in `sys.argv`, and options of `subprocess.run`."""
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=90, check=False, **options
    )


def listening():
    """The address, the port and the inode of each socket to which somebody listens, as Linux writes them."""
    for name in ("tcp", "tcp6"):
        if (table := Path("/proc/net") / name).exists():
            for words in map(str.split, table.read_text().splitlines()[1:]):
                address, port = words[1].split(":")
                if words[3] == "0A":
                    yield address, int(port, 16), words[9]
