"""Speed as ratios: two ways of doing the same thing, timed alternately in one run.

    python scripts/benchmark.py              # median, least and greatest ratio of 5 pairs each
    python scripts/benchmark.py --quick      # one pair each of what takes seconds, on runs of preset smoke
    python scripts/benchmark.py --only replay engine --json benchmark.json

It measures and asserts nothing. Leave the machine alone while it runs.
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # for mujoco.Renderer, before anything imports mujoco

import argparse
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks import Figure, control, engine, learning, replay, runs, stages
from rich.console import Console
from rich.table import Table

from hyrl_mj.files import artifacts

GROUPS: dict[str, Callable[[runs.Runs], Iterator[Figure]]] = {
    "engine": engine.figures,
    "stages": stages.figures,
    "learning": learning.figures,
    "control": control.figures,
    "replay": replay.figures,
    "whole": runs.figures,
}
PAIRS = 5


def machine() -> str:
    """Returns a description of this machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        cpu = platform.processor() or platform.machine()
    return f"{cpu}, {os.cpu_count()} cores, Python {platform.python_version()}"


def table(results: list[dict[str, Any]]) -> Table:
    """Returns the results as a table."""
    headings = ("figure", "ours", "against", "ratio (least - greatest)", "target")
    printed = Table(*headings, title=machine())
    for r in results:
        ours = f"{r['ours']:.4g} {r['unit']}"
        ours += f", {r['memory']:.0f} MB" if r["memory"] else ""
        other, ratio, ratios = "", "", r["ratios"]
        if ratios:
            other = f"{r['other']:.4g} {r['unit']}: {r['against']}"
            ratio = f"{np.median(ratios):.3g} ({min(ratios):.3g} - {max(ratios):.3g})"
        printed.add_row(r["name"], ours, other, ratio, r["target"])
    return printed


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one pair each, no training")
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--runs", type=Path, help="keep the finished runs here, for the next time")
    parser.add_argument("--json", type=Path, help="also write the results here")
    options = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        preset = "smoke" if options.quick and not options.runs else "fast"
        made = runs.Runs(options.runs or Path(folder), preset)
        for group in options.only:
            for figure in GROUPS[group](made):
                if figure.slow and options.quick:
                    continue
                print(f"{figure.name} ...", file=sys.stderr, flush=True)
                results.append(figure.measure(1 if options.quick else PAIRS))
    Console(width=None if sys.stdout.isatty() else 200).print(table(results))
    if options.json:
        content = {"machine": machine(), "figures": results}
        artifacts.write_json(options.json, content, kind="benchmark")


if __name__ == "__main__":
    main()
