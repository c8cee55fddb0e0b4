"""The finished runs that are attacked, made when they are first asked for."""

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

import hyrl_mj
from attacks import Answer, child, command
from attacks.small import shorten  # noqa: F401
from hyrl_mj.judging import Arrivals, ModeResult, Retraining
from hyrl_mj.learning import preset
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.runs.directory import Run, write_config
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages import ExtendedSets

TASK = "unit_circle"
RUN = ("run", TASK, "--preset", "smoke", "--out", TASK)
# The file beside a finished run that tells how long it took.
SECONDS = "seconds"


@dataclass(frozen=True)
class Material:
    """Runs of preset smoke, which nothing disturbed.

    Attributes:
        folder: where they are.
    """

    folder: Path

    @cache  # noqa: B019 - there is one material
    def finished(self, *options: str) -> Path:
        """Returns the run directory of `hyrl-mj run` with these options."""
        path = self.folder / "_".join(("material", *options)).replace("-", "")
        path.mkdir()
        (answer,) = self.do(path, [(*RUN, *options)])
        (path / SECONDS).write_text(f"{answer.seconds[0]}", encoding="utf-8")
        return path / TASK

    @cache  # noqa: B019 - there is one material
    def field(self) -> Path:
        """Returns a run directory of `field` whose policies, which are not trained, drive straight on."""
        path = self.folder / "material_field" / "field"
        task = hyrl_mj.get_task("field")
        levels, observed = task.input_levels, len(task.observation_low)
        weights = {
            "action_net.weight": np.zeros((len(levels), observed), dtype=np.float32),
            "action_net.bias": np.all(levels == [1.0, 0.0], axis=1).astype(np.float32),
        }
        ahead = MlpPolicy(task, "ppo", "tanh", weights)
        run = Run(path, preset(task, "smoke"))
        write_config(run)
        with run.manifest.stage("train"):
            ahead.save(path / "policy.safetensors")
            Arrivals(990, 0, 1_000, trainings=1).save(path / "arrivals.json")
        with run.manifest.stage("extended-sets"):
            grid = Grid.with_cells(task.chart, 4)
            inside = np.ones(len(grid.nodes), dtype=bool)
            sets = (GridSet(grid, -np.ones(len(grid.nodes))),) * 2
            ends = np.empty((0, task.chart.dimension)), np.empty(0)
            ExtendedSets((0, 1), sets, (inside, inside), 0.3, 0.1, *ends).save(
                path / "extended_sets.npz"
            )
        with run.manifest.stage("retrain"):
            for mode in (0, 1):
                ahead.save(path / f"mode_{mode}.safetensors")
            Retraining((ModeResult(0, 1.0, 1), ModeResult(1, 1.0, 1))).save(
                path / "retraining.json"
            )
        return path

    def do(self, folder: Path, commands: Iterable[tuple[str, ...]]) -> list[Answer]:
        """Gives commands in a folder, which must succeed."""
        answers = []
        for words in commands:
            answer = child(command(*words), folder, seconds=300)
            # A run of preset smoke may fail to control the robot; its files are made none the less.
            if broke := answer.broke(ended=(0, 1)):
                raise SystemExit(f"hyrl-mj {' '.join(words)}: {broke}")
            answers.append(answer)
        return answers

    def copy(self, folder: Path, *options: str) -> Path:
        """Returns a copy of a finished run in a folder; nothing is shared with it."""
        return Path(shutil.copytree(self.finished(*options), folder / TASK))
