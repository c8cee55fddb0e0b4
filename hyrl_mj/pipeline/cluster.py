"""The engine of sweeps: Ray, on this machine or on a cluster, with a process for each run."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.files.manifest import Busy
from hyrl_mj.pipeline.runs import RunOptions, run
from hyrl_mj.runs.sweeps import Row
from hyrl_mj.system import cores
from hyrl_mj.system.gl import spare_matplotlib

PATIENCE = 7.0  # seconds within which an address must answer
# How often the process of a run may die before the run is given up.
DEATHS = 20
GB = 10**9
# Receives a line about a run: its row, and the text.
Tell = Callable[[Row, str], None]


def make(row: Row, options: RunOptions, share: int, journal: Any = None, folder: str = "") -> Row:
    """Does a run with a share of the cores; returns its row with the time that it took, or its error.

    `folder` is where the user gave the command, if that is on this machine.
    """
    began = time.monotonic()
    if folder and os.path.isdir(folder):
        os.chdir(folder)
    spare_matplotlib()
    cores.allowed = share

    def say(text: str) -> None:
        if journal is not None:
            journal.add.remote(row.name, text)

    say("begins")
    try:
        _patient_run(row, options, say)
    except HyrlError as error:
        row = row.stopped(str(error))
    except Exception as error:  # a run that fails does not stop the others
        row = row.stopped(brief(error))
    return replace(row, seconds=row.seconds + time.monotonic() - began)


def _patient_run(row: Row, options: RunOptions, say: Callable[[str], None]) -> None:
    """Runs, as soon as a process that was killed has let go of the run directory."""
    until = time.monotonic() + 30.0
    while True:
        try:
            run(row.setting.task, options, say=say)
            return
        except Busy:
            if time.monotonic() > until:
                raise
            time.sleep(0.5)


class Journal:
    """What runs say, kept in a process of its own until it is asked for."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    def add(self, name: str, text: str) -> None:
        """Keeps a line about the run of this name."""
        self.lines.append((name, text))

    def take(self) -> list[tuple[str, str]]:
        """Returns what was said since it was asked for last."""
        lines, self.lines = self.lines, []
        return lines


def work(
    ray: Any, jobs: Sequence[tuple[Row, RunOptions]], share: int, memory: float, tell: Tell
) -> Generator[Row, None, None]:
    """Does runs side by side, and yields the row of each when it ends.

    Args:
        ray: see `started`.
        jobs: rows, and the options of their runs.
        share: cores of each run.
        memory: of each run [GB].
        tell: receives what runs say.
    """
    journal = ray.remote(Journal).options(num_cpus=0, max_restarts=-1, max_task_retries=-1).remote()
    remote = ray.remote(make).options(num_cpus=share, memory=int(memory * GB), max_retries=DEATHS)
    rows = {row.name: row for row, _ in jobs}
    here = os.getcwd()
    pending = {remote.remote(row, options, share, journal, here): row for row, options in jobs}
    try:
        while pending:
            done, _ = ray.wait([*pending], num_returns=len(pending), timeout=0.25)
            for name, text in ray.get(journal.take.remote()):
                tell(rows[name], text)
            for reference in done:
                row = pending.pop(reference)
                try:
                    yield ray.get(reference)
                except ray.exceptions.WorkerCrashedError:
                    yield row.stopped(f"its process died {DEATHS + 1} times")
                except ray.exceptions.RayError as error:
                    yield row.stopped(brief(getattr(error, "cause", None) or error))
    except ray.exceptions.RayError as error:  # from the journal
        raise BadInput(
            f"the machines of the cluster do not work ({brief(error)}): give them the same versions of "
            "Python, Ray and hyrl_mj"
        ) from error
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)


@contextmanager
def started(address: str | None) -> Iterator[Any]:
    """Yields Ray, started on this machine or connected to a cluster, and ends it after the block.

    Ray reports nothing to its makers. On one machine it listens on the loopback interface alone.

    Raises:
        BadInput: Ray is not installed, cannot start, or does not answer at the address.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    # Without it Ray warns about GPUs, which runs do not use.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if address is None:  # read when Ray is imported: it then listens on the loopback interface
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    try:
        import ray
    except ImportError as error:
        raise BadInput(
            'sweep needs Ray, which is not installed: pip install "hyrl-mj[sweep]"'
        ) from error
    if ray.is_initialized():  # by the user, who ends it as well
        if address is not None:
            raise BadInput(
                f"Ray is at work in this process, so it cannot use {address}: leave the address out, or "
                "call ray.shutdown() first"
            )
        yield ray
        return
    try:
        _start(ray, address)
        yield ray
    finally:
        ray.shutdown()


def _start(ray: Any, address: str | None) -> None:
    """Starts Ray on this machine, or connects to a cluster."""
    quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    if address is not None:
        _check_address(address)
    else:
        quiet |= {"num_cpus": cores.count(), "include_dashboard": False}
        quiet |= {"object_store_memory": 100 * 2**20}
    here = os.getcwd()
    try:
        # Ray's processes begin where this one is, and import what lies there before all that is installed.
        os.chdir(os.path.abspath(os.sep))
        ray.init(address or "local", **quiet)
    except Exception as error:  # Ray has many
        if address is not None:
            raise _no_answer(address, brief(error)) from error
        raise BadInput(
            f"Ray cannot start on this machine ({brief(error)}): see to it that there is room in "
            "the folder for temporary files, or make the runs one by one with hyrl-mj run"
        ) from error
    finally:
        os.chdir(here)
    host = ray.util.get_node_ip_address()
    if address is None and host not in ("127.0.0.1", "::1"):
        raise BadInput(
            f"Ray was imported before this sweep and would listen on {host}, where others can reach it: "
            "import it later, or start it yourself with ray.init()"
        )


def _check_address(address: str) -> None:
    """Raises `BadInput` if no Ray cluster answers there within `PATIENCE`; Ray itself waits for minutes."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 2**16):
        raise BadInput(
            f"the address {address!r} cannot be used: give HOST:PORT with a port from 1 to 65535, as "
            "10.0.0.1:6379"
        )
    began = time.monotonic()
    try:
        socket.create_connection((host, int(port)), timeout=PATIENCE / 2).close()
    except (OSError, OverflowError, ValueError) as error:
        raise _no_answer(address, brief(error)) from error
    # Whether the versions are the same is said when Ray connects.
    words = [sys.executable, "-P", "-m", "ray.scripts.scripts"]
    words += ["health-check", "--address", address]
    try:
        left = PATIENCE - (time.monotonic() - began)
        subprocess.run(
            [*words, "--skip-version-check"], capture_output=True, timeout=left, check=True
        )
    except subprocess.TimeoutExpired:
        raise _no_answer(address, f"it does not answer within {PATIENCE:g} s") from None
    except subprocess.CalledProcessError:
        raise _no_answer(address, "what listens there is no Ray cluster") from None


def _no_answer(address: str, why: str) -> BadInput:
    return BadInput(
        f"no Ray cluster answers at {address} ({why}): start one there with ray start --head, or leave "
        "--address out to use this machine"
    )


def share(ray: Any, runs: int, wanted: int | None, memory: float) -> int:
    """Returns the cores of each run: those that are wanted, by default all cores divided by the runs.

    Raises:
        BadInput: no machine has room for a run with so many cores and so much memory [GB].
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    counts = [int(node.get("CPU", 0)) for node in nodes]
    number = wanted or max(min(max(counts), sum(counts) // runs), 1)
    if any(n.get("CPU", 0) >= number and n.get("memory", 0) >= memory * GB for n in nodes):
        return number
    found = "; ".join(f"{n.get('CPU', 0):g} and {n.get('memory', 0) / GB:.1f} GB" for n in nodes)
    raise BadInput(
        f"no machine has {number} {'cores' if number > 1 else 'core'} and {memory:g} GB free for a run "
        f"(there are {found}): give fewer --cores or less --memory"
    )
