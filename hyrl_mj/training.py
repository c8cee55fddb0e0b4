"""Train a policy with SB3 on the batched environments (paper, Steps 1 and 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from threadpoolctl import threadpool_limits
from torch import nn

from hyrl_mj import symmetry
from hyrl_mj.envs.core import BatchedEnv, Domain
from hyrl_mj.envs.sb3_env import TaskVecEnv
from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.noise import SIGNALS, Noise
from hyrl_mj.policies import LAYOUTS, TORCH_NAMES, MlpPolicy, Policy
from hyrl_mj.progress import Progress
from hyrl_mj.settings import Training
from hyrl_mj.tasks.base import Outcome, Task

Score = tuple[float, ...]
# Draws n chart points (n, d).
Starts = Callable[[int, np.random.Generator], np.ndarray]
ALGORITHMS: dict[str, type[PPO] | type[DQN]] = {"ppo": PPO, "dqn": DQN}
ACTIVATIONS = {name: getattr(nn, torch_name) for name, torch_name in TORCH_NAMES.items()}
# How often TensorBoard gets a point: PPO counts rollouts, DQN episodes.
LOG_INTERVAL = {"ppo": 1, "dqn": 100}
# The learning rate falls to this share of its first value, not to zero: the last samples count too.
FINAL_RATE = 0.02
# How often the policy is checkpointed and judged; on how many episodes.
CHECKPOINTS = 32
EPISODES = 256
# States at which a policy is copied, and the steps and batches of the regression.
DISTILLED, DISTILLING, BATCH = 16_384, 1_500, 512


def train(
    task: Task,
    settings: Training,
    seed: int,
    *,
    noise: Noise | None = None,
    domain: Domain | None = None,
    start_from: MlpPolicy | None = None,
    judge: Judge | None = None,
    log_dir: Path | None = None,
    label: str = "training",
) -> MlpPolicy:
    """Train one policy, and return the best that was met.

    Training goes up and down; as with SB3's `EvalCallback`, the policy is judged at intervals. By default
    that is done in the second half, on the same episodes every time: the best is the one that most often
    ends at the set-point, and among equals the one with the highest return.

    Args:
        task: what to learn.
        settings: how.
        seed: of weights, exploration, starts and noise; the same seed gives the same policy on the
            same machine, at any number of physics threads.
        noise: measurement noise during training.
        domain: restricts starts and episodes to a part of the state space.
        start_from: a policy whose weights to go on from; its network replaces `settings.hidden`.
        judge: scores policies instead, from the beginning, and ends the training early once one is good
            enough.
        log_dir: where TensorBoard logs and checkpoints go; none are written by default.
        label: what the progress bar says.

    Returns:
        The best policy.
    """
    model = build(task, settings, seed, noise=noise, domain=domain, start_from=start_from)
    if log_dir is not None:
        model.set_logger(configure(str(log_dir / "tensorboard"), ["tensorboard"]))
    # An untrained policy can be lucky in a few episodes; a judge's verdict stands at any time.
    settled = settings.samples // 2 if judge is None else 0
    judge = judge or _Episodes(task, noise or Noise(), domain, settings.gamma)
    watch = _Watch(settings.samples, judge, settled, log_dir, label)
    with single_threaded():
        model.learn(settings.samples, callback=watch, log_interval=LOG_INTERVAL[settings.algorithm])
    watch.close()
    assert watch.best is not None
    return watch.best


def build(
    task: Task,
    settings: Training,
    seed: int,
    *,
    noise: Noise | None = None,
    domain: Domain | None = None,
    start_from: MlpPolicy | None = None,
) -> BaseAlgorithm:
    """The SB3 algorithm that `train` runs, ready to learn.

    Raises:
        BadInput: an unknown algorithm, or a policy to start from whose networks are those of another one.
    """
    if settings.algorithm not in ALGORITHMS:
        raise unknown("algorithm", settings.algorithm, ALGORITHMS)
    hidden = settings.hidden if start_from is None else start_from.hidden
    activation = settings.activation if start_from is None else start_from.activation
    rate = settings.learning_rate
    env = BatchedEnv(task, settings.envs, noise=noise, domain=domain, max_steps=settings.episode)
    model = ALGORITHMS[settings.algorithm](
        "MlpPolicy",
        TaskVecEnv(env),
        seed=seed,
        device="cpu",
        gamma=settings.gamma,
        learning_rate=(lambda left: rate * max(left, FINAL_RATE)) if settings.anneal else rate,
        policy_kwargs={"net_arch": list(hidden), "activation_fn": ACTIVATIONS[activation]},
        **settings.options,
    )
    if start_from is not None:
        state = {name: torch.as_tensor(np.array(w)) for name, w in start_from.weights.items()}
        try:
            model.policy.load_state_dict(state)
        except RuntimeError as error:
            raise BadInput(
                f"training with {settings.algorithm} cannot go on from this {start_from.algorithm} "
                "policy, whose networks are other ones: start afresh"
            ) from error
    if settings.symmetric and start_from is None and task.mirror is not None:
        symmetry.impose(model.policy, task)
    return model


def fits(task: Task, settings: Training, policy: MlpPolicy) -> bool:
    """Whether training can go on from a policy's weights."""
    try:
        build(task, settings, 0, start_from=policy)
    except BadInput:
        return False
    return True


def distil(task: Task, policy: Policy, starts: Starts, settings: Training, seed: int) -> MlpPolicy:
    """A network that answers as a policy does, by regression: what PPO and A2C can go on from.

    Args:
        task: gives observations and inputs.
        policy: the one to copy, which may be any.
        starts: draws the chart points (n, d) at which it is copied.
        settings: of the training that goes on from there: network and algorithm.
        seed: of weights and points.

    Returns:
        A policy of `settings.algorithm`, whose value function and spread are untrained.
    """
    model = build(task, settings, seed)
    rng = np.random.default_rng(seed)
    plant = task.plant(DISTILLED)
    plant.set_state(*task.state(starts(DISTILLED, rng), rng))
    measured = plant.measurement
    seen = torch.as_tensor(task.observation(measured).astype(np.float32))
    inputs, levels = policy.act(measured), task.input_levels
    if levels is None:
        wanted = torch.as_tensor(inputs.astype(np.float32))
    else:
        off = np.abs(inputs[:, None] - levels).sum(axis=2)
        wanted = torch.as_tensor(off.argmin(axis=1))
    acting = [
        weights
        for name, weights in model.policy.named_parameters()
        if name.startswith(LAYOUTS[settings.algorithm].parts)
    ]
    optimizer = torch.optim.Adam(acting, lr=settings.learning_rate)
    progress = Progress("distilling the agent", DISTILLING, "steps")
    with single_threaded():
        for step in range(DISTILLING):
            rows = torch.as_tensor(rng.integers(DISTILLED, size=BATCH))
            _, likelihood, _ = model.policy.evaluate_actions(seen[rows], wanted[rows])
            optimizer.zero_grad()
            (-likelihood.mean()).backward()
            optimizer.step()
            progress.update(step + 1)
    progress.close()
    return export(model, task)


def export(model: BaseAlgorithm, task: Task) -> MlpPolicy:
    """The policy that an SB3 algorithm has learned so far, as a plain network."""
    state = symmetry.plain_state(model.policy, task)
    weights = {name: tensor.detach().cpu().numpy().copy() for name, tensor in state.items()}
    activation = next(n for n, a in ACTIVATIONS.items() if a is model.policy.activation_fn)
    algorithm = next(name for name, kind in ALGORITHMS.items() if isinstance(model, kind))
    return MlpPolicy(task, algorithm, activation, weights)


@contextmanager
def single_threaded() -> Iterator[None]:
    """One thread for torch and BLAS: small networks are faster, and sums do not depend on the machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


def evaluate(
    task: Task,
    policy: MlpPolicy,
    noise: Noise,
    domain: Domain | None = None,
    gamma: float = 1.0,
    episodes: int = EPISODES,
) -> tuple[float, float]:
    """How a policy does in episodes from the start distribution, always the same ones.

    Returns:
        The share of episodes that end at the set-point, and the mean return, discounted by gamma.
    """
    env = BatchedEnv(task, episodes, noise=noise, domain=domain)
    env.seed(0)
    observation = env.reset()
    returns, weight = np.zeros(episodes), np.ones(episodes)
    success = np.zeros(episodes, dtype=bool)
    while weight.any():
        result = env.step(policy.inputs(observation))
        returns += weight * result.reward
        ended = result.done & (weight > 0)
        success[ended] = (result.outcome == Outcome.REACHED)[ended] & task.arrived(env.z[ended])
        weight *= gamma * ~result.done
        observation = result.observation
    return float(success.mean()), float(returns.mean())


class Judge(Protocol):
    """What tells good policies from bad ones.

    Attributes:
        enough: a score with which training may end.
    """

    enough: Score

    def __call__(self, policy: MlpPolicy) -> Score:
        """The score of a policy; scores are compared from left to right, the higher the better."""
        ...


class _Episodes:
    """Judges by episodes without noise and with each kind of it."""

    enough: Score = (np.inf,)

    def __init__(self, task: Task, noise: Noise, domain: Domain | None, gamma: float):
        self._task, self._domain, self._gamma = task, domain, gamma
        self._noises = [Noise(k, noise.bound) for k in SIGNALS] if noise.bound else [Noise()]

    def __call__(self, policy: MlpPolicy) -> Score:
        found = [evaluate(self._task, policy, n, self._domain, self._gamma) for n in self._noises]
        success, returns = np.mean(found, axis=0)
        return float(success), float(returns)


class _Watch(BaseCallback):
    """Progress bar, checkpoints at intervals, and the best policy."""

    def __init__(self, samples: int, judge: Judge, settled: int, log_dir: Path | None, label: str):
        super().__init__()
        self.best: MlpPolicy | None = None
        self.best_score: Score = (-np.inf,)
        self._judge, self._settled, self._log_dir = judge, settled, log_dir
        self._next = self._interval = max(samples // CHECKPOINTS, 1)
        self._progress = Progress(label, samples, "samples")

    def _on_step(self) -> bool:
        self._progress.update(self.num_timesteps)
        if self.num_timesteps >= self._next:
            self._next += self._interval
            self._checkpoint()
        return self.best_score < self._judge.enough

    def _on_training_end(self) -> None:
        if self.best_score < self._judge.enough:
            self._checkpoint()

    def close(self) -> None:
        """Take the progress bar away."""
        self._progress.close()

    def _checkpoint(self) -> None:
        policy = export(self.model, self.training_env.core.task)
        if self._log_dir is not None:
            policy.save(self._log_dir / "checkpoint.safetensors")
        if self.num_timesteps >= self._settled:
            score = self._judge(policy)
            for i, value in enumerate(score):
                self.logger.record(f"eval/score_{i}", value)
            if score > self.best_score:
                self.best_score, self.best = score, policy
