"""The run directory: the files that the stages write, and the `Run` that reads them."""

from __future__ import annotations

import json
import platform
from base64 import b64encode
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from hashlib import sha256
from html import escape
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np

from hyrl_mj import policies
from hyrl_mj.errors import BadArtifact, BadInput, HyrlError, unknown
from hyrl_mj.fields import acting_policy
from hyrl_mj.files import artifacts
from hyrl_mj.files.manifest import FILES, Manifest, check_contents, check_may_hold, locked
from hyrl_mj.judging import Arrivals, Retraining, Verdict
from hyrl_mj.judging.game import Lattice, MapClass, Maps, Robustness, lattice_grid
from hyrl_mj.judging.proof import why_no_cells
from hyrl_mj.learning import Settings, differing
from hyrl_mj.policies import Agent, AnyPolicy, HybridController, MlpPolicy, Policy
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import LONGEST, HybridArc
from hyrl_mj.stages import CriticalSet, ExtendedSets, Partition, PartPolicy, TablePolicy
from hyrl_mj.tasks import Task, described_task, get_task, reference


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
        return f"Run({path!r}: {s.task}, eps {s.eps:g}, seed {s.seed}, preset {s.preset})"

    def _repr_html_(self) -> str:
        """Returns what a notebook shows: the verdict with its reasons, and the overview."""
        parts = [f"<p>{escape(repr(self))}</p>"]
        with suppress(HyrlError):
            parts.append(f"<p><b>{escape(str(self.verdict))}</b></p><ul>")
            parts += [f"<li>{escape(reason)}</li>" for reason in self.verdict.reasons] + ["</ul>"]
        with suppress(HyrlError):
            content = self._checked("figures/overview.png").read_bytes()
            image = f"data:image/png;base64,{b64encode(content).decode()}"
            parts.append(f'<img alt="overview" width="780" style="max-width: 100%" src="{image}">')
        return "".join(parts)

    @cached_property
    def task(self) -> Task:
        """The task, with the noise that the run is made for.

        Raises:
            BadInput: the settings do not fit it.
        """
        task = self.settings.noisy(described_task(self.settings.task))
        self.settings.check(task)
        return task

    def anew(self) -> Run:
        """Returns this run, which has read no file yet.

        Its task, about which much is known, is the same, and so is an agent that is a function and was tried.
        """
        run = replace(self)
        vars(run)["task"] = self.task
        if self.function is not None and "_reopened" in vars(self):
            vars(run)["_reopened"] = self._reopened
        return run

    @cached_property
    def manifest(self) -> Manifest:
        """The record of the stages that are finished.

        In its block `stage` a stage reads its inputs from this run, and writes its files. A run remembers
        what it has read, so a stage takes a run of its own.
        """
        return Manifest(self.path, self.digests, self.task.code)

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of the settings that each stage is made with."""
        values = asdict(self.settings)
        del values["task"]
        last = {stage: values | {"horizon": None} for stage in FILES} | {"extended-sets": values}
        texts = {stage: json.dumps(v, sort_keys=True, default=str) for stage, v in last.items()}
        return {name: sha256(text.encode()).hexdigest() for name, text in texts.items()}

    @property
    def agent(self) -> Agent | None:
        """The agent in place of stage 1; None if stage 1 trains a policy."""
        stage1 = self.settings.stage1
        return stage1 if isinstance(stage1, Agent) else None

    @cached_property
    def policy(self) -> Policy:
        """The policy of stage 1, or the agent."""
        if self.agent is None:
            return self._load_policy("policy")
        for path in self.policy_files:
            self.manifest.checked(path)
        return self._reopened

    @cached_property
    def _reopened(self) -> Policy:
        """The policy of the agent."""
        assert self.agent is not None
        seed, function = self.settings.seed, self.function
        return policies.reopen_agent(self.path, self.agent, self.task, seed, function)

    @property
    def policy_title(self) -> str:
        """The name of the policy in figures and replays: "RL policy (DQN)"."""
        return f"RL policy ({self.settings.stage1.title})"

    @property
    def steady(self) -> Policy:
        """The policy as a function of the measurement.

        Of one that draws its inputs this is its mean or mode, and the others are as in `as_function`.
        """
        return policies.as_function(self.policy)

    @cached_property
    def why_no_game(self) -> str | None:
        """Why the worst-case game cannot be played against the policy, None if it can be."""
        if why := Lattice.why_not(self.task) or Lattice.why_not(self.task, self.lattice_grid):
            return why
        if self.agent and self.agent.why_no_function:
            return (
                "the worst-case game takes a function of the measurement, which this policy is not "
                f"({self.agent.why_no_function})"
            )
        return None

    @property
    def exact(self) -> bool:
        """Whether the game can be played, and is more than an estimate."""
        return self.why_no_game is None and self.why_estimate is None

    @cached_property
    def why_estimate(self) -> str | None:
        """Why the worst-case game, where it can be played, is an estimate; None if it decides."""
        if why := Lattice.why_estimate(self.task):
            return why
        why = why_no_cells(self.task, self.lattice_grid.counts)
        return f"the game is an estimate between the nodes, because {why}" if why else None

    @property
    def lattice_grid(self) -> Grid:
        """The nodes of the game's lattice."""
        return lattice_grid(self.task, self.settings.lattice)

    @property
    def policy_files(self) -> list[Path]:
        """The files that hold the policy of stage 1, or the agent."""
        special = {policies.ONNX: ["policy.onnx"], policies.FUNCTION: ["policy.json"]}
        network = ["policy.safetensors", "policy.json"]
        names = special.get(self.settings.stage1.algorithm, network)
        if self.agent and self.agent.statistics and self.agent.algorithm != policies.FUNCTION:
            names = [*names, policies.STATISTICS]
        return [self.path / name for name in names]

    @cached_property
    def critical_set(self) -> CriticalSet:
        """M*, from stage 2."""
        critical = CriticalSet.load(path := self._checked("critical_set.npz"))
        if critical.points.shape[1] != self.task.chart.dimension:
            raise BadArtifact(
                f"{path} is in another chart than that of {self.task.name}: find it again"
            )
        return critical

    @cached_property
    def partition(self) -> Partition:
        """The parts M_i, from stage 3."""
        return Partition.load(self._checked("partition.npz"), self.task)

    @cached_property
    def split(self) -> Partition:
        """The parts that stage 5 extends: M_i, changed where they leave no room though there is some."""
        path = self.path / "split.npz"
        if self.agent is None and not self.manifest.has(path):
            return self.partition
        return Partition.load(self._checked(path.name), self.task)

    @cached_property
    def extended_sets(self) -> ExtendedSets:
        """The extended sets M_ext_i, from stage 5."""
        return ExtendedSets.load(self._checked("extended_sets.npz"), self.task)

    @cached_property
    def mode_policies(self) -> dict[int, MlpPolicy | PartPolicy | TablePolicy]:
        """The policy of each mode, from stage 6."""
        return {q: self._mode_policy(q) for q in self.extended_sets.modes}

    @property
    def keeps_agent(self) -> bool:
        """Whether the policy of every mode is the agent itself, everywhere as it is, without a memory."""
        kept = self.mode_policies.values()
        return not (self.agent and self.agent.remembers) and all(
            isinstance(pi, PartPolicy) and pi.whole and pi.policy is self.policy for pi in kept
        )

    @property
    def mode_networks(self) -> dict[int, MlpPolicy]:
        """Those policies of modes that are networks."""
        return {q: pi for q, pi in self.mode_policies.items() if isinstance(pi, MlpPolicy)}

    @cached_property
    def controller(self) -> HybridController:
        """The hybrid controller, from stage 7."""
        extended, starts = self.extended_sets, None
        mode_policies = {
            q: acting_policy(self.task, policy, q, self.settings.eps)
            for q, policy in self.mode_policies.items()
        }
        flow_sets = dict(zip(extended.modes, extended.sets, strict=True))
        if self.agent is not None:
            # The flow sets of an agent may reach farther to one side of its decision than to the other.
            starts = dict(zip(self.split.modes, self.split.parts, strict=True))
        return HybridController(self.task, mode_policies, flow_sets, starts)

    @cached_property
    def controllers(self) -> dict[str, policies.Controller]:
        """The controllers by name: the policy alone, and the hybrid controller."""
        return {"policy": policies.PolicyController(self.policy), "hyrl": self.controller}

    @cached_property
    def robustness(self) -> Robustness:
        """The result of the examination under noise, from `robustness.json`."""
        path = self._checked("robustness.json")
        found = Robustness.load(path, of=("policy", "hyrl"))
        lost = [one.first for one in (found.game.replays if found.game else ()) if one.first]
        if any(len(first.start) != self.task.chart.dimension for first in lost):
            raise BadArtifact(f"{path} has a start in another chart than that of {self.task.name}")
        return found

    @cached_property
    def maps(self) -> Maps:
        """The class of every node of the worst-case game, from `robustness.npz`."""
        return Maps.load(self._checked("robustness.npz"))

    @cached_property
    def arrivals(self) -> Arrivals:
        """From how many starts the policy of stage 1, or the agent, arrives without noise."""
        return Arrivals.load(self._checked("arrivals.json"))

    @cached_property
    def retraining(self) -> Retraining:
        """How stage 6 ended for each mode."""
        return Retraining.load(self._checked("retraining.json"))

    @cached_property
    def verdict(self) -> Verdict:
        """What the run is worth, in one word with its reasons."""
        facts = self.robustness, self.retraining, self.arrivals, self.settings.verdict
        return Verdict.judge(self.task, self.settings.eps, *facts)

    @property
    def is_examined_as_usual(self) -> bool:
        """Whether the examination on disk is under the run's own noise and from starts of all kinds."""
        found, own = self.robustness, self.settings
        alike = (found.eps, found.everywhere) == (own.eps, own.everywhere)
        return alike and not found.near_critical

    @cached_property
    def versions(self) -> dict[str, str]:
        """The versions of Python and the packages when the run began."""
        return Config.load(self.path / "config.json").versions

    def arc_paths(self) -> dict[tuple[str, str], Path]:
        """Returns the replays' files by start ("start0", "critical") and controller ("policy", "hyrl_q0")."""
        starts = [f"start{i}" for i in range(len(self.task.scene.starts))]
        starts += ["critical"] if len(self.critical_set.points) else []
        loops = ["policy"] + [f"hyrl_q{q}" for q in self.extended_sets.modes]
        return {(s, c): self.arc_path(s, c) for s in starts for c in loops}

    def arc_path(self, start: str, controller: str) -> Path:
        """Returns the file of an arc, as of `arc_paths`.

        The start may also be "attack", of the strongest signal that was found, or "latest", of the user's own
        simulation; then the controllers are "policy" and "hyrl".
        """
        return self.path / "arcs" / f"{start}_{controller}.npz"

    def arcs(self) -> dict[tuple[str, str], HybridArc]:
        """Returns the replays by start and controller, as `arc_paths`."""
        return {key: self.arc(path) for key, path in self.arc_paths().items()}

    def arc(self, path: Path) -> HybridArc:
        """Reads an arc; raises `BadArtifact` if it is damaged, or of another task than the run's."""
        task = self.task
        # The replays last as long as the scene; what the user simulates may last longer.
        time = task.scene.time if path.name.startswith(("start", "critical")) else LONGEST
        numbers = 3 + task.chart.dimension + task.measurement_columns + len(task.inputs)
        numbers += mujoco.mj_stateSize(task.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        # A jump has a row of its own.
        rows = 2 * round(time / task.dt + 2)
        limit = min(8 * numbers * rows + 2**16, artifacts.LARGEST)  # with headers [bytes]
        arc = HybridArc.load(self.manifest.checked(path), limit=limit)
        if len(arc.t) > rows:
            raise BadArtifact(f"{path} is longer than {time:g} s: simulate it again")
        columns = task.chart.dimension, task.measurement_columns, len(task.inputs)
        if arc.task != task.name or arc.columns != columns:
            raise BadArtifact(
                f"{path} is an arc of {arc.task}, {self.path} a run of {task.name}: "
                "simulate it again"
            )
        if arc.t[-1] > len(arc.t) * task.dt:
            raise BadArtifact(
                f"{path} has fewer samples than its {arc.t[-1]:g} s take: simulate it again"
            )
        return arc

    def attack_arcs(self) -> dict[str, HybridArc]:
        """Returns the strongest signals of the attack by controller, {} if there was none."""
        paths = {name: self.arc_path("attack", name) for name in ("policy", "hyrl")}
        has = [self.manifest.has(path) for path in paths.values()]
        return {name: self.arc(path) for name, path in paths.items()} if all(has) else {}

    def lost(self, controller: str = "policy") -> np.ndarray:
        """Returns the starts (n, d) from which a controller is known to be lost under the noise of the run.

        Where the worst-case game decides these are nodes of its lattice that may be starts; of losses between
        the nodes only the share is known, from the scores. Elsewhere they are the starts of the attack that
        it wins without noise, and loses under a signal that was found. `run.simulate(run.lost(), "worst")`
        plays the signals of the game, and "attack" in its place searches again.

        Args:
            controller: "policy" or "hyrl".

        Raises:
            BadInput: there is no such controller, the run has not been examined, or another version did it.
        """
        if controller not in self.controllers:
            raise unknown("controller", controller, self.controllers)
        if self.robustness.deciding is None:
            attacks = [a for a in self.robustness.attacks if a.controller == controller]
            found = [x for a in attacks for x in a.places]
            if not found and any(a.lost for a in attacks):
                raise BadInput(
                    f"the attack on {self.path} is of another version, which did not keep its starts: run "
                    f"hyrl-mj robustness {self.path} again"
                )
            return np.reshape(found, (-1, self.task.chart.dimension))
        maps = self.maps
        z = maps.grid(self.task.chart).nodes
        return z[(maps.map[controller] == MapClass.BEATEN) & self.task.may_start(z)]

    def _checked(self, name: str) -> Path:
        """Returns the path of a file, if it is to be believed."""
        return self.manifest.checked(self.path / name)

    def _mode_policy(self, mode: int) -> MlpPolicy | PartPolicy | TablePolicy:
        table = self.path / f"mode_{mode}_table.npz"
        if self.manifest.has(table):
            return TablePolicy.load(self.manifest.checked(table), self.task)
        path = self.path / f"mode_{mode}_part.json"
        if not self.manifest.has(path):
            return self._load_policy(f"mode_{mode}")
        self.manifest.checked(path)
        return PartPolicy.load(path, self.task, self.steady, self.partition, mode)

    def _load_policy(self, stem: str) -> MlpPolicy:
        self._checked(f"{stem}.json")
        return MlpPolicy.load(self._checked(f"{stem}.safetensors"), self.task)


def load_run(
    path: str | Path, policy: AnyPolicy | None = None, task: str | Path | Task | None = None
) -> Run:
    """Opens a run directory, as `hyrl_mj.load_run`."""
    if not isinstance(path, str | Path):
        raise BadInput(f"{path!r:.80} is no run directory: give its path")
    path = Path(path)
    config = path / "config.json"
    if not config.is_file():
        raise BadArtifact(
            f"{path} is not a run directory (no config.json): make one with hyrl-mj run TASK --out DIR"
        )
    check_contents(path)
    settings = Config.load(config).settings
    if task is not None:
        settings = replace(settings, task=reference(get_task(task)))
    return Run(path, settings, policy)


def write_config(run: Run, versions: dict[str, str] | None = None) -> None:
    """Writes `config.json`: every setting, and the versions of Python and the packages, by default of now."""
    if versions is None:
        packages = (
            "hyrl-mj", "mujoco", "gymnasium", "stable-baselines3", "torch", "numpy", "mediapy",
        )  # fmt: skip
        versions = {name: version(name) for name in packages}
        versions["python"] = platform.python_version()
    artifacts.write_json(run.path / "config.json", Config(run.settings, versions), kind="run")


@contextmanager
def opened(path: str | Path, settings: Settings, policy: AnyPolicy | None = None) -> Iterator[Run]:
    """Opens the run directory at `path` with these settings, or creates it, and holds its lock in the block.

    `policy` is as in `load_run`.

    Raises:
        BadInput: another process works there, or the directory holds a run with other settings; the message
            names them.
    """
    path = Path(path)
    check_may_hold(path, "config.json", "a run directory")
    config = path / "config.json"
    if config.exists():
        Config.load(config)  # nothing is written to the folder of another program
    with locked(path):
        run = Run(path, settings, policy)
        if not config.exists():
            write_config(run)
        elif (run := load_run(path, policy)).settings != settings:
            found = [*differing(run.settings, settings)]
            # Another task has other settings everywhere.
            differences = "; ".join(found[:1] if run.settings.task != settings.task else found)
            raise BadInput(
                f"{path} holds a run with other settings ({differences}): "
                "choose another --out, give the same settings, or remove it"
            )
        yield run
