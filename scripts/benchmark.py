"""Speed as ratios: two ways of doing the same thing, timed alternately in one run.

    python scripts/benchmark.py             # median, least and greatest ratio of 7 pairs each
    python scripts/benchmark.py --quick     # of 3
    python scripts/benchmark.py --json benchmark.json --only replay

It measures and asserts nothing. Leave the machine alone while it runs.
"""

import argparse
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from copy import copy
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import hyrl_mj
from hyrl_mj import artifacts
from hyrl_mj.replay import Show, render_replay

# Seconds that one half of a pair takes at least.
LEAST = 2.0


@dataclass(frozen=True)
class Measured:
    """One figure: units of work a second of ours and of the other way, and their ratio in each pair."""

    name: str
    unit: str
    against: str
    target: str
    ours: float
    other: float
    ratios: list[float]


@dataclass(frozen=True)
class Figure:
    """What is compared: each function does some work and returns how many units it was."""

    name: str
    unit: str
    against: str
    target: str
    ours: Callable[[], int]
    other: Callable[[], int]

    def measure(self, pairs: int) -> Measured:
        """Time both, alternately."""
        rates = np.array([[_rate(self.ours), _rate(self.other)] for _ in range(pairs)])
        ours, other = np.median(rates, axis=0)
        ratios = (rates[:, 0] / rates[:, 1]).tolist()
        texts = (self.name, self.unit, self.against, self.target)
        return Measured(*texts, float(ours), float(other), ratios)


def _rate(work: Callable[[], int]) -> float:
    """Units a second."""
    began, units = time.perf_counter(), 0
    while True:
        units += work()
        took = time.perf_counter() - began
        if took >= LEAST:
            return units / took


class _GoStraight:
    """Past the pillar on the left."""

    def act(self, measured: np.ndarray) -> np.ndarray:
        return np.where(measured[:, :1] < 1.0, 1.0, 0.0)


def replay_figures(folder: Path) -> Iterator[Figure]:
    """Frames of the vehicle's replay, encoded, against MuJoCo's own renderer with its default quality."""
    task = hyrl_mj.get_task("vehicle")
    noise = hyrl_mj.Noise("alternating", 0.1)
    arc = hyrl_mj.simulate(task, _GoStraight(), [0.0, 0.0], noise=noise)
    seconds = 4  # three of driving and one of the last frame

    for size, fps, camera in (
        ((640, 480), 60, "overhead"),
        ((1280, 720), 25, "overhead"),
        ((640, 480), 60, "chase"),
    ):

        def ours(size=size, fps=fps, camera=camera) -> int:
            show = Show([arc], [arc])
            render_replay(task, [show], folder / "r.mp4", size=size, fps=fps, camera=camera)
            return seconds * fps + 1

        def plain(size=size, fps=fps, camera=camera) -> int:
            model = _default_quality(task.model, *size)
            data, frames = mujoco.MjData(model), seconds * fps + 1
            with closing(mujoco.Renderer(model, size[1], size[0])) as renderer:
                for k in range(frames):
                    data.qpos[:] = arc.z[k % len(arc.z)]
                    mujoco.mj_forward(model, data)
                    renderer.update_scene(data, camera)
                    renderer.render()
            return frames

        name = f"replay, {camera}, {size[0]} x {size[1]}"
        target = f">= {fps} frames/s" + (", 6x" if camera == "overhead" else "")
        yield Figure(name, "frames/s", "mujoco.Renderer, default quality", target, ours, plain)


def _default_quality(model: mujoco.MjModel, width: int, height: int) -> mujoco.MjModel:
    """A copy of a model with shadows and the other settings of a plain MJCF."""
    plain, default = copy(model), mujoco.MjSpec().compile()
    for name in ("shadowsize", "offsamples", "numslices", "numstacks", "numquads"):
        setattr(plain.vis.quality, name, getattr(default.vis.quality, name))
    plain.vis.global_.offwidth, plain.vis.global_.offheight = width, height
    plain.light_castshadow[:] = 1
    return plain


GROUPS: dict[str, Callable[[Path], Iterator[Figure]]] = {"replay": replay_figures}


def table(results: list[Measured]) -> Table:
    """The results for people."""
    found = Table(
        title=f"{platform.processor() or platform.machine()}, {platform.python_version()}"
    )
    for heading in ("figure", "ours", "other", "ratio (least - greatest)", "target"):
        found.add_column(heading)
    for r in results:
        ratio = f"{np.median(r.ratios):.1f} ({min(r.ratios):.1f} - {max(r.ratios):.1f})"
        numbers = f"{r.ours:.4g} {r.unit}", f"{r.other:.4g}: {r.against}"
        found.add_row(r.name, *numbers, ratio, r.target)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="3 pairs of each figure, not 7")
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--json", type=Path, help="also write the results here")
    options = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for group in options.only:
            for figure in GROUPS[group](Path(folder)):
                print(f"{figure.name} ...", file=sys.stderr, flush=True)
                results.append(figure.measure(3 if options.quick else 7))
    Console(width=None if sys.stdout.isatty() else 160).print(table(results))
    if options.json:
        content = {"figures": [asdict(result) for result in results]}
        artifacts.write_json(options.json, content, kind="benchmark")


if __name__ == "__main__":
    main()
