"""Agents as users may have them: honest ones, and ways in which an agent is no function of what it sees."""

from itertools import pairwise

import numpy as np
import torch
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3

from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv

# ---- honest agents: functions from observations (n, k) to inputs (n, m), or to levels (n,)


def numpy_net(task, rng):
    """A network of one to three layers, the steeper the larger its weights are drawn."""
    widths = [len(task.observation_low), *rng.integers(4, 200, rng.integers(1, 4)), outputs(task)]
    scale = rng.choice([0.5, 1.5, 5.0])
    layers = [
        (rng.normal(scale=scale / np.sqrt(a), size=(a, b)).astype(np.float32), rng.normal(size=b))
        for a, b in pairwise(widths)
    ]

    def act(o):
        for i, (w, b) in enumerate(layers):
            o = o @ w + b.astype(np.float32)
            o = np.tanh(o) if i < len(layers) - 1 else o
        return chosen(task, o)

    return act


def torch_net(task, rng):
    torch.manual_seed(int(rng.integers(2**31)))
    width = int(rng.integers(4, 300))
    between = rng.choice(["batch norm", "dropout", "layer norm"])
    kinds = {
        "batch norm": torch.nn.BatchNorm1d(width),
        "dropout": torch.nn.Dropout(0.5),
        "layer norm": torch.nn.LayerNorm(width),
    }
    first = torch.nn.Linear(len(task.observation_low), width)
    return torch.nn.Sequential(
        first, kinds[between], torch.nn.ReLU(), torch.nn.Linear(width, outputs(task))
    ).train()


def sb3_agent(task, rng):
    algorithms = (DQN, PPO, A2C) if task.input_levels is not None else (PPO, A2C, SAC, TD3)
    algorithm = algorithms[rng.integers(len(algorithms))]
    options = {} if algorithm in (PPO, A2C) else {"buffer_size": 10}
    env = TaskVecEnv(BatchedEnv(task, 1, threads=1))
    model = algorithm("MlpPolicy", env, seed=int(rng.integers(2**31)), device="cpu", **options)
    return lambda o: model.predict(o, deterministic=True)[0]


def rule(task, rng):
    """Steers at the limit, to a side that depends on the observation."""
    normal, offset = rng.normal(size=len(task.observation_low)), rng.normal(scale=0.3)

    def act(o):
        side = o @ normal > offset
        if task.input_levels is not None:
            return np.where(side, len(task.input_levels) - 1, 0)
        low, high = task.input_limits
        return np.where(side[:, None], low, high)

    return act


def outputs(task):
    return len(task.inputs) if task.input_levels is None else len(task.input_levels)


def chosen(task, last):
    return last if task.input_levels is None else last.argmax(axis=1)


HONEST = {"numpy": numpy_net, "torch": torch_net, "sb3": sb3_agent, "rule": rule}

# ---- traps: each makes an agent of `act` that is none


def holds_six(act, task):
    """Plans six inputs ahead, and looks again when they are used up."""
    queue = []

    def held(o):
        if not queue or len(queue[0]) != len(o):
            queue[:] = [act(o)] * 6
        return queue.pop(0)

    return held


def filters(act, task):
    last = {}

    def filtered(o):
        u = np.asarray(act(o), dtype=float)
        before = last.get("u")
        last["u"] = u if before is None or before.shape != u.shape else 0.7 * before + 0.3 * u
        return as_given(last["u"], task)

    return filtered


def delays(act, task):
    seen = []

    def delayed(o):
        seen.append(o.copy())
        return act(seen[-3] if len(seen) > 2 and seen[-3].shape == o.shape else o)

    return delayed


def counts(act, task, calls=50):
    """Does something else after some calls."""
    called = [0]

    def counting(o):
        called[0] += 1
        return act(o) if called[0] <= calls else act(-o)

    return counting


def caches_by_size(act, task):
    known = {}
    return lambda o: known.setdefault(len(o), act(o)).copy()


def caches_by_id(act, task):
    known = {}
    return lambda o: known.setdefault((id(o), o.shape), act(o)).copy()


def caches_by_first_row(act, task):
    known = {}
    return lambda o: known.setdefault((o[0].tobytes(), len(o)), act(o)).copy()


def caches_by_rounded_row(act, task):
    """Answers a row as the first one that was near it."""
    known = {}
    return lambda o: np.array(
        [known.setdefault(row.round(1).tobytes(), u) for row, u in zip(o, act(o), strict=True)]
    )


def draws(act, task):
    """Explores in one of twenty rows."""
    rng = np.random.default_rng(0)

    def drawn(o):
        u = np.array(act(o))
        explores = rng.random(len(u)) < 0.05
        low = 0 if task.input_levels is not None else task.input_limits[0]
        high = len(task.input_levels) if task.input_levels is not None else task.input_limits[1]
        other = rng.integers(low, high, u.shape) if u.ndim == 1 else rng.uniform(low, high, u.shape)
        u[explores] = other[explores]
        return u

    return drawn


def centres(act, task):
    return lambda o: act(o - o.mean(axis=0))


def normalises_running(act, task):
    """Normalises by the mean of all that it has seen, as `VecNormalize` does while it trains."""
    sums = [0.0, 0]

    def normalised(o):
        sums[0], sums[1] = sums[0] + o.sum(axis=0), sums[1] + len(o)
        return act((o - sums[0] / sums[1]).astype(np.float32))

    return normalised


def follows_the_first(act, task):
    """Answers all rows as the first: written for one robot."""
    return lambda o: np.repeat(act(o[:1]), len(o), axis=0)


def as_given(u, task):
    return np.rint(u).astype(int) if task.input_levels is not None else u


TRAPS = {
    f.__name__: f
    for f in (
        holds_six, filters, delays, counts, caches_by_size, caches_by_id, caches_by_first_row,
        caches_by_rounded_row, draws,
        centres, normalises_running, follows_the_first,
    )
}  # fmt: skip
