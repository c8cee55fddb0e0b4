"""The run directory: what the stages leave on disk, and how it is opened."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from hyrl_mj import artifacts
from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.game import Lattice, Robustness
from hyrl_mj.learning import Settings, Training
from hyrl_mj.policies import (
    FUNCTION,
    ONNX,
    Agent,
    AnyPolicy,
    Controller,
    MlpPolicy,
    Policy,
    PolicyController,
    SampledPolicy,
    reopen_agent,
)
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, HybridController, Partition
from hyrl_mj.tasks import Task, get_task

PACKAGES = ("mujoco", "gymnasium", "stable-baselines3", "torch", "numpy", "mediapy")


@dataclass(frozen=True)
class Config:
    """What `config.json` holds.

    Attributes:
        settings: every setting of the run.
        versions: the versions of Python and packages that the run was begun with.
    """

    settings: Settings
    versions: dict[str, str]

    @staticmethod
    def load(path: Path) -> Config:
        """Reads `config.json`.

        Raises:
            BadArtifact: the file is damaged or of another version.
        """
        return artifacts.read_record(path, "run", Config, "start a new run with another --out")


@dataclass(frozen=True)
class Run:
    """A run directory, whose files are read when they are needed.

    Attributes:
        path: the directory.
        settings: how it was made.
        function: the agent, if it is a function, which no file holds.
    """

    path: Path
    settings: Settings
    function: AnyPolicy | None = None

    def __repr__(self) -> str:
        s = self.settings
        return (
            f"Run({str(self.path)!r}: {s.task}, eps {s.noise:g}, seed {s.seed}, preset {s.preset})"
        )

    @cached_property
    def task(self) -> Task:
        """The task."""
        return get_task(self.settings.task)

    @property
    def agent(self) -> Agent | None:
        """The agent that takes the place of stage 1, if there is one."""
        stage1 = self.settings.stage1
        return stage1 if isinstance(stage1, Agent) else None

    @cached_property
    def policy(self) -> Policy:
        """The policy of stage 1, or the agent."""
        if self.agent is None:
            return self._load_policy("policy.safetensors")
        return reopen_agent(self.path, self.agent, self.task, self.settings.seed, self.function)

    @property
    def policy_title(self) -> str:
        """The name of the policy in figures and replays: "RL policy (DQN)"."""
        return f"RL policy ({self.settings.stage1.title})"

    @property
    def steady(self) -> Policy:
        """The policy as a function of the measurement: where it is sampled, its mean or mode."""
        policy = self.policy
        return policy.policy if isinstance(policy, SampledPolicy) else policy

    @property
    def exact(self) -> bool:
        """Whether the worst case can be played: it takes a lattice, and a policy that does not draw."""
        return Lattice.possible(self.task) and not (self.agent and self.agent.stochastic)

    def check_exact(self) -> None:
        """Raises `BadInput` unless `exact`."""
        Lattice.check(self.task)
        if not self.exact:
            raise BadInput(
                "the exact game takes a function of the measurement, and this policy draws its inputs: use "
                "noisy episodes instead (hyrl-mj robustness RUN --episodes N --noise adversarial)"
            )

    @property
    def policy_files(self) -> list[Path]:
        """The files that hold the policy of stage 1, or the agent."""
        special = {ONNX: ["policy.onnx"], FUNCTION: ["policy.json"]}
        network = ["policy.safetensors", "policy.json"]
        return [self.path / n for n in special.get(self.settings.stage1.algorithm, network)]

    @cached_property
    def critical_set(self) -> CriticalSet:
        """M*, of stage 2."""
        return CriticalSet.load(self.path / "critical_set.npz")

    @cached_property
    def partition(self) -> Partition:
        """The parts M_i, of stage 3."""
        return Partition.load(self.path / "partition.npz", self.task)

    @cached_property
    def split(self) -> Partition:
        """The parts that are extended: M_i, for an agent changed where they leave no room."""
        return self.partition if self.agent is None else Partition.load(self.split_path, self.task)

    @property
    def split_path(self) -> Path:
        """The file of `split`, if it has one of its own."""
        return self.path / "split.npz"

    @property
    def set_files(self) -> list[Path]:
        """The files of stage 5."""
        return [self.path / "extended_sets.npz", *[self.split_path] * (self.agent is not None)]

    @cached_property
    def extended_sets(self) -> ExtendedSets:
        """The extended sets M_ext_i, of stage 5."""
        return ExtendedSets.load(self.path / "extended_sets.npz", self.task)

    @cached_property
    def controller(self) -> HybridController:
        """The hybrid controller, of stage 7."""
        extended = self.extended_sets
        policies = {q: self._load_policy(f"mode_{q}.safetensors") for q in extended.modes}
        flow_sets = dict(zip(extended.modes, extended.sets, strict=True))
        starts = None
        if self.agent is not None:
            # The sets of an agent reach differently far to either side of where it decides.
            starts = dict(zip(self.split.modes, self.split.parts, strict=True))
        return HybridController(self.task, policies, flow_sets, starts)

    @cached_property
    def loops(self) -> dict[str, Controller]:
        """The controllers that are examined: the policy alone, and the hybrid controller."""
        return {"policy": PolicyController(self.policy), "hyrl": self.controller}

    @cached_property
    def robustness(self) -> Robustness:
        """The result of the examination under noise, from `robustness.json`."""
        return Robustness.load(self.path / "robustness.json")

    @cached_property
    def versions(self) -> dict[str, str]:
        """The versions of Python and packages that the run was begun with."""
        return Config.load(self.path / "config.json").versions

    def arc_paths(self) -> dict[tuple[str, str], Path]:
        """Returns the files of the replays by start ("start0", ..., "critical") and controller."""
        starts = [f"start{i}" for i in range(len(self.task.scene.starts))]
        starts += ["critical"] if len(self.critical_set.points) else []
        loops = ["policy"] + [f"hyrl_q{q}" for q in self.extended_sets.modes]
        return {(s, c): self.path / "arcs" / f"{s}_{c}.npz" for s in starts for c in loops}

    def arcs(self) -> dict[tuple[str, str], HybridArc]:
        """Returns the replays by start ("start0", "critical") and controller ("policy", "hyrl_q0")."""
        return {key: self.arc(path) for key, path in self.arc_paths().items()}

    def arc(self, path: Path) -> HybridArc:
        """Returns an arc of this run's task.

        Raises:
            BadArtifact: the arc is of another task, or damaged.
        """
        arc = HybridArc.load(path)
        if arc.task != self.task.name:
            raise BadArtifact(
                f"{path} is an arc of {arc.task}, {self.path} a run of {self.task.name}: "
                "simulate it again"
            )
        return arc

    def latest_path(self, controller: str) -> Path:
        """Returns the file of the latest simulation from a start of the user."""
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


def load_run(path: str | Path, policy: AnyPolicy | None = None) -> Run:
    """Opens a run directory.

    Args:
        path: the directory.
        policy: the agent of the run, if it is a function, which no file holds.

    Raises:
        BadArtifact: the directory holds no run.
    """
    path = Path(path)
    config = path / "config.json"
    if not config.is_file():
        raise BadArtifact(
            f"{path} is not a run directory: it has no config.json; "
            "make one with hyrl-mj run TASK --out DIR"
        )
    return Run(path, Config.load(config).settings, policy)


def write_config(run: Run) -> None:
    """Writes `config.json`: every setting, and the versions that go with them."""
    versions = {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}
    artifacts.write_json(run.path / "config.json", Config(run.settings, versions), kind="run")


def _differing(old: Settings, new: Settings) -> Iterator[str]:
    """Yields a description of each setting that differs, by the name of its option."""
    for name, before in vars(old).items():
        now = getattr(new, name)
        if before == now:
            continue
        if not isinstance(before, Training | Agent):
            option = "eps" if name == "noise" else name
            yield f"{option}: {before} there, {now} asked for"
        elif Agent in (type(before), type(now)):
            yield f"policy: {_policy(before)} there, {_policy(now)} asked for"
        elif before.algorithm != now.algorithm:
            yield f"{name} algorithm: {before.algorithm} there, {now.algorithm} asked for"
        else:
            yield name


def _policy(stage1: Training | Agent) -> str:
    """Returns a short name of what stage 1 trains or takes."""
    if isinstance(stage1, Agent):
        return f"{stage1} of sha256 {stage1.sha256[:8]}"
    return f"{stage1.title} to be trained"


def open_or_create(path: str | Path, settings: Settings, policy: AnyPolicy | None = None) -> Run:
    """Opens the run directory at `path` with these settings, or makes it.

    `policy` is as in `load_run`.

    Raises:
        BadInput: the directory holds a run with other settings; the message names them.
    """
    path = Path(path)
    if (path / "config.json").exists():
        run = load_run(path, policy)
        if run.settings != settings:
            differing = "; ".join(_differing(run.settings, settings))
            raise BadInput(
                f"{path} holds a run with other settings ({differing}): "
                "choose another --out, give the same settings, or remove it"
            )
        return run
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise BadInput(f"{path} exists and is not a run directory: choose another --out")
    run = Run(path, settings, policy)
    write_config(run)
    return run
