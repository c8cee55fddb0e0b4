"""An external agent, which a run makes robust: how it is read, described and stored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadInput
from hyrl_mj.policies.agents import load_agent
from hyrl_mj.policies.algorithms import algorithm_title
from hyrl_mj.policies.functions import from_callable
from hyrl_mj.policies.mlp import MlpPolicy, Policy, SampledPolicy
from hyrl_mj.tasks import Task


@dataclass(frozen=True)
class Agent:
    """Describes an external agent, which takes the place of the policy that stage 1 trains.

    Attributes:
        algorithm: of SB3 that trained it; "onnx" for a model in that format, "function" for code.
        source: the file that it came from, as it was given; "" for an object of Python's. Two agents that
            differ in nothing else are the same.
        sha256: of what it is: a network's tensors, a model's file, a function's answers.
        activation: between a network's layers, else None.
        stochastic: whether it draws its inputs, as it did while it learned.
    """

    algorithm: str
    source: str = field(compare=False)
    sha256: str
    activation: str | None = None
    stochastic: bool = False

    def __str__(self) -> str:
        """Returns a one-line description: "agent.zip (DQN, sampled)"."""
        drawn = ", sampled" if self.stochastic else ""
        return f"{self.source or 'an agent of Python code'} ({self.title}{drawn})"

    @property
    def title(self) -> str:
        """Returns its kind for display: "DQN", "ONNX" or "FUNCTION"."""
        return algorithm_title(self.algorithm)

    @property
    def options(self) -> list[str]:
        """Returns the command-line options that describe it."""
        options = ["--policy", self.source]
        if self.activation is not None:
            options += ["--activation", self.activation]
        return options + ["--stochastic"] * self.stochastic


# The ways in which an agent can be passed in.
AnyPolicy = str | Path | Policy | Callable[[np.ndarray], Any]
# Kinds of agents besides those that SB3 trains.
ONNX, FUNCTION = "onnx", "function"
# Number of measurements from which the fingerprint of a function is made, and decimals that count in it.
PROBES, DECIMALS = 256, 6


@dataclass(frozen=True)
class ExternalAgent:
    """An agent that was trained elsewhere, ready to act and to be stored.

    Attributes:
        policy: what acts.
        agent: what `config.json` says of it.
        model: the bytes of an ONNX file, else none.
    """

    policy: Policy
    agent: Agent
    model: bytes = b""

    def store(self, path: Path) -> None:
        """Write what there is to write of it into a run directory."""
        network = self.policy.policy if isinstance(self.policy, SampledPolicy) else self.policy
        if isinstance(network, MlpPolicy):
            network.save(path / "policy.safetensors")
        elif self.model:
            with artifacts.replacing(path / "policy.onnx") as temporary:
                temporary.write_bytes(self.model)
        else:
            content = {"algorithm": FUNCTION, "sha256": self.agent.sha256}
            artifacts.write_json(path / "policy.json", content, kind="policy")


def read_agent(
    task: Task,
    policy: AnyPolicy,
    activation: str | None = None,
    stochastic: bool = False,
    seed: int = 0,
) -> ExternalAgent:
    """An agent as it is given.

    Args:
        task: what it is to act on.
        policy: a file that `hyrl_mj.load_agent` reads, a policy, or a function as
            `hyrl_mj.from_callable` takes it.
        activation, stochastic, seed: as in `hyrl_mj.load_agent`; the first two are about files.

    Raises:
        BadInput: it cannot be used, or does not fit the task.
    """
    if isinstance(policy, str | Path):
        path = Path(policy)
        loaded: Policy = load_agent(path, task, activation, stochastic, seed)
        if path.suffix != ".onnx":
            return _network(loaded, task, str(path))
        model = path.read_bytes()
        return ExternalAgent(loaded, Agent(ONNX, str(path), sha256(model).hexdigest()), model)
    if activation is not None or stochastic:
        raise BadInput(
            "activation and stochastic are about the file of an agent: leave them out, and give a policy "
            "that load_agent(..., stochastic=True) made"
        )
    if isinstance(policy, MlpPolicy | SampledPolicy):
        return _network(policy, task)
    function = policy if isinstance(policy, Policy) else from_callable(policy, task)
    return ExternalAgent(function, Agent(FUNCTION, "", _fingerprint(function, task)))


def reopen_agent(
    path: Path, agent: Agent, task: Task, seed: int, policy: AnyPolicy | None
) -> Policy:
    """The agent of a run directory.

    Args:
        path: the run directory.
        agent: what its `config.json` says.
        task: what it acts on.
        seed: of the draws of one that is sampled.
        policy: the function that the directory cannot hold, given again.

    Raises:
        BadInput: a function that is missing or another one.
    """
    if agent.algorithm == FUNCTION:
        if policy is None:
            raise BadInput(
                f"{path} is about a function, which no file holds: open it in Python with "
                "hyrl_mj.load_run(path, policy=...)"
            )
        external = read_agent(task, policy)
        if external.agent != agent:
            raise BadInput(
                f"{path} is about a function that answers otherwise than the policy given now: give the "
                "one that the run was made with"
            )
        return external.policy
    if policy is not None:
        raise BadInput(f"{path} holds its own policy: open it without another one")
    if agent.algorithm == ONNX:
        return load_agent(path / "policy.onnx", task)
    return load_agent(path / "policy.safetensors", task, stochastic=agent.stochastic, seed=seed)


def _network(policy: Policy, task: Task, source: str = "") -> ExternalAgent:
    """A trained network, which acts by its mean or mode, or is sampled."""
    stochastic = isinstance(policy, SampledPolicy)
    network = policy.policy if isinstance(policy, SampledPolicy) else policy
    assert isinstance(network, MlpPolicy)
    if network.task.name != task.name:
        raise BadInput(
            f"a policy for {network.task.name} cannot act on {task.name}: give one for it"
        )
    digest = sha256()
    for name in sorted(network.weights):
        digest.update(name.encode() + np.ascontiguousarray(network.weights[name]).tobytes())
    return ExternalAgent(
        policy,
        Agent(network.algorithm, source, digest.hexdigest(), network.activation, stochastic),
    )


def _fingerprint(policy: Policy, task: Task) -> str:
    """What tells functions apart: a hash of the answers to some measurements, always the same ones.

    Raises:
        BadInput: the answers are no inputs, or others when it is asked again.
    """
    rng = np.random.default_rng(0)
    plant = task.plant(PROBES)
    plant.set_state(*task.state(task.starts(PROBES, rng), rng))
    measured = plant.measurement
    first, again = (np.asarray(policy.act(measured)) for _ in range(2))
    wanted = (PROBES, len(task.inputs))
    if first.shape != wanted or not np.issubdtype(first.dtype, np.number):
        raise BadInput(
            f"the policy gives {first.dtype} of shape {first.shape} for {PROBES} measurements, {task.name} "
            f"takes inputs of shape {wanted}"
        )
    if not np.isfinite(first).all():
        raise BadInput(f"the policy gives inputs that are not finite: {task.name} takes numbers")
    if not np.allclose(first, again, rtol=0, atol=1e-6):
        raise BadInput(
            "the function answers the same measurements otherwise when it is asked again: give one without "
            "chance or memory"
        )
    return sha256((np.round(first.astype(float), DECIMALS) + 0.0).tobytes()).hexdigest()
