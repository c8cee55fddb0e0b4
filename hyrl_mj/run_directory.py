"""The run directory: what the stages leave on disk, and how it is opened."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hyrl_mj import artifacts, robustness
from hyrl_mj.controllers import Controller, PolicyController
from hyrl_mj.critical_set import CriticalSet
from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.extended_sets import ExtendedSets
from hyrl_mj.hybrid import HybridController
from hyrl_mj.partition import Partition
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.section import Section
from hyrl_mj.settings import Settings
from hyrl_mj.simulation import HybridArc
from hyrl_mj.tasks.base import Task
from hyrl_mj.tasks.registry import get_task

PACKAGES = ("mujoco", "gymnasium", "stable-baselines3", "torch", "numpy", "mediapy")
# Grid points along the longest side from which critical points of a section are searched for.
SECTION_CELLS = 40


@dataclass(frozen=True)
class Run:
    """A run directory. What it holds is read when it is asked for.

    Attributes:
        path: the directory.
        settings: how it was made.
    """

    path: Path
    settings: Settings

    @cached_property
    def task(self) -> Task:
        """The task."""
        return get_task(self.settings.task)

    @cached_property
    def policy(self) -> MlpPolicy:
        """The policy of stage 1."""
        return self._load_policy("policy.safetensors")

    @cached_property
    def critical_set(self) -> CriticalSet:
        """M*, of stage 2."""
        return CriticalSet.load(self.path / "critical_set.npz")

    @cached_property
    def partition(self) -> Partition:
        """The parts M_i, of stage 3."""
        return Partition.load(self.path / "partition.npz", self.task)

    @cached_property
    def extended_sets(self) -> ExtendedSets:
        """The extended sets M_ext_i, of stage 5."""
        return ExtendedSets.load(self.path / "extended_sets.npz", self.task)

    @cached_property
    def section(self) -> Section:
        """What is drawn of a chart of more than two dimensions."""
        return Section.of(self.task)

    @cached_property
    def critical_section(self) -> CriticalSet:
        """M* in the section."""
        s = self.settings
        cells = max(s.rods, SECTION_CELLS)
        return self.section.critical_set(self.critical_set, self.policy, cells, s.resolution)

    @cached_property
    def controller(self) -> HybridController:
        """The hybrid controller, of stage 7."""
        extended = self.extended_sets
        policies = {q: self._load_policy(f"mode_{q}.safetensors") for q in extended.modes}
        return HybridController(
            self.task, policies, dict(zip(extended.modes, extended.sets, strict=True))
        )

    @cached_property
    def loops(self) -> dict[str, Controller]:
        """What is examined: the policy alone, and the hybrid controller."""
        return {"policy": PolicyController(self.policy), "hyrl": self.controller}

    @cached_property
    def robustness(self) -> dict[str, Any]:
        """What `robustness.json` holds."""
        return robustness.load(self.path / "robustness.json")

    @cached_property
    def versions(self) -> dict[str, str]:
        """The versions of Python and packages that it was begun with."""
        config = self.path / "config.json"
        content = artifacts.read_json(config, kind="run")
        with artifacts.reading(config):
            return dict(content["versions"])

    def arc_paths(self) -> dict[tuple[str, str], Path]:
        """The files of the replays by start ("start0", ..., "critical") and controller."""
        starts = [f"start{i}" for i in range(len(self.task.replay_starts))]
        starts += ["critical"] if len(self.critical_set.points) else []
        loops = ["policy"] + [f"hyrl_q{q}" for q in self.extended_sets.modes]
        return {(s, c): self.path / "arcs" / f"{s}_{c}.npz" for s in starts for c in loops}

    def arcs(self) -> dict[tuple[str, str], HybridArc]:
        """The replays by start ("start0", ..., "critical") and controller ("policy", "hyrl_q0", ...)."""
        return {key: self.arc(path) for key, path in self.arc_paths().items()}

    def arc(self, path: Path) -> HybridArc:
        """An arc of this run's task.

        Raises:
            BadArtifact: it is of another task, or damaged.
        """
        found = HybridArc.load(path)
        if found.task != self.task.name:
            raise BadArtifact(
                f"{path} is an arc of {found.task}, {self.path} a run of {self.task.name}: "
                "simulate it again"
            )
        return found

    def latest_path(self, controller: str) -> Path:
        """The file of the latest simulation from a start of the user's."""
        return self.path / "arcs" / f"latest_{controller}.npz"

    def _load_policy(self, name: str) -> MlpPolicy:
        task = self.task  # first: a task of the user's is known by its name once its file is loaded
        policy = MlpPolicy.load(self.path / name)
        if policy.task.name != task.name:
            raise BadArtifact(
                f"{self.path} is a run of {task.name}, but holds a policy for "
                f"{policy.task.name}: run the stage that writes it again"
            )
        return policy


def load_run(path: str | Path) -> Run:
    """Open a run directory.

    Raises:
        BadArtifact: it is not one.
    """
    path = Path(path)
    config = path / "config.json"
    if not config.is_file():
        raise BadArtifact(
            f"{path} is not a run directory: it has no config.json; "
            "make one with hyrl-mj run TASK --out DIR"
        )
    content = artifacts.read_json(config, kind="run")
    with artifacts.reading(config):
        return Run(path, Settings.from_json(content["settings"]))


def write_config(run: Run) -> None:
    """Write `config.json`: every setting, and the versions that go with them."""
    versions = {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}
    content = {"settings": run.settings.to_json(), "versions": versions}
    artifacts.write_json(run.path / "config.json", content, kind="run")


def open_or_create(path: str | Path, settings: Settings) -> Run:
    """The run directory at `path` with these settings, made if it is not there yet.

    Raises:
        BadInput: there is a run with other settings; the message names them.
    """
    path = Path(path)
    if (path / "config.json").exists():
        run = load_run(path)
        if run.settings != settings:
            old, new = run.settings.to_json(), settings.to_json()
            differing = [
                f"{name}: {old[name]} there, {new[name]} asked for"
                if not isinstance(new[name], dict)
                else name
                for name in new
                if old[name] != new[name]
            ]
            raise BadInput(
                f"{path} holds a run with other settings ({'; '.join(differing)}): "
                "choose another --out, give the same settings, or remove it"
            )
        return run
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise BadInput(f"{path} is there and is not a run directory: choose another --out")
    run = Run(path, settings)
    write_config(run)
    return run
