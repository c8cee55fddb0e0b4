"""External agents, which `robustify` starts from: how they are read, described and stored."""

from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import cast

import numpy as np

from hyrl_mj.errors import BadArtifact, BadInput, check_seed, unknown
from hyrl_mj.files import artifacts
from hyrl_mj.policies import algorithms
from hyrl_mj.policies.controllers import PolicyController, is_memory, memory_at_start
from hyrl_mj.policies.functions import PythonAgent, check_act, declares_memory, from_callable
from hyrl_mj.policies.memoryless import answers, check_memoryless
from hyrl_mj.policies.mlp import (
    ACTIVATIONS,
    MlpPolicy,
    ObservationPolicy,
    Policy,
    SampledPolicy,
)
from hyrl_mj.policies.onnx_model import from_onnx
from hyrl_mj.policies.preprocessing import (
    NONE,
    PreprocessedPolicy,
    Preprocessing,
    network,
)
from hyrl_mj.policies.sb3_zip import REMEDY, from_zip
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Agent:
    """Describes an external agent, which takes the place of the policy that stage 1 trains.

    Attributes:
        algorithm: the SB3 algorithm that trained it; "onnx" for an ONNX model, "function" for Python code.
        source: the path of its file; "" for a Python object. Comparisons ignore it.
        sha256: hash of a network's tensors, of a model's file, or of a function's answers.
        activation: the function between the layers of a network, else None.
        stochastic: whether it draws its inputs, as it did during training.
        statistics: hash of the statistics of `VecNormalize` that its observations go through; "" without.
        n_stack: number of observations that it sees at once.
        vecnormalize: the path of the statistics; "" without, or for a Python object. Comparisons ignore it.
        remembers: whether it is Python code with a memory.
    """

    algorithm: str
    source: str = field(compare=False)
    sha256: str
    activation: str | None = None
    stochastic: bool = False
    statistics: str = ""
    n_stack: int = 1
    vecnormalize: str = field(default="", compare=False)
    remembers: bool = False

    def __str__(self) -> str:
        """Returns a one-line description: "agent.zip (DQN, sampled)"."""
        words = [self.title]
        words += ["normalised"] * bool(self.statistics)
        words += [f"{self.n_stack} observations"] * (self.n_stack > 1)
        words += ["sampled"] * self.stochastic + ["with a memory"] * self.remembers
        return f"{self.source or 'an agent of Python code'} ({', '.join(words)})"

    @property
    def why_no_function(self) -> str:
        """Why its input is no function of the measurement, as "it draws its inputs"; "" if it is one."""
        whys = {
            "it draws its inputs": self.stochastic,
            f"it sees its last {self.n_stack} observations": self.n_stack > 1,
            "it has a memory": self.remembers,
        }
        return " and ".join(why for why, holds in whys.items() if holds)

    @property
    def title(self) -> str:
        """Its kind for display: "DQN", "ONNX" or "function"."""
        return FUNCTION if self.algorithm == FUNCTION else algorithms.title(self.algorithm)

    @property
    def options(self) -> list[str]:
        """The command-line options that describe it."""
        options = ["--policy", self.source]
        if self.activation is not None:
            options += ["--activation", self.activation]
        if self.vecnormalize:
            options += ["--vecnormalize", self.vecnormalize]
        if self.n_stack > 1:
            options += ["--n-stack", f"{self.n_stack}"]
        return options + ["--stochastic"] * self.stochastic


# The values that stand for an agent: a path, a policy, or Python code.
AnyPolicy = str | Path | Policy | PythonAgent
# The statistics of `VecNormalize` in a run directory.
STATISTICS = "vecnormalize.npz"
# The files of an agent there, which saw what these statistics normalise; modes see plain observations.
STORED = ("policy.safetensors", "policy.onnx")
# The ends of the names of files of agents, which are never the name of an object.
FILES = (".zip", ".onnx", ".safetensors")
# Kinds of agents besides those that SB3 trains.
ONNX, FUNCTION = "onnx", "function"


@dataclass(frozen=True)
class ExternalAgent:
    """An agent that was trained elsewhere, ready to act and to be stored.

    Attributes:
        policy: the agent as a policy.
        agent: its description in `config.json`.
        model: the content of an ONNX file, else empty.
    """

    policy: Policy
    agent: Agent
    model: bytes = b""

    def store(self, path: Path) -> None:
        """Writes the agent into a run directory; of a function, only its fingerprint."""
        if (mlp := network(self.policy)) is not None:
            mlp.save(path / STORED[0])
        elif self.model:
            with artifacts.replacing(path / STORED[1]) as temporary:
                temporary.write_bytes(self.model)
        else:
            content = {"algorithm": FUNCTION, "sha256": self.agent.sha256}
            artifacts.write_json(path / "policy.json", content, kind="policy")
        normalization = _preprocessing(self.policy).normalization
        if normalization is not None and self.agent.algorithm != FUNCTION:
            normalization.save(path / STATISTICS)


def agent_at(path: Path) -> AnyPolicy:
    """Returns the path of an agent's file itself, or the object that `module:object` names.

    A module is imported if there is no such file and the name is that of none, from the current folder where
    it is not installed.

    Raises:
        BadArtifact: there is no such file.
        BadInput: there is no such module or object, or it can be no agent.
    """
    if ":" not in str(path) or path.suffix in FILES or path.exists():
        with artifacts.reading(path, REMEDY):
            path.stat()
        return path
    agent = algorithms.imported(str(path), f"the agent {path}")
    if not callable(agent) and not callable(getattr(agent, "act", getattr(agent, "predict", None))):
        raise BadInput(
            f"the agent {path} is of type {type(agent).__name__}: name a function of observations, or an "
            "object with the methods start and act, or predict"
        )
    found: AnyPolicy = agent
    return found


def load_agent(
    path: str | Path,
    task: Task,
    activation: str | None = None,
    stochastic: bool = False,
    seed: int = 0,
    vecnormalize: str | Path | None = None,
    n_stack: int = 1,
) -> ObservationPolicy:
    """Reads a trained agent as a policy: an SB3 zip, an `.onnx` file, or a `policy.safetensors` of a run.

    Zips are those that `model.save` writes for PPO, A2C, DQN, SAC, TD3 and DDPG with an MLP policy, also by
    SB3 1.x. Nothing in them is executed, and every member but `policy.pth` may be missing. The agent must
    have learned on the task's own observation, in its order and scale, and on its inputs; what the zip tells
    about its training is checked. A policy class that overrides `forward` is not recognised, and acts as
    SB3's own.

    An ONNX model has one input, observations (n, k) float32, and as its first output inputs (n, m) in the
    plant's units; for a discrete task preferences (n, levels) or integers (n,). It is tried in a process
    with limits of time and memory first. A `.safetensors` file is one that `MlpPolicy.save` wrote, with its
    description beside it.

    Args:
        path: the file.
        task: the task on which the policy acts.
        activation: the function between the layers, one of `hyrl_mj.policies.ACTIVATIONS`, for a zip that
            does not name it; by default SB3's: "tanh" for PPO and A2C, "relu" for the others.
        stochastic: draw from the policy's distribution instead of acting by its mean or mode (PPO, A2C,
            SAC). Such a policy is reproducible call by call only.
        seed: the seed of these draws.
        vecnormalize: the statistics of the `VecNormalize` of its training: the file that its `save` wrote,
            or an npz file with arrays mean, var, clip, and epsilon; or "none" if it saw plain observations.
            By default the zip has to tell.
        n_stack: the number of observations that it sees at once, if it was trained under `VecFrameStack`.
            Its `act` is then the steady answer; in closed loops it acts with its memory.

    Raises:
        BadInput: an unknown activation, a bad seed, a policy without a distribution to draw from, or an
            agent that is no function of its observations.
        BadArtifact: a file that is no such agent, or one that does not fit the task.
    """
    path = Path(path)
    if vecnormalize is None and path.name in STORED and path.with_name(STATISTICS).exists():
        raise BadInput(
            f"the agent of {path} saw normalised observations: give --vecnormalize "
            f"{path.with_name(STATISTICS)}"
        )
    policy = _load(path, task, activation, stochastic, seed, vecnormalize, n_stack)
    check_memoryless(policy, task, f"the agent of {path}")
    return policy


def _load(
    path: Path,
    task: Task,
    activation: str | None,
    stochastic: bool,
    seed: int,
    vecnormalize: str | Path | None,
    n_stack: int,
) -> ObservationPolicy:
    """Returns the policy in a file, as `load_agent`, without a trial of it."""
    if activation is not None and activation not in ACTIVATIONS:
        raise unknown("activation", activation, ACTIVATIONS)
    check_seed(seed)
    preprocessing = Preprocessing.from_files(vecnormalize, n_stack, task)
    policy: ObservationPolicy
    if path.suffix == ".onnx":
        if stochastic or activation is not None:
            raise BadInput("an .onnx file acts as it is: give neither an activation nor stochastic")
        policy = from_onnx(path, task, n_stack)
    else:
        if path.suffix == ".safetensors":
            mlp = MlpPolicy.load(path, task, n_stack)
            if activation not in (None, mlp.activation):
                raise BadArtifact(f"{path} has activation {mlp.activation!r}: leave activation out")
        else:
            plain = str(vecnormalize) == NONE
            mlp, preprocessing = from_zip(path, task, activation, preprocessing, plain)
        policy = SampledPolicy(mlp, np.random.default_rng(seed)) if stochastic else mlp
    return PreprocessedPolicy(policy, preprocessing) if preprocessing else policy


def read_agent(
    task: Task,
    policy: AnyPolicy,
    activation: str | None = None,
    stochastic: bool = False,
    seed: int = 0,
    vecnormalize: str | Path | None = None,
    n_stack: int = 1,
) -> ExternalAgent:
    """Returns an external agent: a file for `load_agent`, a policy, or what `from_callable` takes.

    The options are about files, as in `load_agent`.

    Raises:
        BadInput: it cannot be used, or does not fit the task.
    """
    if isinstance(policy, str | Path):
        path = Path(policy)
        loaded = load_agent(path, task, activation, stochastic, seed, vecnormalize, n_stack)
        statistics = "" if vecnormalize is None else str(vecnormalize)
        if path.suffix != ".onnx":
            return _network(loaded, task, str(path), statistics)
        model = artifacts.read_limited(path)
        agent = Agent(ONNX, str(path), sha256(model).hexdigest(), vecnormalize=statistics)
        return ExternalAgent(loaded, _seeing(agent, loaded), model)
    if activation is not None or stochastic or vecnormalize is not None or n_stack != 1:
        raise BadInput(
            "activation, stochastic, vecnormalize and n_stack are about the file of an agent: leave them "
            "out, and give a policy that load_agent(..., stochastic=True) made, say"
        )
    if isinstance(policy, Policy) and network(policy) is not None:
        return _network(policy, task)
    if declares_memory(policy) or not isinstance(policy, Policy):
        policy = from_callable(cast(PythonAgent, policy), task)
    check_act(policy)
    function: Policy = policy
    check_memoryless(function, task)
    agent = Agent(FUNCTION, "", _fingerprint(function, task))
    return ExternalAgent(function, _seeing(agent, function))


def reopen_agent(
    path: Path, agent: Agent, task: Task, seed: int, policy: AnyPolicy | None
) -> Policy:
    """Returns the policy of the agent of a run directory, as `config.json` describes it.

    A run with a function needs that function as `policy`. The seed is that of a sampled agent's draws.

    Raises:
        BadInput: the function is missing, or is another one.
    """
    if agent.algorithm == FUNCTION:
        if policy is None:
            raise BadInput(
                f"{path} was made with a function, which no file holds: open it in Python with "
                "hyrl_mj.load_run(path, policy=...)"
            )
        external = read_agent(task, policy)
        if external.agent != agent:
            raise BadInput(
                f"{path} was made with a function that answers otherwise: give that function"
            )
        return external.policy
    if policy is not None:
        raise BadInput(f"{path} holds its own policy: open it without another one")
    file = path / STORED[agent.algorithm == ONNX]
    statistics = path / STATISTICS if agent.statistics else None
    stochastic, n_stack = agent.stochastic, agent.n_stack
    # It was tried when the run was made, and is in each closed loop.
    return _load(file, task, None, stochastic, seed, statistics, n_stack)


def _network(policy: Policy, task: Task, source: str = "", vecnormalize: str = "") -> ExternalAgent:
    """Returns a trained network, sampled or not, as an external agent."""
    mlp = network(policy)
    assert mlp is not None
    if mlp.task.name != task.name:
        raise BadInput(
            f"a policy for {mlp.task.name} cannot act on {task.name}: give one for {task.name}"
        )
    digest = sha256()
    for name in sorted(mlp.weights):
        digest.update(name.encode() + np.ascontiguousarray(mlp.weights[name]).tobytes())
    inner = policy.policy if isinstance(policy, PreprocessedPolicy) else policy
    stochastic = isinstance(inner, SampledPolicy)
    agent = Agent(mlp.algorithm, source, digest.hexdigest(), mlp.activation, stochastic)
    return ExternalAgent(policy, _seeing(replace(agent, vecnormalize=vecnormalize), policy))


def _preprocessing(policy: Policy) -> Preprocessing:
    return policy.preprocessing if isinstance(policy, PreprocessedPolicy) else Preprocessing()


def _seeing(agent: Agent, policy: Policy) -> Agent:
    """Returns the description of an agent with that of what it sees."""
    preprocessing = _preprocessing(policy)
    statistics = preprocessing.normalization.sha256 if preprocessing.normalization else ""
    remembers = preprocessing.n_stack == 1 and is_memory(
        memory_at_start(PolicyController(policy), 1)
    )
    return replace(agent, statistics=statistics, n_stack=preprocessing.n_stack, remembers=remembers)


def _fingerprint(policy: Policy, task: Task) -> str:
    """Returns a hash of a function's answers to fixed measurements, one after the other if it has a memory.

    These are of starts, of places all over the chart, and of where random inputs lead from both.
    """
    rng = np.random.default_rng(0)
    anywhere = task.chart.draw(128, rng)
    z = np.vstack([task.starts(128, rng), anywhere])
    plant = task.placed(z, rng)
    met = [plant.measurement]
    for _ in range(4):
        plant.step(task.draw_inputs(len(z), rng))
        met.append(plant.measurement)
    whole, first = np.concatenate(met), list[np.ndarray]()
    # What a memory does may show late: so many runs see them one after the other, in any order.
    runs = 20 if is_memory(memory_at_start(PolicyController(policy), 1)) else len(whole)
    if runs < len(whole):
        whole = rng.permutation(whole)
    memory = memory_at_start(PolicyController(policy), runs)
    for measured in np.array_split(whole, len(whole) // runs):
        u, memory = answers(policy, task, measured, memory, "the policy")
        first.append(np.round(u.astype(float), 6) + 0.0)
    return sha256(np.concatenate(first).tobytes()).hexdigest()
