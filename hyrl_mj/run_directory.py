"""The run directory: the files that the stages write, and the `Run` that reads them."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from hyrl_mj import artifacts, policies
from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.game import Lattice, Robustness
from hyrl_mj.learning import Settings, Training
from hyrl_mj.policies import Agent, AnyPolicy, MlpPolicy, Policy
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, HybridController, Partition
from hyrl_mj.tasks import Task, get_task

# The packages whose versions `config.json` records.
PACKAGES = ("mujoco", "gymnasium", "stable-baselines3", "torch", "numpy", "mediapy")


@dataclass(frozen=True)
class Config:
    """The content of `config.json`.

    Attributes:
        settings: every setting of the run.
        versions: the versions of Python and the packages when the run began.
    """

    settings: Settings
    versions: dict[str, str]

    @staticmethod
    def load(path: Path) -> Config:
        """Reads `config.json`; raises `BadArtifact` if it is damaged or of another version."""
        return artifacts.read_record(path, "run", Config, "start a new run with another --out")


@dataclass(frozen=True)
class Run:
    """A run directory, whose files are read when needed.

    Attributes:
        path: the directory.
        settings: every setting of the run.
        function: the agent, if it is a function, which no file can hold.
    """

    path: Path
    settings: Settings
    function: AnyPolicy | None = None

    def __repr__(self) -> str:
        s, path = self.settings, str(self.path)
        return f"Run({path!r}: {s.task}, eps {s.noise:g}, seed {s.seed}, preset {s.preset})"

    @cached_property
    def task(self) -> Task:
        """The task."""
        return get_task(self.settings.task)

    @property
    def agent(self) -> Agent | None:
        """The agent in place of stage 1; None if stage 1 trains a policy."""
        stage1 = self.settings.stage1
        return stage1 if isinstance(stage1, Agent) else None

    @cached_property
    def policy(self) -> Policy:
        """The policy of stage 1, or the agent."""
        if self.agent is None:
            return self._load_policy("policy.safetensors")
        seed, function = self.settings.seed, self.function
        return policies.reopen_agent(self.path, self.agent, self.task, seed, function)

    @property
    def policy_title(self) -> str:
        """The name of the policy in figures and replays: "RL policy (DQN)"."""
        return f"RL policy ({self.settings.stage1.title})"

    @property
    def steady(self) -> Policy:
        """The policy as a function of the measurement: the mean or mode of one that draws its inputs."""
        policy = self.policy
        return policy.policy if isinstance(policy, policies.SampledPolicy) else policy

    @property
    def exact(self) -> bool:
        """Whether the exact game can be played: on a lattice, against a policy that draws nothing."""
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
        special = {policies.ONNX: ["policy.onnx"], policies.FUNCTION: ["policy.json"]}
        network = ["policy.safetensors", "policy.json"]
        return [self.path / n for n in special.get(self.settings.stage1.algorithm, network)]

    @cached_property
    def critical_set(self) -> CriticalSet:
        """M*, from stage 2."""
        return CriticalSet.load(self.path / "critical_set.npz")

    @cached_property
    def partition(self) -> Partition:
        """The parts M_i, from stage 3."""
        return Partition.load(self.path / "partition.npz", self.task)

    @cached_property
    def split(self) -> Partition:
        """The parts that stage 5 extends: M_i, for an agent changed where they leave no room."""
        return self.partition if self.agent is None else Partition.load(self.split_path, self.task)

    @property
    def split_path(self) -> Path:
        """The file of `split` for an agent."""
        return self.path / "split.npz"

    @property
    def set_files(self) -> list[Path]:
        """The files of stage 5."""
        return [self.path / "extended_sets.npz", *[self.split_path] * (self.agent is not None)]

    @cached_property
    def extended_sets(self) -> ExtendedSets:
        """The extended sets M_ext_i, from stage 5."""
        return ExtendedSets.load(self.path / "extended_sets.npz", self.task)

    @cached_property
    def controller(self) -> HybridController:
        """The hybrid controller, from stage 7."""
        extended, starts = self.extended_sets, None
        mode_policies = {q: self._load_policy(f"mode_{q}.safetensors") for q in extended.modes}
        flow_sets = dict(zip(extended.modes, extended.sets, strict=True))
        if self.agent is not None:
            # The flow sets of an agent may reach farther to one side of its decision than to the other.
            starts = dict(zip(self.split.modes, self.split.parts, strict=True))
        return HybridController(self.task, mode_policies, flow_sets, starts)

    @cached_property
    def loops(self) -> dict[str, policies.Controller]:
        """The controllers by name: the policy alone, and the hybrid controller."""
        return {"policy": policies.PolicyController(self.policy), "hyrl": self.controller}

    @cached_property
    def robustness(self) -> Robustness:
        """The result of the examination under noise, from `robustness.json`."""
        return Robustness.load(self.path / "robustness.json")

    @cached_property
    def versions(self) -> dict[str, str]:
        """The versions of Python and the packages when the run began."""
        return Config.load(self.path / "config.json").versions

    def arc_paths(self) -> dict[tuple[str, str], Path]:
        """Returns the replays' files by start ("start0", "critical") and controller ("policy", "hyrl_q0")."""
        starts = [f"start{i}" for i in range(len(self.task.scene.starts))]
        starts += ["critical"] if len(self.critical_set.points) else []
        loops = ["policy"] + [f"hyrl_q{q}" for q in self.extended_sets.modes]
        return {(s, c): self.path / "arcs" / f"{s}_{c}.npz" for s in starts for c in loops}

    def arcs(self) -> dict[tuple[str, str], HybridArc]:
        """Returns the replays by start and controller, as `arc_paths`."""
        return {key: self.arc(path) for key, path in self.arc_paths().items()}

    def arc(self, path: Path) -> HybridArc:
        """Reads an arc; raises `BadArtifact` if it is damaged, or of another task than the run's."""
        arc = HybridArc.load(path)
        if arc.task != self.task.name:
            raise BadArtifact(
                f"{path} is an arc of {arc.task}, {self.path} a run of {self.task.name}: "
                "simulate it again"
            )
        return arc

    def latest_path(self, controller: str) -> Path:
        """Returns the file of the latest simulation from the user's own start."""
        return self.path / "arcs" / f"latest_{controller}.npz"

    def _load_policy(self, name: str) -> MlpPolicy:
        task = self.task  # first: the file of a user's task registers its name
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
        policy: the agent of the run, if it is a function, which no file can hold.

    Raises:
        BadArtifact: the directory holds no run.
    """
    path = Path(path)
    config = path / "config.json"
    if not config.is_file():
        raise BadArtifact(
            f"{path} is not a run directory (no config.json): make one with hyrl-mj run TASK --out DIR"
        )
    return Run(path, Config.load(config).settings, policy)


def write_config(run: Run) -> None:
    """Writes `config.json`: every setting, and the versions of Python and the packages."""
    versions = {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}
    artifacts.write_json(run.path / "config.json", Config(run.settings, versions), kind="run")


def _differing(old: Settings, new: Settings) -> Iterator[str]:
    """Yields a description of each setting that differs, by the name of its option."""
    for name, before in vars(old).items():
        now = getattr(new, name)
        if before != now:
            option = {"noise": "eps", "stage1": "policy"}.get(name, name)
            old_text, new_text = _brief(before), _brief(now)
            change = f": {old_text} there, {new_text} given" if old_text != new_text else ""
            yield option + change


def _brief(setting: object) -> str:
    """Returns a short description of the value of a setting."""
    if isinstance(setting, Agent):
        return f"{setting} of sha256 {setting.sha256[:8]}"
    return f"training with {setting.algorithm}" if isinstance(setting, Training) else str(setting)


def open_or_create(path: str | Path, settings: Settings, policy: AnyPolicy | None = None) -> Run:
    """Opens the run directory at `path` with these settings, or creates it; `policy` is as in `load_run`.

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
