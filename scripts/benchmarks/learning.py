"""Stage 1 until the policy is good, against SB3 on one environment with the paper's settings."""

import sys
import time
from collections.abc import Callable, Iterator
from itertools import count
from types import SimpleNamespace

import gymnasium
import numpy as np

import hyrl_mj
from benchmarks import Figure
from benchmarks.runs import Runs
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.learning import preset
from hyrl_mj.learning.training import Score, TaskGround, export, threads, train
from hyrl_mj.policies import MlpPolicy, PolicyController, algorithms
from hyrl_mj.simulation import closed_loop
from hyrl_mj.tasks import Outcome, Task


def circle_return(task: Task, policy: MlpPolicy) -> float:
    """Returns the mean return over 150 samples from 500 starts drawn evenly from pi +- 0.2 rad."""
    env = BatchedEnv(task, 500)
    env.reset(z=np.pi + np.random.default_rng(0).uniform(-0.2, 0.2, (500, 1)))
    rewards = [env.step(policy.act(env.plant.measurement)).reward for _ in range(task.max_steps)]
    return float(np.sum(rewards) / 500)


def vehicle_share(task: Task, policy: MlpPolicy) -> float:
    """Returns the share of the winnable starts in [0, 0.5] x [-1, 1] m that the policy passes from."""
    x, y = np.meshgrid(np.linspace(0, 0.5, 50), np.linspace(-1, 1, 50), indexing="ij")
    z0 = np.stack([x.ravel(), y.ravel()], axis=1)

    def outcome(act: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        return closed_loop(task, PolicyController(SimpleNamespace(act=act)), z0).outcome

    # Steering hard drives into the wall in the end; it has passed if that comes before a crash.
    winnable = np.any(
        [outcome(lambda z, u=u: np.full((len(z), 1), u)) != Outcome.CRASHED for u in (-1.0, 1.0)],
        axis=0,
    )
    won = outcome(policy.act) == Outcome.REACHED
    return float((won & winnable).sum() / winnable.sum())


# How good a policy has to be: the mean return from pi +- 0.2 rad; the share of winnable starts passed.
GOOD: dict[str, tuple[Callable[[Task, MlpPolicy], float], float, str]] = {
    "unit_circle": (circle_return, -30.5, ">= 15x"),
    "vehicle": (vehicle_share, 0.995, ">= 3x"),
}
# Samples of the single environment between two looks at its policy, and the time after which it is given
# up [s]: the ratio is then at least what is said.
INTERVAL, PATIENCE = 5_000, 150.0


def figures(runs: Runs) -> Iterator[Figure]:
    """Both problems; every training with a seed of its own."""
    for name, (quality, enough, target) in GOOD.items():
        task = hyrl_mj.get_task(name)
        yield Figure(
            f"stage 1, {name}, to the paper's quality",
            "s",
            "SB3 on one environment, the paper's settings",
            target,
            _ours(task, quality, enough),
            _paper(task, quality, enough),
            least=0.0,
            slow=True,
        )


class _Quality(TaskGround):
    """Judges a policy by its quality, as `train` asks for it."""

    settled = 0.0

    def __init__(self, task: Task, quality: Callable[[Task, MlpPolicy], float], enough: float):
        super().__init__(task, preset(task).stage1)
        self._quality, self.enough = quality, (enough,)

    def __call__(self, policy: MlpPolicy) -> Score:
        return (self._quality(self._task, policy),)


def _ours(task: Task, quality: Callable[[Task, MlpPolicy], float], enough: float):
    seeds = count()

    def work() -> int:
        judge = _Quality(task, quality, enough)
        found = train(task, preset(task).stage1, next(seeds), ground=judge)
        if judge(found) < judge.enough:
            raise SystemExit(f"{task.name}: stage 1 did not reach {enough}")
        return 1

    return work


def _paper(task: Task, quality: Callable[[Task, MlpPolicy], float], enough: float):
    seeds = count()

    def work() -> int:
        settings = preset(task, "paper").stage1
        model = algorithms.sb3_class(settings.algorithm)(
            "MlpPolicy",
            gymnasium.make(task.env_id),
            seed=next(seeds),
            device="cpu",
            gamma=settings.gamma,
            learning_rate=settings.learning_rate,
            policy_kwargs={"net_arch": list(settings.hidden)},
            **settings.options,
        )
        judge, end = _Quality(task, quality, enough), time.perf_counter() + PATIENCE

        def goes_on(*_: object) -> bool:
            if model.num_timesteps % INTERVAL:
                return True
            return time.perf_counter() < end and judge(export(model, task)) < judge.enough

        with threads(1):
            model.learn(settings.samples, callback=goes_on)
        if judge(export(model, task)) < judge.enough:
            late = f"{task.name}: SB3 did not reach {enough} in {PATIENCE:.0f} s"
            print(f"{late}: the ratio is greater than this", file=sys.stderr)
        return 1

    return work
