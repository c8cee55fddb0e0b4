"""The engine of sweeps: Ray, on this machine or on a cluster, with a process for each run."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from hyrl_mj import cores
from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.manifest import Busy
from hyrl_mj.pipeline.runs import RunOptions, run
from hyrl_mj.sweeps import STOPPED, Row

# Seconds within which an address must answer, and for which a killed process may keep a run directory.
PATIENCE, HELD = 8.0, 30.0
# How often the process of a run may die before the run is given up.
DEATHS = 20
POLL = 0.25  # [s]
# Receives a line about a run: its row, and the text.
Tell = Callable[[Row, str], None]


def make(row: Row, options: RunOptions, share: int, journal: Any = None) -> Row:
    """Does a run with a share of the cores, and returns its row; errors end up in the row."""
    began = time.monotonic()
    cores.allowed = share

    def say(text: str) -> None:
        if journal is not None:
            journal.add.remote(row.name, text)

    say("begins")
    try:
        finished = row.finished(_patient_run(row, options, say))
    except HyrlError as error:
        finished = replace(row, state=STOPPED, sentence=str(error))
    except Exception as error:  # a run that fails does not stop the others
        finished = replace(row, state=STOPPED, sentence=brief(error))
    return replace(finished, seconds=row.seconds + time.monotonic() - began)


def _patient_run(row: Row, options: RunOptions, say: Callable[[str], None]) -> Any:
    """Runs, as soon as a process that was killed has let go of the run directory."""
    until = time.monotonic() + HELD
    while True:
        try:
            return run(row.setting.task, options, say=say)
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
    jobs: Sequence[tuple[Row, RunOptions]],
    address: str | None,
    share: int | None,
    memory: float,
    tell: Tell,
) -> Iterator[Row]:
    """Does runs side by side, and yields the row of each when it ends.

    Args:
        jobs: rows, and the options of their runs.
        address: of a Ray cluster; None for this machine.
        share: cores of each run; by default the cores of the machine divided by the runs.
        memory: of each run [GB].
        tell: receives what runs say.

    Raises:
        BadInput: Ray is missing, the cluster does not answer, or no machine of it is large enough.
    """
    with _started(address) as ray:
        largest = max(node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"])
        share = share or max(int(largest) // len(jobs), 1)
        _check_room(ray, share, memory)
        journal = ray.remote(Journal).options(num_cpus=0).remote()
        remote = ray.remote(make).options(
            num_cpus=share, memory=int(memory * 2**30), max_retries=DEATHS
        )
        rows = {row.name: row for row, _ in jobs}
        pending = {remote.remote(row, options, share, journal): row for row, options in jobs}
        while pending:
            done, _ = ray.wait([*pending], num_returns=len(pending), timeout=POLL)
            for name, text in ray.get(journal.take.remote()):
                tell(rows[name], text)
            for reference in done:
                row = pending.pop(reference)
                try:
                    yield ray.get(reference)
                except ray.exceptions.RayError as error:
                    sentence = f"its process died {DEATHS + 1} times ({brief(error)})"
                    yield replace(row, state=STOPPED, sentence=sentence)


def imported(alone: bool) -> Any:
    """Returns Ray, which then reports nothing to its makers.

    Args:
        alone: whether it is to work on this machine alone.

    Raises:
        BadInput: Ray is not installed.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if (
        alone
    ):  # read when Ray is imported: on every system it then listens on the loopback interface
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    # The core that a run asks for is a share of the machine, also where there is no GPU.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError as error:
        raise BadInput(
            'sweep needs Ray, which is not installed: pip install "hyrl-mj[sweep]"'
        ) from error
    return ray


@contextmanager
def _started(address: str | None) -> Iterator[Any]:
    """Starts Ray on this machine, or connects to a cluster, and ends it after the block."""
    ray = imported(alone=address is None)
    if ray.is_initialized():  # by the user, who ends it as well
        yield ray
        return
    quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    if address is None:
        ray.init(
            "local",
            num_cpus=cores.count(),
            include_dashboard=False,
            object_store_memory=100 * 2**20,
            **quiet,
        )
        if (host := ray.util.get_node_ip_address()) not in ("127.0.0.1", "::1"):
            ray.shutdown()
            raise BadInput(
                f"Ray was imported before this sweep and would listen on {host}, where others can reach it: "
                "import it later, or start it yourself with ray.init()"
            )
    else:
        _check_address(address)
        try:
            ray.init(address, **quiet)
        except Exception as error:  # Ray has many
            raise _no_answer(address, brief(error)) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_address(address: str) -> None:
    """Raises `BadInput` if no Ray cluster answers there within `PATIENCE`; Ray itself waits for minutes."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit()):
        raise BadInput(f"the address {address!r} cannot be used: give HOST:PORT, as 10.0.0.1:6379")
    began = time.monotonic()
    try:
        socket.create_connection((host, int(port)), timeout=PATIENCE / 2).close()
    except (OSError, OverflowError) as error:
        raise _no_answer(address, brief(error)) from error
    words = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        left = PATIENCE - (time.monotonic() - began)
        healthy = (
            subprocess.run(words, capture_output=True, timeout=left, check=False).returncode == 0
        )
    except subprocess.TimeoutExpired:
        healthy = False
    if not healthy:
        raise _no_answer(address, "what listens there is no Ray cluster")


def _no_answer(address: str, why: str) -> BadInput:
    return BadInput(
        f"no Ray cluster answers at {address} ({why}): start one there with ray start --head, or leave "
        "--address out to use this machine"
    )


def _check_room(ray: Any, share: int, memory: float) -> None:
    """Raises `BadInput` if no machine has room for a run, which would then wait for ever."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(n.get("CPU", 0) >= share and n.get("memory", 0) >= memory * 2**30 for n in nodes):
        return
    found = "; ".join(
        f"{n.get('CPU', 0):g} cores, {n.get('memory', 0) / 2**30:.1f} GB" for n in nodes
    )
    raise BadInput(
        f"no machine has {share} cores and {memory:g} GB free for a run (there are {found}): give fewer "
        "--cores or less --memory"
    )
