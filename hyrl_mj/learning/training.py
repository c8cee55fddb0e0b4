"""Training of policies with SB3 on the batched environments (paper, Steps 1 and 6)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from threadpoolctl import threadpool_limits
from torch import nn

from hyrl_mj.errors import BadInput, HyrlError, brief
from hyrl_mj.gym_export import BatchedEnv, Domain
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.learning import symmetry
from hyrl_mj.learning.rehearsal import Rehearsal, running_points
from hyrl_mj.learning.settings import Training
from hyrl_mj.learning.to_go import WayToGo
from hyrl_mj.policies import (
    ALGORITHMS,
    TORCH_NAMES,
    MlpPolicy,
    algorithms,
    infer_algorithm,
)
from hyrl_mj.simulation import AnyNoise, Noise
from hyrl_mj.system.progress import progress_bar
from hyrl_mj.tasks import Outcome, Task

Score = tuple[float, ...]
# Episodes by which a policy is judged on the starts of its task.
EPISODES = 256
ACTIVATIONS = {name: getattr(nn, torch_name) for name, torch_name in TORCH_NAMES.items()}


class Ground(Protocol):
    """Where a policy is trained and how it is judged.

    Attributes:
        noise: noise on the measurements during training.
        enough: score with which training may end.
        settled: share of the training after which scores count.
    """

    noise: AnyNoise
    enough: Score
    settled: float

    def domain(self, gamma: float) -> Domain | None:
        """Returns where episodes start and stay, for a discount gamma; None for the task's starts."""

    def note_losses(self, policy: MlpPolicy) -> None:
        """Notes where a policy loses whose score does not count yet, for the starts of later episodes."""

    def __call__(self, policy: MlpPolicy) -> Score:
        """Returns the score of a policy; higher is better, compared from left to right."""


@contextmanager
def usual_torch() -> Iterator[None]:
    """Lets torch compute with 32 bits and gradients, whatever a user's code has set for itself."""
    kind = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_default_dtype(kind)


@usual_torch()
def train(
    task: Task,
    settings: Training,
    seed: int,
    *,
    ground: Ground | None = None,
    start_from: MlpPolicy | None = None,
    log_dir: Path | None = None,
    label: str = "training",
) -> MlpPolicy:
    """Trains one policy, and returns the best of its checkpoints, as SB3's `EvalCallback` does.

    Args:
        task, settings: the robot and its problem, and the settings of the training.
        seed: seed of weights, exploration, starts and noise; the same seed gives the same policy on the
            same kind of processor, with any number of cores and threads.
        ground: where the policy is trained and judged; by default `TaskGround`.
        start_from: a policy whose weights to continue from; its network replaces `settings.hidden`.
        log_dir: folder of TensorBoard logs and checkpoints; none are written by default.
        label: label of the progress bar.

    Raises:
        BadInput: settings that SB3 cannot train with, or a training whose weights grow without bound.
    """
    ground = ground or TaskGround(task, settings)
    domain = ground.domain(settings.gamma)
    model = build(task, settings, seed, noise=ground.noise, domain=domain, start_from=start_from)
    if log_dir is not None:
        model.set_logger(configure(str(log_dir / "tensorboard"), ["tensorboard"]))
    # TensorBoard gets a point after each rollout, or after so many episodes.
    interval = 1 if isinstance(model, OnPolicyAlgorithm) else 100
    watch = _Watch(settings.samples, task.effort.checkpoints, ground, log_dir, label)
    try:
        with threads(1):  # faster for small networks
            model.learn(settings.samples, callback=watch, log_interval=interval)
    except (HyrlError, OSError):
        raise
    except Exception as error:  # whatever SB3 and torch raise
        raise BadInput(
            f"training with {settings.algorithm} broke off after {model.num_timesteps:,} samples "
            f"({brief(error)}): change its settings, now {_described(settings)}"
        ) from error
    assert watch.best is not None
    return watch.best


@usual_torch()
def build(
    task: Task,
    settings: Training,
    seed: int,
    *,
    noise: AnyNoise | None = None,
    domain: Domain | None = None,
    start_from: MlpPolicy | None = None,
) -> BaseAlgorithm:
    """Returns the SB3 algorithm that `train` runs, ready to learn.

    Raises:
        BadInput: an unknown algorithm, settings that it refuses, or a policy to start from whose networks
            differ.
    """
    algorithms.check(settings.algorithm, task.name, task.learning.levels)
    core = BatchedEnv(task, settings.envs, noise=noise, domain=domain, max_steps=settings.episode)
    options = dict(settings.options)
    if settings.action_noise:
        m = len(task.inputs)
        options["action_noise"] = NormalActionNoise(np.zeros(m), np.full(m, settings.action_noise))
    kind, of_policy = algorithms.sb3_class(settings.algorithm), {}
    if start_from is not None:
        of_policy = network(start_from.hidden, start_from.activation)
    try:
        # One thread orthogonalises the initial weights with other sums than two or more, which agree.
        with threads(2):
            env = TaskVecEnv(core)
            model = with_settings(kind, "MlpPolicy", env, settings, seed, of_policy, options)
    except HyrlError:
        raise
    except Exception as error:  # whatever SB3, torch and foreign classes raise
        raise BadInput(
            f"{settings.algorithm} cannot train {task.name}: {brief(error)}; change its settings, now "
            f"{_described(settings)}"
        ) from error
    if start_from is not None:
        state = {name: torch.as_tensor(np.array(w)) for name, w in start_from.weights.items()}
        try:
            model.policy.load_state_dict(state)
        except RuntimeError as error:
            raise BadInput(
                f"training with {settings.algorithm} cannot go on from this {start_from.algorithm} "
                "policy, because its networks differ: start a new training"
            ) from error
    if settings.spread and start_from is None:
        spread_kinks(model.policy, task, seed)
    if settings.symmetric and start_from is None and task.mirror is not None:
        symmetry.impose(model.policy, task)
    return model


def network(hidden: Sequence[int], activation: str) -> dict[str, Any]:
    """Returns the arguments of a policy of SB3 for a network of widths `hidden`."""
    return {"net_arch": [*hidden], "activation_fn": ACTIVATIONS[activation]}


def with_settings(
    algorithm: Callable[..., Any],
    policy: Any,
    env: VecEnv,
    settings: Training,
    seed: int,
    of_policy: Mapping[str, Any],
    options: Mapping[str, Any],
) -> Any:
    """Returns an algorithm of SB3 with the settings of a training.

    Args:
        algorithm, policy: SB3's classes, of the policy also the name.
        env: the episodes.
        settings: rewards, discount and learning rate are as they say.
        seed: seed of weights and exploration.
        of_policy: arguments of the policy; by default the network is as the settings say.
        options: arguments of the algorithm.
    """
    rate, gamma = settings.learning_rate, settings.gamma
    if settings.normalize:
        env = VecNormalize(env, norm_obs=False, clip_reward=np.inf, gamma=gamma)
    falling = settings.anneal
    return algorithm(
        policy,
        env,
        seed=seed,
        device="cpu",
        gamma=gamma,
        learning_rate=(lambda left: rate * max(left, settings.final_rate)) if falling else rate,
        policy_kwargs=network(settings.hidden, settings.activation) | dict(of_policy),
        **options,
    )


def spread_kinks(policy: nn.Module, task: Task, seed: int) -> None:
    """Moves the kink of every unit that reads the observation to an observation of the chart.

    The first layer then sees all of the chart. SB3 starts networks with biases of zero: all its kinks pass
    through the origin of the observation, and a network learns slowly what differs far from it.

    Args:
        policy: a policy of SB3, whose weights change.
        task: gives the chart and its observations.
        seed: seed of the draw.
    """
    rng = np.random.default_rng(seed)
    z = running_points(task, 4_096, rng)
    seen = torch.as_tensor(task.observation(task.placed(z, rng).measurement))
    columns = len(task.observation_low)
    with torch.no_grad():
        for network in (module for module in policy.modules() if isinstance(module, nn.Sequential)):
            layer = next(iter(network), None)
            if isinstance(layer, nn.Linear) and layer.in_features == columns:
                # The same rows for layers of one width: a target network stays a copy.
                draw = np.random.default_rng([seed, layer.out_features])
                at = seen[torch.as_tensor(draw.integers(len(seen), size=layer.out_features))]
                layer.bias.copy_(-(layer.weight * at.to(layer.weight.dtype)).sum(dim=1))


def check_foreign(task: Task, settings: Training) -> None:
    """Checks an algorithm that is not SB3's own, and its policy, before training.

    Raises:
        BadInput: the algorithm cannot be built with these settings, or its policy differs from a plain
            network of the same weights.
    """
    name = settings.algorithm
    model = build(task, settings, seed=0)
    # Layers without effect at first, such as normalisation, have one once all weights have changed.
    generator = torch.Generator().manual_seed(0)
    for tensor in model.policy.state_dict().values():
        if tensor.is_floating_point():
            tensor += 0.05 * torch.rand(tensor.shape, generator=generator)
    plain = f"the policy of {name} cannot be used, only plain multilayer perceptrons can"
    try:
        policy = export(model, task)
    except Exception as error:
        raise BadInput(f"{plain}: {brief(error)}") from error
    core = BatchedEnv(task, 64)
    core.seed(0)
    observation = core.reset()
    actions, _ = model.predict(observation, deterministic=True)
    off = np.abs(core.inputs(actions) - policy.inputs(observation)).max()
    if off > 1e-4 * np.ptp(task.input_limits):
        raise BadInput(f"{plain}: what it answers is not what its weights say")


def _described(settings: Training) -> str:
    """Returns the settings that SB3 gets: "learning_rate 0.003, gamma 0.98, n_steps 32"."""
    own = ("samples", "envs", "hidden", "learning_rate", "gamma")
    values = {name: getattr(settings, name) for name in own} | settings.options
    return ", ".join(f"{name} {value}" for name, value in values.items())


def export(model: BaseAlgorithm, task: Task, frames: int = 1) -> MlpPolicy:
    """Returns the current policy of an SB3 algorithm, which sees so many observations, as a plain network."""
    state = symmetry.plain_state(model.policy, task)
    weights = {name: tensor.detach().cpu().numpy().copy() for name, tensor in state.items()}
    activation = next(n for n, a in ACTIVATIONS.items() if a is model.policy.activation_fn)
    own = (name for name in ALGORITHMS if type(model) is algorithms.sb3_class(name))
    algorithm = next(own, "") or infer_algorithm(weights, {})
    return MlpPolicy(task, algorithm, activation, weights, frames)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Fixes the threads of torch and BLAS: their sums are then the same on any number of cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with threadpool_limits(count, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


def evaluate(task: Task, policy: MlpPolicy, gamma: float = 1.0) -> tuple[float, float]:
    """Returns the share of episodes that end at the set-point, and the mean return, discounted by gamma.

    The starts are drawn from the start distribution and are always the same.
    """
    env = BatchedEnv(task, EPISODES)
    env.seed(0)
    observation = env.reset()
    returns, weight = np.zeros(EPISODES), np.ones(EPISODES)
    success = np.zeros(EPISODES, dtype=bool)
    while weight.any():
        result = env.step(policy.inputs(observation))
        returns += weight * result.reward
        ended = result.done & (weight > 0)
        success[ended] = (result.outcome == Outcome.REACHED)[ended] & task.arrived(env.z[ended])
        weight *= gamma * ~result.done
        observation = result.observation
    return float(success.mean()), float(returns.mean())


class TaskGround:
    """All starts of a task, where a policy is judged on the same episodes every time.

    The score is the share of episodes that end at the set-point without noise, then the mean discounted
    return. Some of the training's episodes start anywhere, as its settings of `rehearse` say.

    Raises:
        NoWay: with `shaped`, no way leads to the goal.
    """

    noise: AnyNoise = Noise()
    enough: Score = (np.inf,)
    settled = 0.5  # an untrained policy can score well by chance

    def __init__(self, task: Task, settings: Training):
        self._task, self._gamma = task, settings.gamma
        self._rehearsal = Rehearsal(task, settings) if settings.rehearse else None
        self._pay = WayToGo(task, settings.gamma).pay if settings.shaped else None

    def domain(self, gamma: float) -> Domain | None:
        """Returns where episodes start if not where the task starts, and what else they are paid for."""
        starts = self._rehearsal.starts if self._rehearsal else self._task.starts
        return Domain(starts, pay=self._pay) if self._rehearsal or self._pay else None

    def note_losses(self, policy: MlpPolicy) -> None:
        """Notes where a policy loses and decides, for the starts of later episodes."""
        if self._rehearsal:
            self._rehearsal.update(policy)

    def __call__(self, policy: MlpPolicy) -> Score:
        self.note_losses(policy)
        return evaluate(self._task, policy, self._gamma)


class _Watch(BaseCallback):
    """Shows progress, judges checkpoints at intervals, and keeps the best policy."""

    def __init__(
        self, samples: int, checkpoints: int, ground: Ground, log_dir: Path | None, label: str
    ):
        super().__init__()
        self.best: MlpPolicy | None = None
        self.best_score: Score = (-np.inf,)
        self._ground, self._log_dir = ground, log_dir
        self._settled = int(ground.settled * samples)
        self._next = self._interval = max(samples // checkpoints, 1)
        self._progress = progress_bar(None, label, "samples", samples)

    def _on_step(self) -> bool:
        self._progress.update(self.num_timesteps - self._progress.n)
        if self.num_timesteps >= self._next:
            self._next += self._interval
            self._checkpoint()
        return self.best_score < self._ground.enough

    def _on_training_end(self) -> None:
        if self.best_score < self._ground.enough:
            self._checkpoint()
        self._progress.close()

    def _checkpoint(self) -> None:
        policy = export(self.model, self.training_env.core.task)
        if not all(np.isfinite(weights).all() for weights in policy.weights.values()):
            raise BadInput(
                f"the training diverged: after {self.num_timesteps:,} samples its weights are not finite; "
                "lower learning_rate, or bound the reward"
            )
        if self._log_dir is not None:
            policy.save(self._log_dir / "checkpoint.safetensors")
        if self.num_timesteps < self._settled:
            self._ground.note_losses(policy)
            return
        score = self._ground(policy)
        for i, value in enumerate(score):
            self.logger.record(f"eval/score_{i}", value)
        if score > self.best_score:
            self.best_score, self.best = score, policy
